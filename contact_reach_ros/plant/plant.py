"""The simulated robot: MuJoCo at the driver's tick, with contact, sensors, friction and brakes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import mujoco
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.plant.foam import Foam
from contact_reach_ros.plant.obstacles import (
    SPARE_NAME,
    SPARE_PLACE,
    ball_body,
    fixed_contact,
    spare_body,
    wall_bodies,
)
from contact_reach_ros.plant.settings import JointSettings, SensorSettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.mjcf import PAYLOAD_CENTER, PAYLOAD_INERTIA, build_mjcf
from contact_reach_ros.scenes.scene import Scene
from contact_reach_ros.scenes.spheres import rest_positions

Array = NDArray[np.float64]

TICK = 0.001
"""Length of one step, s."""

CONTACT_BODIES = tuple(iiwa14.LINK_NAMES[capsule.link - 1] for capsule in iiwa14.CAPSULES)
"""Bodies whose contact force is reported, in the order of `Plant.contact_forces`."""


class Actuation(Enum):
    """What moves the joints."""

    BRAKED = "braked"
    """Brakes closed."""
    COMMANDED = "commanded"
    """The commanded torques."""
    DAMPED_HOLD = "damped hold"
    """Gravity compensation and damping of the robot's own."""


@dataclass(frozen=True)
class Reading:
    """What the joint sensors say: positions (7,) rad, velocities (7,) rad/s, torques (7,) N m, NaN where unknown."""

    position: Array
    velocity: Array
    torque: Array


@dataclass(frozen=True, eq=False)
class Contacts:
    """Where the arm is touched.

    Attributes
    ----------
    bodies
        (n,) places in `CONTACT_BODIES`.
    points
        (n, 3), m, base frame.
    forces
        (n, 3) on the arm, N, base frame.
    """

    bodies: NDArray[np.intp]
    points: Array
    forces: Array


@dataclass(frozen=True, eq=False)
class Push:
    """A force (3,) N, base frame, on a point (3,) m of a link, in the frame of that link."""

    link: str
    force: Array
    point: Array


