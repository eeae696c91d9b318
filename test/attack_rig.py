"""A whole `Stack` around the simulated robot, and bodies that it is not told of: what a person would feel."""

import dataclasses
from collections.abc import Callable

import numpy as np
from plans import make_plan

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import InputError
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.settings import UnexpectedContactSettings
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.goal import Goal
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings, Scene
from contact_reach_ros.world.spheres import Spheres

ARM = load_arm("iiwa14")
HOME = np.array(ARM.home)
HAND, FOREARM, CHEST, ABDOMEN = 75e3, 40e3, 25e3, 10e3
"""Stiffness of body parts, N/m (ISO/TS 15066, annex A)."""


class Ahead:
    """Plans whose x_d is `lead` m ahead of the tip on the way to the goal, orientation and posture held."""

    memory = None

    def __init__(self, lead: float = 0.0173, change: Callable[[Plan, Request], Plan] | None = None) -> None:
        """`change` replaces a plan."""
        self.model, self._lead, self._change = RobotModel(ARM), lead, change
        self._rotation: np.ndarray | None = None

    def warm_up(self, progress) -> None:
        pass

    def reset(self) -> None:
        self._rotation = None

    def reseed(self, seed: int) -> None:
        pass

    def plan(self, request: Request) -> Plan:
        model = self.model
        model.update(request.q, request.v)
        if self._rotation is None:
            self._rotation = model.rotation.copy()
        way = request.goal.position - model.position
        distance = max(float(np.linalg.norm(way)), 1e-9)
        lead = self._lead * request.speed_scale
        delay = 1e-9 * (request.effect_ns - request.state_ns) + 0.015
        carried = model.twist[:3] * delay * (distance > lead)
        knots = np.arange(3)[:, None]
        steps = np.minimum(lead * (1.0 + 0.9 * knots), distance)
        plan = make_plan(
            model.position + carried + steps * way / distance,
            np.repeat(self._rotation[None], 3, axis=0),
            np.repeat(request.q[None], 3, axis=0),
            effect_ns=request.effect_ns,
            knot_duration_s=0.1,
            speed_scale=request.speed_scale,
        )
        return plan if self._change is None else self._change(plan, request)


@dataclasses.dataclass
class Body:
    """A frictionless spring that a point of a link presses against `normal`; it stands in the world.

    Attributes
    ----------
    link, point
        What touches it: the link and the point (3,), m, in its frame.
    surface, normal
        A point of the surface (3,), m, and the unit vector out of it.
    stiffness, damping
        N/m and N s/m.
    force
        What it is pressed with, N.
    """

    link: str
    point: np.ndarray
    surface: np.ndarray
    normal: np.ndarray
    stiffness: float
    damping: float = 50.0
    force: float = 0.0
    before: float | None = None


class Rig:
    """The stack, the robot that it moves, and bodies in the way."""

    def __init__(
        self,
        start: np.ndarray = HOME,
        core: Ahead | None = None,
        mismatch: MismatchSettings = NO_MISMATCH,
        true_arm: Arm = ARM,
        known: Spheres | None = None,
        reaction: str = "give way",
        **others,
    ) -> None:
        """`known`: obstacles that are published; `others` of `Stack`."""
        scene = Scene("attack", true_arm, 0, np.array(start, float), np.zeros(3), mismatch=mismatch)
        self.robot = SimulatedRobot(scene)
        self.plant = self.robot.plant
        self.robot.obstacles = lambda: known or Spheres.none()
        belief = dataclasses.replace(scene, arm=ARM)
        reacts = UnexpectedContactSettings(reaction=reaction)
        self.stack = Stack(belief, planner=core or Ahead(), robot=self.robot, unexpected_contact=reacts, **others)
        self.bodies: list[Body] = []
        self.pushes: list[tuple[str, np.ndarray, np.ndarray]] = []
        self.forces: list[float] = []

    @property
    def force(self) -> float:
        """Largest force that a body feels, N."""
        return max((body.force for body in self.bodies), default=0.0)

    @property
    def reason(self) -> str:
        """Why the arm is stopped."""
        return self.stack.stop_reason

    @property
    def mode(self) -> str:
        """Mode of the controller."""
        return self.stack.controller.mode.value

    @property
    def ended(self) -> str:
        """Why the goal has ended."""
        state = self.stack.planner.goal_state
        return "" if state is None else state.reason

    def place(self, link: str, point: np.ndarray) -> np.ndarray:
        """Where a point (3,), m, of a link is, m."""
        body = self.plant.model.body(link).id
        return self.plant.data.xpos[body] + self.turn(link) @ point

    def turn(self, link: str) -> np.ndarray:
        """Rotation (3, 3) of a link."""
        return self.plant.data.xmat[self.plant.model.body(link).id].reshape(3, 3)

    def add_body(self, link: str, point: np.ndarray, normal: np.ndarray, gap: float, stiffness: float) -> Body:
        """Put a body `gap` m from a point of a link."""
        normal = np.array(normal, float) / np.linalg.norm(normal)
        body = Body(link, np.array(point, float), self.place(link, point) - gap * normal, normal, stiffness)
        self.bodies.append(body)
        return body

    def step(self) -> None:
        """Advance by 1 ms."""
        pushes = list(self.pushes)
        for body in self.bodies:
            depth = float((body.surface - self.place(body.link, body.point)) @ body.normal)
            rate = 0.0 if body.before is None else (depth - body.before) / 0.001
            body.before = depth
            body.force = max(body.stiffness * depth + body.damping * rate, 0.0) if depth > 0.0 else 0.0
            pushes.append((body.link, body.force * body.normal, body.point))
        self.plant.set_pushes(pushes)
        self.stack.step()
        self.forces.append(self.force)

    def run(self, seconds: float, until: Callable[[], object] = lambda: False) -> bool:
        """Advance; returns whether `until` ended it."""
        for _ in range(round(1000 * seconds)):
            self.step()
            if until():
                return True
        return False

    def settle(self) -> None:
        """Hand the arm over."""
        self.run(0.8)

    def go(self, way: np.ndarray) -> None:
        """Send a goal `way` (3,), m, from the tip, or as far as there is a posture for it."""
        for share in np.linspace(1.0, 0.1, 10):
            try:
                return self.stack.command(Goal((self.plant.tip_position + share * np.array(way)).tolist(), "hold"))
            except InputError:
                continue
        raise AssertionError("no goal is in reach")

    def rest(self) -> float:
        """Speed of the fastest joint, rad/s."""
        return float(np.abs(self.plant.data.qvel[: ARM.n]).max())
