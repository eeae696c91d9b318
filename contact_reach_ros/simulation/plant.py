"""The simulated robot: MuJoCo at the driver's tick, with contact, sensors, friction and brakes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from xml.etree.ElementTree import Element

import mujoco
import numpy as np

from contact_reach_ros.arm import Array, JointState
from contact_reach_ros.arm.assumptions import inertias_at_home
from contact_reach_ros.arm.mjcf import TIP_SITE, build_mjcf
from contact_reach_ros.simulation.obstacles import Foam, obstacle_bodies, rigid_geoms, self_contacts, soften_fixed
from contact_reach_ros.simulation.settings import TICK, TICK_NS
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import rest_positions

FRICTION = (0.3, 0.2)
"""Viscous, N m s/rad, and dry friction of a joint, N m, which controller and observer do not know; the mismatch of a
scene multiplies it."""
POSITION_NOISE, VELOCITY_NOISE, TORQUE_NOISE = 1e-5, 1e-3, 0.05
"""Standard deviations of a good arm's sensors, rad, rad/s and N m; the mismatch of a scene multiplies them."""
WEAK = 10.0
"""Torque limit of a joint, N m, below which its friction and the noise of its torque are in proportion to it."""
SLUGGISH = 40.0
"""Acceleration at home that a joint's torque limit is good for, rad/s², below which the noise of its velocity is in
proportion to it: it makes one of 0.1 % of the torque limit in the observer's estimate."""
POSITION_RESOLUTION = 1e-5
"""rad."""
HOLD_DAMPING = 30.0
"""Damping of the damped hold, N m s/rad: it brings every joint to rest before the brakes close."""
BRAKE_TORQUE = 150.0
"""Holding torque of a closed brake, N m: more than the arm weighs in any posture."""

_IMPEDANCE = 0.9
"""MuJoCo's default impedance."""
_BRAKE_IMPEDANCE = 0.9999


class Actuation(Enum):
    """What moves the joints."""

    BRAKED = "braked"
    """Brakes closed."""
    COMMANDED = "commanded"
    """The commanded torques."""
    DAMPED_HOLD = "damped hold"
    """The robot's own gravity compensation and damping."""


