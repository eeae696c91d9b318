"""Motions of the simulated robot that the planner's transfer model is measured against: what is drawn, what it does."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arrays import Array
from contact_reach_ros.control.law import ImpedanceLaw, blend, pose_error
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.objectives import knot_bounds
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.simulation.plant import TICK, Actuation, Plant
from contact_reach_ros.simulation.settings import JointSettings, SensorSettings
from contact_reach_ros.world.clearance import clearances
from contact_reach_ros.world.free_path import MIN_MOBILITY
from contact_reach_ros.world.kinds.ball import BallSettings
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

_LIMIT_MARGIN = 0.3
_START_SPEED = 0.2
_GAP = 0.001


@dataclass(frozen=True, eq=False)
class Case:
    """One start state with its actions and, unless it is None, a ball."""

    arm: Arm
    q: Array
    """(n,), rad."""
    v: Array
    """(n,), rad/s."""
    actions: Array
    """(H, 6 + n)."""
    ball: Obstacle | None

    @property
    def scene(self) -> Scene:
        """The arm at `q` and the ball."""
        return Scene("case", self.arm, 0, self.q, np.zeros(3), () if self.ball is None else (self.ball,))

    @property
    def spheres(self) -> Spheres:
        """The ball as a planner sees it."""
        return obstacle_spheres(self.scene, rest_positions(self.scene))


@dataclass(frozen=True, eq=False)
class Motion:
    """How the arm moved."""

    positions: Array
    """(H, 3) tip at the ends of the knots, m."""
    rotations: Array
    """(H, 3, 3)."""
    joints: Array
    """(H, n), rad."""
    speed_share: float
    """Speed of the fastest joint as a share of the arm's highest speed limit."""
    margin: float
    """Of the joint nearest to its limit, rad."""
    eigenvalue: float
    """Smallest of J M⁻¹ Jᵀ on the way, 1/kg."""
    forces: Array
    """(H, L) sum of the normal forces on each of `contact_links`, largest value within the knot, N."""


def simulate(case: Case) -> Motion:
    """The simulated robot under the actions, latched as the controller latches them."""
    return simulate_from(case.scene, case.v, case.actions)


def simulate_from(
    scene: Scene, v: Array, actions: Array, before: Reference | None = None, spheres: Array | None = None
) -> Motion:
    """The simulated robot from the start of a scene with the speeds `v` (n,), under the actions (H, 6 + n).

    Parameters
    ----------
    before
        Reference in force at the start; by default that of a hold.
    spheres
        (K, 3) positions of the obstacles' spheres at the start, m; by default at rest.
    """
    arm = scene.arm
    plant = Plant(scene, SensorSettings(), JointSettings(viscous_friction=0.0, coulomb_friction=0.0))
    plant.set_actuation(Actuation.COMMANDED)
    if spheres is not None:
        plant.place_obstacles(spheres)
    data = plant.data
    data.qvel[: arm.n] = v
    gains = ImpedanceSettings()
    law, model = ImpedanceLaw(arm, gains), RobotModel(arm)
    before = before or Reference(*model.tip_pose(scene.start), scene.start)
    positions, rotations, joints, forces = [], [], [], []
    speed, margin, eigenvalue = 0.0, np.inf, np.inf
    for action in actions:
        q, v = data.qpos[: arm.n], data.qvel[: arm.n]
        ahead = q + 0.5 * gains.reference_ramp * v
        position, rotation = model.tip_pose(ahead)
        knot = Reference(position + action[:3], pin.exp3(action[3:6]) @ rotation, ahead + action[6:])
        force = np.zeros(len(plant.contact_links))
        for tick in range(round(PlanningSettings().knot_duration / TICK)):
            share = min(1.0, tick * TICK / gains.reference_ramp) if gains.reference_ramp else 1.0
            reference = blend(before, knot, share)
            model.update(q, v)
            error = pose_error(model.position, model.rotation, reference)
            plant.step(law.torque(model, v, q - reference.posture, error) + model.bias)
            force = np.maximum(force, plant.normal_forces())
            speed = max(speed, float(np.abs(v).max()))
            margin = min(margin, float(np.minimum(arm.upper - q, q - arm.lower).min()))
            if tick % 10 == 0:
                eigenvalue = min(eigenvalue, model.smallest_mobility())
        before = knot
        model.update(q, v)
        positions.append(model.position.copy())
        rotations.append(model.rotation.copy())
        joints.append(q.copy())
        forces.append(force)
    share = speed / max(arm.velocity_limits)
    return Motion(
        np.array(positions), np.array(rotations), np.array(joints), share, margin, eigenvalue, np.array(forces)
    )


def draw_free(arm: Arm, random: np.random.Generator, count: int) -> list[Case]:
    """States away from singularities and joint limits, actions anywhere within their bounds."""
    return [_draw(arm, random) for _ in range(count)]


def _draw(arm: Arm, random: np.random.Generator) -> Case:
    settings = PlanningSettings()
    bounds = np.tile(knot_bounds(arm, settings), (settings.horizon, 1))
    model = _model(arm)
    while True:
        q = random.uniform(arm.lower + _LIMIT_MARGIN, arm.upper - _LIMIT_MARGIN)
        model.update(q, np.zeros_like(q))
        if model.smallest_mobility() >= MIN_MOBILITY:
            break
    v = random.normal(0.0, _START_SPEED, arm.n)
    return Case(arm, q, v, random.uniform(-1.0, 1.0, bounds.shape) * bounds, None)


@functools.cache
def _model(arm: Arm) -> RobotModel:
    return RobotModel(arm)


def draw_contact(arm: Arm, random: np.random.Generator, count: int, settings: BallSettings) -> list[Case]:
    """Such states at rest, with a ball next to a link, in the way of where the actions lead that link."""
    cases: list[Case] = []
    while len(cases) < count:
        case = _draw(arm, random)
        case = dataclasses.replace(case, v=np.zeros(arm.n), ball=_ball_in_the_way(random, case, settings))
        # Not in the arm, which may be wider elsewhere.
        if case.ball is not None and clearances(arm, case.q, case.spheres)[0] > 0.5 * _GAP:
            cases.append(case)
    return cases


def _ball_in_the_way(random: np.random.Generator, case: Case, settings: BallSettings) -> Obstacle | None:
    """A ball just off a middle link, on the side that the actions' posture change moves it to."""
    capsule = case.arm.capsules[int(random.integers(1, len(case.arm.capsules) - 1))]
    along = np.asarray(capsule.start) + random.uniform() * np.subtract(capsule.end, capsule.start)

    def point(q: Array) -> tuple[Array, Array]:
        rotations, origins = link_frames(case.arm, q)
        rotation, origin = rotations[capsule.link - 1], origins[capsule.link - 1]
        return origin + rotation @ along, rotation @ np.subtract(capsule.end, capsule.start)

    here, axis = point(case.q)
    direction = point(case.q + 0.1 * case.actions[:, 6:].sum(axis=0))[0] - here
    direction -= axis * (direction @ axis) / (axis @ axis)
    length = float(np.linalg.norm(direction))
    if length < 1e-3:
        return None
    (ball,) = settings.at(here + (capsule.radius + settings.radius + _GAP) * direction / length)
    return ball