class Plant:
    """The arm and the obstacles of one scene.

    Attributes
    ----------
    actuation
        What moves the joints; braked at first.
    steps
        Steps taken.
    scene
        What stands around the arm.
    has_spare_obstacle
        Whether there is a sphere for `place_spare_obstacle`.
    """

    def __init__(
        self,
        scene: Scene,
        sensors: SensorSettings,
        joints: JointSettings,
        noise_seed: int | None = None,
        spare_obstacle: bool = False,
    ) -> None:
        """Build the simulation at the scene's start, with its mismatch.

        `noise_seed`, else `scene.seed`, seeds the sensor noise. With `spare_obstacle` there is a sphere out of reach
        that `place_spare_obstacle` moves in.
        """
        mismatch = scene.mismatch
        bodies = [ball_body(index, ball, scene.foam_scale) for index, ball in enumerate(scene.balls)]
        for index, wall in enumerate(scene.walls):
            bodies += wall_bodies(index, wall, scene.foam_scale)
        everything = [*bodies, spare_body()] if spare_obstacle else bodies
        self.model = mujoco.MjModel.from_xml_string(build_mjcf(mismatch.inertia_set, everything, mismatch.payload))
        self.model.opt.timestep = TICK
        # With a pyramidal friction cone the contact's stiffness would depend on the friction, 20-fold at the default.
        self.model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        self.data = mujoco.MjData(self.model)
        self.actuation = Actuation.BRAKED
        self.steps = 0
        self.scene = scene
        self._sensors = sensors
        self._joints = joints
        self._friction_scale = mismatch.friction_scale
        self._noise_scale = mismatch.noise_scale
        self._rigidities: tuple[Array, Array] | None = None
        self._random = np.random.default_rng(scene.seed if noise_seed is None else noise_seed)
        self._arm = slice(0, iiwa14.N_JOINTS)
        self._torque_limits = np.array(iiwa14.TORQUE_LIMITS)
        self._torque = np.full(iiwa14.N_JOINTS, np.nan)
        self._flange = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, "flange")
        self._first_obstacle = self.model.nbody - len(everything)
        self.has_spare_obstacle = spare_obstacle
        self._pushes: list[Push] = []
        self._rests = rest_positions(scene)
        movable = [np.ones(len(scene.balls), bool)] + [~wall.fixed for wall in scene.walls]
        self._movable = np.flatnonzero(np.concatenate(movable))
        self._foam = Foam(scene.walls, scene.foam_scale) if scene.walls else None
        self._foam_dofs = slice(iiwa14.N_JOINTS + 3 * len(scene.balls), self.model.nv)
        self._body_of_geom = self._contact_body_indices()
        self.data.qpos[self._arm] = scene.start
        self._apply_joint_settings()
        mujoco.mj_forward(self.model, self.data)

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.steps * TICK

    @property
    def flange_position(self) -> Array:
        """True position of the flange, (3,), m, base frame."""
        return self.data.site_xpos[self._flange].copy()

    @property
    def joint_velocities(self) -> list[float]:
        """True joint velocities (7,), rad/s."""
        velocities: list[float] = self.data.qvel[self._arm].tolist()
        return velocities

    def set_actuation(self, actuation: Actuation) -> None:
        """Change what moves the joints."""
        if actuation is not self.actuation:
            self.actuation = actuation
            self._apply_joint_settings()

    def step(self, command: Array | None = None) -> None:
        """Advance by one tick; when commanded, under `command` (7,) N m, capped at the data sheet's limits.

        Raises
        ------
        ValueError
            If the actuation is commanded and there is no command.
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
            self._torque = np.full(iiwa14.N_JOINTS, np.nan)
        if self._foam is not None:
            dofs = self._foam_dofs
            data.qfrc_applied[dofs] = self._foam.forces(data.qpos[dofs])
        if self._pushes:
            self._apply_pushes()
        mujoco.mj_step(self.model, data)
        self.steps += 1

    def read(self) -> Reading:
        """Sensor readings of the state at hand; each call draws new noise."""
        sensors = self._sensors
        noise = self._noise_scale * self._random.standard_normal((3, iiwa14.N_JOINTS))
        position = self.data.qpos[self._arm] + sensors.position_noise * noise[0]
        if sensors.position_resolution > 0.0:
            position = sensors.position_resolution * np.rint(position / sensors.position_resolution)
        velocity = self.data.qvel[self._arm] + sensors.velocity_noise * noise[1]
        return Reading(position, velocity, self._torque + sensors.torque_noise * noise[2])

    def contact_forces(self) -> Array:
        """Magnitude of the contact force on each of `CONTACT_BODIES`, (6,), N: the vector sum over its contacts."""
        sums = [[0.0, 0.0, 0.0] for _ in CONTACT_BODIES]
        for _, body, force, frame in self._contact_rows():
            total = sums[body]
            for row, along in enumerate(force):
                total[0] += along * frame[3 * row]
                total[1] += along * frame[3 * row + 1]
                total[2] += along * frame[3 * row + 2]
        return np.array([math.hypot(*total) for total in sums])

    def normal_forces(self) -> Array:
        """Sum of the normal forces of the contacts on each of `CONTACT_BODIES`, (6,), N, without friction."""
        sums = [0.0] * len(CONTACT_BODIES)
        for _, body, force, _ in self._contact_rows():
            sums[body] += force[0]
        return np.array(sums)

    def contacts(self) -> Contacts:
        """Each contact with the arm; over the contacts of a body the forces sum up to that of `contact_forces`."""
        rows, contact = list(self._contact_rows()), self.data.contact
        indices = [index for index, *_ in rows]
        forces = np.zeros((len(rows), 3))
        for total, (index, _, force, frame) in zip(forces, rows, strict=True):
            # MuJoCo tells the force on the second geometry of the two.
            sign = 1.0 if self._body_of_geom[contact.geom[index, 1]] >= 0 else -1.0
            total[:] = sign * (np.array(force) @ np.reshape(frame, (3, 3))[: len(force)])
        bodies = np.array([body for _, body, _, _ in rows], np.intp)
        return Contacts(bodies, contact.pos[indices].reshape(-1, 3), forces)

    def obstacle_positions(self) -> Array:
        """Where the obstacles are, (K, 3), m, base frame, in the order of `rest_positions`."""
        positions = self._rests.copy()
        positions[self._movable] += self.data.qpos[iiwa14.N_JOINTS :].reshape(-1, 3)
        return positions

    def obstacle_body(self, index: int) -> int:
        """The simulation's body of an obstacle, counted in the order of `obstacle_positions`."""
        return self._first_obstacle + index

    def scale_friction(self, factor: float) -> None:
        """Multiply both joint frictions by a factor, relative to those of the scene."""
        self._friction_scale = factor * self.scene.mismatch.friction_scale
        self._apply_joint_settings()

    def set_payload(self, mass: float) -> None:
        """Put a mass in kg to the flange, besides the scene's payload and where that is."""
        model = self.model
        body = model.body(iiwa14.FLANGE_NAME).id
        total = self.scene.mismatch.payload + mass
        if total == model.body_mass[body]:
            return
        model.body_mass[body] = total
        model.body_inertia[body] = PAYLOAD_INERTIA * total
        model.body_ipos[body] = PAYLOAD_CENTER
        # MuJoCo would take the centre of mass for the origin of a body that was compiled without a mass.
        model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        mujoco.mj_setConst(model, mujoco.MjData(model))

    def scale_foam(self, factor: float) -> None:
        """Multiply all stiffnesses of balls and walls by a factor, relative to those of the scene."""
        model = self.model
        if self._rigidities is None:
            self._rigidities = (model.jnt_stiffness.copy(), model.geom_solref.copy())
        stiffness, solref = self._rigidities
        model.jnt_stiffness[iiwa14.N_JOINTS :] = factor * stiffness[iiwa14.N_JOINTS :]
        bodies = model.geom_bodyid
        foam = (bodies >= self._first_obstacle) & (bodies < self._first_obstacle + len(self._rests))
        model.geom_solref[foam, 0] = factor * solref[foam, 0]
        if self._foam is not None:
            self._foam = Foam(self.scene.walls, factor * self.scene.foam_scale)

    def set_pushes(self, pushes: Sequence[Push]) -> None:
        """Let these forces act from now on, and no others."""
        self._pushes = list(pushes)
        self.data.xfrc_applied[:] = 0.0

    def place_spare_obstacle(self, position: Array, radius: float, stiffness: float) -> None:
        """Let a sphere that does not give way stand at `position` (3,) m, base frame.

        Raises
        ------
        ValueError
            If the plant was built without one.
        """
        if not self.has_spare_obstacle:
            raise ValueError("the plant has no spare obstacle: build it with spare_obstacle=True")
        model = self.model
        geom = model.geom(SPARE_NAME).id
        model.geom_size[geom, 0] = model.geom_rbound[geom] = radius
        model.geom_aabb[geom] = (0.0, 0.0, 0.0, radius, radius, radius)
        model.geom_solref[geom] = fixed_contact(stiffness)
        self.data.mocap_pos[0] = position

    def remove_spare_obstacle(self) -> None:
        """Move it out of reach again."""
        self.data.mocap_pos[0] = SPARE_PLACE

    def _apply_pushes(self) -> None:
        data = self.data
        data.xfrc_applied[:] = 0.0
        for push in self._pushes:
            body = self.model.body(push.link).id
            # MuJoCo takes the force at the centre of mass.
            lever = data.xpos[body] + data.xmat[body].reshape(3, 3) @ push.point - data.xipos[body]
            data.xfrc_applied[body, :3] += push.force
            data.xfrc_applied[body, 3:] += np.cross(lever, push.force)

    def _apply_joint_settings(self) -> None:
        joints, scale = self._joints, self._friction_scale
        damping, friction = {
            Actuation.COMMANDED: (scale * joints.viscous_friction, scale * joints.coulomb_friction),
            Actuation.DAMPED_HOLD: (joints.hold_damping, scale * joints.coulomb_friction),
            Actuation.BRAKED: (scale * joints.viscous_friction, joints.brake_torque),
        }[self.actuation]
        # MuJoCo integrates joint damping implicitly, so the damped hold is stable whatever the inertia.
        self.model.dof_damping[self._arm] = damping
        self.model.dof_frictionloss[self._arm] = friction
        # Dry friction creeps the slower the nearer to 1 its impedance is; with MuJoCo's 0.9 a push of 10 N would move
        # the braked arm by 10 cm/s.
        impedance = _BRAKE_IMPEDANCE if self.actuation is Actuation.BRAKED else _IMPEDANCE
        self.model.dof_solimp[self._arm, :2] = impedance

    def _contact_rows(self) -> Iterator[tuple[int, int, list[float], list[float]]]:
        """Of each contact with the arm: its index, place of the body in `CONTACT_BODIES`, force and frame.

        All are plain numbers. The force (1,) or (3,), N, is normal and, with friction, tangential; the frame (9,) is
        what MuJoCo calls so: a rotation, row after row, whose first row is the normal.
        """
        data = self.data
        if data.ncon == 0:
            return
        # Plain numbers: arrays are slower for fewer than a dozen contacts. With an elliptic friction cone the rows of
        # a contact among the constraints are its force.
        contact, bodies, forces = data.contact, self._body_of_geom, data.efc_force.tolist()
        columns = (contact.geom, contact.efc_address, contact.dim, contact.frame)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for index, ((first, second), address, dim, frame) in enumerate(rows):
            body = max(bodies[first], bodies[second])
            # MuJoCo leaves out contacts without an address, which carry no force.
            if body >= 0 and address >= 0:
                yield index, body, forces[address : address + dim], frame

    def _contact_body_indices(self) -> list[int]:
        """For each geometry, its place in `CONTACT_BODIES`, or -1."""
        indices = []
        for geom in range(self.model.ngeom):
            name = self.model.body(self.model.geom_bodyid[geom]).name
            indices.append(CONTACT_BODIES.index(name) if name in CONTACT_BODIES else -1)
        return indices


_IMPEDANCE = 0.9
"""MuJoCo's own."""
_BRAKE_IMPEDANCE = 0.9999
