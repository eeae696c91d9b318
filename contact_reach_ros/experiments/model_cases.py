"""Motions of the simulated robot that the planner's transfer model is measured against: what is drawn, what it does."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from contact_reach_ros.control.law import ImpedanceLaw, Reference, pose_error
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.objectives import action_bounds
from contact_reach_ros.planning.obstacles import clearances
from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.pipeline import N_ACTION
from contact_reach_ros.plant.plant import TICK, Actuation, Plant
from contact_reach_ros.plant.settings import JointSettings, SensorSettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.free_path import MIN_MOBILITY
from contact_reach_ros.scenes.scene import Ball, BallSettings, Scene
from contact_reach_ros.scenes.spheres import obstacle_spheres, rest_positions

Array = NDArray[np.float64]

_LIMIT_MARGIN = 0.3
_START_SPEED = 0.2
_GAP = 0.001


@dataclass(frozen=True, eq=False)
class Case:
    """One start state with its actions and, unless it is None, a ball."""

    q: Array
    """(7,), rad."""
    v: Array
    """(7,), rad/s."""
    actions: Array
    """(H, 13)."""
    ball: Ball | None

    @property
    def scene(self) -> Scene:
        """The arm at `q` and the ball."""
        return Scene("case", 0, self.q, np.zeros(3), () if self.ball is None else (self.ball,))

    @property
    def spheres(self) -> Spheres:
        """What a planner is told of the ball."""
        return obstacle_spheres(self.scene, rest_positions(self.scene))


@dataclass(frozen=True, eq=False)
class Motion:
    """What became of the arm."""

    positions: Array
    """(H, 3) flange at the ends of the knots, m."""
    rotations: Array
    """(H, 3, 3)."""
    speed: float
    """Of the fastest joint, rad/s."""
    margin: float
    """Of the joint nearest to its limit, rad."""
    eigenvalue: float
    """Smallest of J M⁻¹ Jᵀ on the way, 1/kg."""
    forces: Array
    """(H, 6) sum of the normal forces on each capsule, largest value within the knot, N."""


def simulate(case: Case) -> Motion:
    """The simulated robot under the actions, latched as the controller latches them."""
    joints = JointSettings(viscous_friction=0.0, coulomb_friction=0.0)
    plant = Plant(case.scene, SensorSettings(), joints)
    plant.set_actuation(Actuation.COMMANDED)
    data = plant.data
    data.qvel[: iiwa14.N_JOINTS] = case.v
    law, model = ImpedanceLaw(ImpedanceSettings()), RobotModel()
    positions, rotations, forces = [], [], []
    limits = np.array(iiwa14.POSITION_LIMITS)
    speed, margin, eigenvalue = 0.0, np.inf, np.inf
    for action in case.actions:
        q, v = data.qpos[: iiwa14.N_JOINTS], data.qvel[: iiwa14.N_JOINTS]
        model.update(q, v)
        rotation = pin.exp3(action[3:6]) @ model.rotation
        reference = Reference(model.position + action[:3], rotation, q + action[6:])
        force = np.zeros(len(iiwa14.CAPSULES))
        for tick in range(round(PlanningSettings().knot_duration / TICK)):
            model.update(q, v)
            error = pose_error(model.position, model.rotation, reference)
            plant.step(law.torque(model, v, q - reference.posture, error) + model.bias)
            force = np.maximum(force, plant.normal_forces())
            speed = max(speed, float(np.abs(v).max()))
            margin = min(margin, float((limits - np.abs(q)).min()))
            if tick % 10 == 0:
                eigenvalue = min(eigenvalue, model.smallest_mobility())
        model.update(q, v)
        positions.append(model.position.copy())
        rotations.append(model.rotation.copy())
        forces.append(force)
    return Motion(np.array(positions), np.array(rotations), speed, margin, eigenvalue, np.array(forces))


def draw_free(random: np.random.Generator, count: int) -> list[Case]:
    """States away from singularities and joint limits, actions anywhere within their bounds."""
    return [_draw(random) for _ in range(count)]


def _draw(random: np.random.Generator) -> Case:
    settings = PlanningSettings()
    limits = np.array(iiwa14.POSITION_LIMITS) - _LIMIT_MARGIN
    bounds = action_bounds(settings).reshape(settings.horizon, N_ACTION)
    model = _model()
    while True:
        q = random.uniform(-limits, limits)
        model.update(q, np.zeros_like(q))
        if model.smallest_mobility() >= MIN_MOBILITY:
            break
    v = random.normal(0.0, _START_SPEED, iiwa14.N_JOINTS)
    return Case(q, v, random.uniform(-1.0, 1.0, bounds.shape) * bounds, None)


@functools.cache
def _model() -> RobotModel:
    return RobotModel()


def draw_contact(random: np.random.Generator, count: int, settings: BallSettings) -> list[Case]:
    """The same with a ball next to a link, in the way of where the actions lead that link."""
    cases: list[Case] = []
    while len(cases) < count:
        case = _draw(random)
        ball = _ball_in_the_way(random, case, settings)
        if ball is not None:
            cases.append(Case(case.q, np.zeros(iiwa14.N_JOINTS), case.actions, ball))
    return cases


def _ball_in_the_way(random: np.random.Generator, case: Case, settings: BallSettings) -> Ball | None:
    """A ball just off a middle link, on the side that the actions' posture change moves it to."""
    capsule = iiwa14.CAPSULES[int(random.integers(1, 5))]
    along = np.asarray(capsule.start) + random.uniform() * np.subtract(capsule.end, capsule.start)

    def point(q: Array) -> tuple[Array, Array]:
        rotations, origins = link_frames(q)
        rotation, origin = rotations[capsule.link - 1], origins[capsule.link - 1]
        return origin + rotation @ along, rotation @ np.subtract(capsule.end, capsule.start)

    here, axis = point(case.q)
    direction = point(case.q + 0.1 * case.actions[:, 6:].sum(axis=0))[0] - here
    direction -= axis * (direction @ axis) / (axis @ axis)
    length = float(np.linalg.norm(direction))
    if length < 1e-3:
        return None
    ball = Ball(here + (capsule.radius + settings.radius + _GAP) * direction / length, settings)
    return ball if clearances(case.q, Case(case.q, case.v, case.actions, ball).spheres)[0] > 0.5 * _GAP else None
