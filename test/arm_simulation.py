"""What several tests need: states of the arm, and a simulated one without noise and friction."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.references import Reference, References
from contact_reach_ros.control.settings import ControllerSettings, SupervisionSettings
from contact_reach_ros.simulation.plant import TICK, Actuation, Plant
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings, Scene
from contact_reach_ros.world.scene_file import SceneFile

ARM = load_arm("iiwa14")
TOOL = Tool(
    mass=2.0,
    center=(0.06, -0.03, 0.09),
    inertia=(0.01, 0.012, 0.006, 0.001, -0.002, 0.0005),
    flange_to_tip=(0.02, 0.0, 0.2, 0.3, -0.4, 0.5),
    radius=0.02,
)
WITH_TOOL = ARM.with_tool(TOOL)
HOME = np.array(ARM.home)
REST = np.zeros(ARM.n)
POSITION_LIMITS = np.array(ARM.upper)
VELOCITY_LIMITS = np.array(ARM.velocity_limits)
TORQUE_LIMITS = np.array(ARM.torque_limits)

TICK_NS = 1_000_000
SECOND_NS = 1_000_000_000

IDEAL = dataclasses.replace(NO_MISMATCH, noise_scale=0.0)
"""An arm that is exactly what the controller's model says, with ideal sensors."""
NO_FRICTION = (0.0, 0.0)


def rotation_about(axis: Sequence[float], angle: float) -> np.ndarray:
    """Rotation matrix (3, 3) about a unit axis by an angle in rad."""
    return pin.exp3(angle * np.asarray(axis, dtype=float))


def random_states(count: int, seed: int = 0, arm: Arm = ARM) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities, (count, n) each, within the limits."""
    random = np.random.default_rng(seed)
    positions = random.uniform(arm.lower, arm.upper, (count, arm.n))
    return positions, random.uniform(-arm.velocity_limits, arm.velocity_limits, (count, arm.n))


def mobility(model: RobotModel) -> np.ndarray:
    """J M⁻¹ Jᵀ, (6, 6), for the state of the last update."""
    return model.jacobian @ np.linalg.solve(model.mass_matrix, model.jacobian.T)


def ideal_plant(
    start: np.ndarray = HOME,
    obstacles: tuple[Obstacle, ...] = (),
    friction: tuple[float, float] = NO_FRICTION,
    mismatch: MismatchSettings = IDEAL,
    seed: int = 0,
) -> Plant:
    """The simulated arm at `start`; it is `IDEAL` unless told otherwise."""
    return Plant(Scene("test", ARM, seed, start, np.zeros(3), tuple(obstacles), mismatch=mismatch), friction)


def with_obstacle(file: SceneFile, **changes: Any) -> SceneFile:
    """The file with other settings of its only kind of obstacle."""
    (section,) = file.obstacles
    return dataclasses.replace(file, obstacles=(dataclasses.replace(section, **changes),))


def references_of(knots: list[Reference], stamp_ns: int, ends_ns: tuple[int, ...]) -> References:
    """The references of a plan with these knots."""
    positions = np.array([knot.position for knot in knots])
    rotations = np.array([knot.rotation for knot in knots])
    return References(stamp_ns, ends_ns, positions, rotations, np.array([knot.posture for knot in knots]))


FAR = {"max_position_error": 10.0, "max_rotation_error": 3.2, "max_posture_error": 7.0}
"""Settings of supervision for references at any distance."""

UNWATCHED = ControllerSettings(supervision=SupervisionSettings(require_observer=False, **FAR))
"""For controllers that nobody watches, and that may be pulled from afar."""


class ClosedLoop:
    """A controller and the simulated arm that it moves, in lockstep."""

    def __init__(
        self, plant: Plant, settings: ControllerSettings | None = None, late: int = 0, period: float = TICK
    ) -> None:
        """`late`: number of states by which each command acts later than it should; `period` of the states, s."""
        self.plant = plant
        self.controller = Controller(ARM, settings or UNWATCHED, period)
        self.torques: list[np.ndarray] = []
        self._late = late
        self._steps = round(period / TICK)
        plant.set_actuation(Actuation.COMMANDED)
        reading = plant.read()
        self.controller.start(reading.q, reading.v, self.now_ns)

    @property
    def now_ns(self) -> int:
        return self.plant.steps * TICK_NS

    @property
    def q(self) -> np.ndarray:
        return self.plant.data.qpos[: ARM.n].copy()

    @property
    def v(self) -> np.ndarray:
        return self.plant.data.qvel[: ARM.n].copy()

    def run(self, seconds: float, before_tick: Callable[[], None] | None = None) -> Iterator[None]:
        """Advance; the caller may look at the arm after each state."""
        for _ in range(round(seconds * SECOND_NS / TICK_NS / self._steps)):
            if before_tick is not None:
                before_tick()
            self.torques.append(self.controller.update(self.plant.read(), self.now_ns))
            for _ in range(self._steps):
                self.plant.step(self.torques[max(len(self.torques) - 1 - self._late, 0)])
            yield

    def finish(self, seconds: float) -> None:
        """Advance without looking."""
        for _ in self.run(seconds):
            pass

    def plan(self, knots: list[Reference], *ends_ns: int) -> None:
        """Give the controller a plan from now on."""
        self.controller.follow(references_of(knots, self.now_ns, ends_ns))

    def reference(self) -> Reference:
        """The pose and posture that the arm has."""
        position, rotation = self.controller.model.tip_pose(self.q)
        return Reference(position.copy(), rotation.copy(), self.q)
