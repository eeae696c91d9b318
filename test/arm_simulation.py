"""What several tests need: states of the arm, and a simulated one without noise and friction."""

from collections.abc import Callable, Iterator

import numpy as np

from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.law import Reference
from contact_reach_ros.control.reference import PoseKnots, PostureKnots
from contact_reach_ros.plant.plant import Actuation, Plant
from contact_reach_ros.plant.settings import JointSettings, SensorSettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.scene import NO_MISMATCH, Ball, MismatchSettings, Scene

HOME = np.array(iiwa14.HOME_POSITION)
REST = np.zeros(iiwa14.N_JOINTS)
POSITION_LIMITS = np.array(iiwa14.POSITION_LIMITS)
VELOCITY_LIMITS = np.array(iiwa14.VELOCITY_LIMITS)
TORQUE_LIMITS = np.array(iiwa14.TORQUE_LIMITS)

TICK_NS = 1_000_000
SECOND_NS = 1_000_000_000

IDEAL_SENSORS = SensorSettings(position_noise=0.0, position_resolution=0.0, velocity_noise=0.0, torque_noise=0.0)
NO_FRICTION = JointSettings(viscous_friction=0.0, coulomb_friction=0.0)


def random_states(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities, (count, 7) each, within the limits."""
    random = np.random.default_rng(seed)
    shape = (count, iiwa14.N_JOINTS)
    return random.uniform(-POSITION_LIMITS, POSITION_LIMITS, shape), random.uniform(
        -VELOCITY_LIMITS, VELOCITY_LIMITS, shape
    )


def mobility(model: RobotModel) -> np.ndarray:
    """J M⁻¹ Jᵀ, (6, 6), for the state of the last update."""
    return model.jacobian @ np.linalg.solve(model.mass_matrix, model.jacobian.T)


def null_space_projection(model: RobotModel) -> np.ndarray:
    """N of law (2), (7, 7), for the state of the last update, which must not be singular."""
    inverse_mass, jacobian = np.linalg.inv(model.mass_matrix), model.jacobian
    return np.eye(iiwa14.N_JOINTS) - inverse_mass @ jacobian.T @ np.linalg.inv(mobility(model)) @ jacobian


def ideal_plant(
    start: np.ndarray = HOME,
    balls: tuple[Ball, ...] = (),
    sensors: SensorSettings = IDEAL_SENSORS,
    joints: JointSettings = NO_FRICTION,
    mismatch: MismatchSettings = NO_MISMATCH,
    seed: int = 0,
) -> Plant:
    """The simulated arm at `start`; it is exactly what the controller's model says unless told otherwise."""
    return Plant(Scene("test", seed, start, np.zeros(3), balls, mismatch=mismatch), sensors, joints)


def offer_plan(
    controller: Controller, references: list[Reference], stamp_ns: int, ends_ns: tuple[int, ...], now_ns: int
) -> None:
    """Give the controller both halves of a plan."""
    positions = np.array([reference.position for reference in references])
    rotations = np.array([reference.rotation for reference in references])
    postures = np.array([reference.posture for reference in references])
    controller.references.offer_poses(PoseKnots(stamp_ns, ends_ns, positions, rotations), now_ns)
    controller.references.offer_postures(PostureKnots(stamp_ns, ends_ns, postures), now_ns)


class ClosedLoop:
    """A controller and the simulated arm that it moves, in lockstep."""

    def __init__(self, plant: Plant, settings: ControllerSettings | None = None, late: int = 0) -> None:
        """`late`: number of ticks by which each command acts later than it should."""
        self.plant = plant
        self.controller = Controller(settings or ControllerSettings(), RobotModel())
        self.torques: list[np.ndarray] = []
        self._late = late
        plant.set_actuation(Actuation.COMMANDED)
        reading = plant.read()
        self.controller.start(reading.position, reading.velocity, self.now_ns)

    @property
    def now_ns(self) -> int:
        return self.plant.steps * TICK_NS

    @property
    def q(self) -> np.ndarray:
        return self.plant.data.qpos[: iiwa14.N_JOINTS].copy()

    @property
    def v(self) -> np.ndarray:
        return self.plant.data.qvel[: iiwa14.N_JOINTS].copy()

    def run(self, seconds: float, before_tick: Callable[[], None] | None = None) -> Iterator[None]:
        """Advance; the caller may look at the arm after each tick."""
        for _ in range(round(seconds * SECOND_NS / TICK_NS)):
            if before_tick is not None:
                before_tick()
            reading = self.plant.read()
            torque = self.controller.tick(reading.position, reading.velocity, self.now_ns, self.now_ns)
            self.torques.append(torque)
            self.plant.step(self.torques[max(len(self.torques) - 1 - self._late, 0)])
            yield

    def finish(self, seconds: float) -> None:
        """Advance without looking."""
        for _ in self.run(seconds):
            pass

    def reference(self) -> Reference:
        """The pose and posture that the arm has."""
        position, rotation = self.controller.model.flange_pose(self.q)
        return Reference(position.copy(), rotation.copy(), self.q)