class Plant:
    """The arm and the obstacles of one scene: soft spheres, rigid bodies and the arm itself.

    Attributes
    ----------
    arm
        The simulated arm.
    actuation
        What moves the joints; initially the brakes.
    steps
        Steps taken.
    scene
        Arm and surroundings.
    """

    def __init__(
        self,
        scene: Scene,
        friction: tuple[float, float] = FRICTION,
        noise_seed: int | None = None,
        others: Sequence[Element] = (),
    ) -> None:
        """Build the simulation at the scene's start, with its mismatch.

        `noise_seed`, by default `scene.seed`, seeds the sensor noise. `others` are bodies of MuJoCo's besides the
        scene's.
        """
        self.arm = scene.arm
        mismatch = scene.mismatch
        bodies = []
        # What bends comes last: the movable spheres of all others are neighbours in MuJoCo's arrays.
        for index, obstacle in sorted(enumerate(scene.true_obstacles), key=lambda each: each[1].bending is not None):
            bodies += obstacle_bodies(obstacle, index, scene.foam_scale)
        self.model = mujoco.MjModel.from_xml_string(
            build_mjcf(
                scene.arm,
                mismatch.inertia_set,
                [*bodies, *others, *rigid_geoms(scene.environment)],
                mismatch.payload,
                self_contacts(scene.arm),
            )
        )
        soften_fixed(self.model)
        self.model.opt.timestep = TICK
        # With a pyramidal friction cone the contact's stiffness would depend on the friction, 20-fold at the default.
        self.model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        self.data = mujoco.MjData(self.model)
        self.actuation = Actuation.BRAKED
        self.steps = 0
        self.scene = scene
        self._viscous, self._coulomb = friction
        self._friction_scale = mismatch.friction_scale
        limits, inertias = scene.arm.torque_limits, inertias_at_home(scene.arm)
        self._share = np.minimum(limits / WEAK, 1.0)
        velocity_noise = VELOCITY_NOISE * np.minimum(limits / (SLUGGISH * inertias), 1.0)
        self._noise_scale = mismatch.noise_scale
        self._noise = np.array([np.full(scene.arm.n, POSITION_NOISE), velocity_noise, TORQUE_NOISE * self._share])
        self._random = np.random.default_rng(scene.seed if noise_seed is None else noise_seed)
        self._arm = slice(0, scene.arm.n)
        self._torque_limits = scene.arm.torque_limits
        self._torque = np.full(scene.arm.n, np.nan)
        self._flange = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, TIP_SITE)
        self._pushes: Sequence[tuple[str, Array, Array]] = ()
        self._rests = rest_positions(scene)
        on_springs = [~each.fixed & (each.bending is None) for each in scene.obstacles]
        self._movable = np.flatnonzero(np.concatenate([np.zeros(0, bool), *on_springs]))
        foam = [obstacle for obstacle in scene.obstacles if obstacle.bending is None]
        has_edges = any(obstacle.is_deformable for obstacle in foam)
        self._foam = Foam(foam, scene.foam_scale) if has_edges else None
        self._obstacles = slice(scene.arm.n, scene.arm.n + 3 * len(self._movable))
        self._sites, self._bent, self._shift = self._stem_ends()
        names = [self.model.body(body).name for body in self.model.geom_bodyid]
        links = self.arm.contact_links
        self._link_of_geom = [links.index(name) if name in links else -1 for name in names]
        self.data.qpos[self._arm] = scene.start
        self._apply_joint_settings()
        mujoco.mj_forward(self.model, self.data)

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.steps * TICK

    @property
    def tip_position(self) -> Array:
        """True position of the tip, (3,), m, base frame."""
        return self.data.site_xpos[self._flange].copy()

    @property
    def joint_positions(self) -> Array:
        """True joint positions (n,), rad."""
        return self.data.qpos[self._arm].copy()

    def set_actuation(self, actuation: Actuation) -> None:
        """Change the actuation of the joints."""
        if actuation is not self.actuation:
            self.actuation = actuation
            self._apply_joint_settings()

    def step(self, command: Array | None = None) -> None:
        """Advance by one tick; when commanded, under `command` (n,) N m, capped at the data sheet's limits.

        Raises `ValueError` if the actuation is commanded and there is no command.
        """
        data = self.data
        if self.actuation is Actuation.COMMANDED:
            if command is None:
                raise ValueError("the plant is commanded but got no command: pass one or change the actuation")
            torque = np.minimum(np.maximum(command, -self._torque_limits), self._torque_limits)
            data.ctrl[:] = torque
            data.qfrc_applied[self._arm] = 0.0
            self._torque = torque
        else:
            data.ctrl[:] = 0.0
            data.qfrc_applied[self._arm] = data.qfrc_bias[self._arm]
            self._torque = np.full(self.scene.arm.n, np.nan)
        if self._foam is not None:
            dofs = self._obstacles
            data.qfrc_applied[dofs] = self._foam.forces(data.qpos[dofs])
        for link, force, point in self._pushes:
            body = data.body(link)
            place = body.xpos + body.xmat.reshape(3, 3) @ point
            mujoco.mj_applyFT(self.model, data, force, np.zeros(3), place, body.id, data.qfrc_applied)
        mujoco.mj_step(self.model, data)
        self.steps += 1

    def read(self) -> JointState:
        """What the joint sensors show of the present state, at its simulated time; each call draws new noise."""
        noise = self._noise_scale * self._random.standard_normal((3, self.scene.arm.n)) * self._noise
        position = self.data.qpos[self._arm] + noise[0]
        if self._noise_scale > 0.0:
            position = POSITION_RESOLUTION * np.rint(position / POSITION_RESOLUTION)
        velocity = self.data.qvel[self._arm] + noise[1]
        return JointState(self.steps * TICK_NS, position, velocity, self._torque + noise[2])

    def contact_forces(self) -> Array:
        """Magnitude of the contact force on each of the arm's contact links, (L,), N: the sum over its contacts."""
        data, links = self.data, self._link_of_geom
        if data.ncon == 0:
            return np.zeros(len(self.arm.contact_links))
        sums = [[0.0, 0.0, 0.0] for _ in self.arm.contact_links]
        # Plain numbers: arrays are slower for fewer than a dozen contacts. With an elliptic friction cone the rows of
        # a contact among the constraints are its force: normal and, with friction, tangential. MuJoCo's frame (9,) is a
        # rotation matrix in row order, whose first row is the normal; the force is that on the second geometry.
        contact, forces = data.contact, data.efc_force.tolist()
        columns = (contact.geom, contact.efc_address, contact.dim, contact.frame)
        for geoms, address, dim, frame in zip(*(column.tolist() for column in columns), strict=True):
            # MuJoCo leaves out contacts without an address, which carry no force.
            if address < 0:
                continue
            for geom, sign in zip(geoms, (-1.0, 1.0), strict=True):
                if links[geom] < 0:
                    continue
                total = sums[links[geom]]
                for row, size in enumerate(forces[address : address + dim]):
                    along = sign * size
                    total[0] += along * frame[3 * row]
                    total[1] += along * frame[3 * row + 1]
                    total[2] += along * frame[3 * row + 2]
        return np.array([math.hypot(*total) for total in sums])

    def obstacle_positions(self) -> Array:
        """Where the obstacles' spheres are seen, (K, 3), m, base frame, in the order of `rest_positions`.

        They are `Scene.offsets` from there.
        """
        positions = self._rests.copy()
        positions[self._movable] += self.data.qpos[self._obstacles].reshape(-1, 3)
        positions[self._bent] = self.data.site_xpos[self._sites] - self._shift
        return positions

    def _stem_ends(self) -> tuple[list[int], list[int], Array]:
        """MuJoCo's sites at the ends of links, their spheres, and (N, 3) how far they are from where they are seen."""
        sites, spheres, shifts, count = [], [], [], 0
        for index, obstacle in enumerate(self.scene.obstacles):
            ends = [node for stem in obstacle.bending.stems for node in stem[1:]] if obstacle.bending else []
            sites += [self.model.site(f"{obstacle.kind}_{index}_{node}").id for node in ends]
            spheres += [count + node for node in ends]
            shifts += [self.scene.offsets[index] if len(self.scene.offsets) else np.zeros(3)] * len(ends)
            count += len(obstacle.rest)
        return sites, spheres, np.reshape(shifts, (-1, 3))

    def set_pushes(self, pushes: Sequence[tuple[str, Array, Array]]) -> None:
        """Replace the external forces: link, force (3,), N, base frame, and point (3,), m, in the frame of the link."""
        self._pushes = pushes

    def _apply_joint_settings(self) -> None:
        scale = self._friction_scale * self._share
        damping, friction = {
            Actuation.COMMANDED: (scale * self._viscous, scale * self._coulomb),
            Actuation.DAMPED_HOLD: (HOLD_DAMPING, scale * self._coulomb),
            Actuation.BRAKED: (scale * self._viscous, BRAKE_TORQUE),
        }[self.actuation]
        # MuJoCo integrates joint damping implicitly, so the damped hold is stable whatever the inertia.
        self.model.dof_damping[self._arm] = damping
        self.model.dof_frictionloss[self._arm] = friction
        # Dry friction creeps less the closer its impedance is to 1; with MuJoCo's 0.9, a push of 10 N would move the
        # braked arm at 10 cm/s.
        impedance = _BRAKE_IMPEDANCE if self.actuation is Actuation.BRAKED else _IMPEDANCE
        self.model.dof_solimp[self._arm, :2] = impedance
