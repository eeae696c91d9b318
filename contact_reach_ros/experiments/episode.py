"""One episode in this process, in lockstep and without ROS: the very objects that the nodes run.

The same arguments give the same result, bit for bit, as long as the planner has no wall-clock deadline.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.baselines.method import Method
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings
from contact_reach_ros.observer.safety import SafetyMonitor, SafetySettings
from contact_reach_ros.planning.problem import Goal, Plan
from contact_reach_ros.plant.drive import Drive, WatchdogSettings
from contact_reach_ros.plant.plant import CONTACT_BODIES, TICK, Plant, Reading
from contact_reach_ros.plant.settings import JointSettings, SensorSettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.scene import Scene
from contact_reach_ros.scenes.spheres import obstacle_spheres
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

_TICK_NS = int(TICK * NANOSECONDS)


@dataclass(frozen=True)
class EpisodeOptions:
    """How an episode is run.

    Attributes
    ----------
    period, latency
        Least time between plans, and from a state to the effect of its plan, s.
    settle
        Time before the goal is given, s; the brakes open within it.
    timeout
        Time to reach the goal, s.
    success
        Distance that counts as reached, m.
    hold_orientation
        Whether the goal holds the orientation of the start; otherwise it is left free.
    noise_seed
        Of the sensor noise; that of the scene if there is none.
    """

    period: float = 0.04
    latency: float = 0.04
    settle: float = 0.8
    timeout: float = 20.0
    success: float = 0.01
    hold_orientation: bool = True
    noise_seed: int | None = None
    budget: ContactBudget = field(default_factory=ContactBudget)
    sensors: SensorSettings = field(default_factory=SensorSettings)
    joints: JointSettings = field(default_factory=JointSettings)


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """What happened, from the moment the goal was given.

    Attributes
    ----------
    duration
        Time until the goal was reached, s; NaN if it was not.
    start_position
        (3,) where the flange was before, m.
    positions
        (n, 3) of the flange after each tick, m.
    joints
        (n, 7) joint angles, rad.
    link_forces
        (n, 6) contact force on each of `CONTACT_BODIES`, N.
    external_torques
        (n, 7) residuals, Nm.
    torques
        (n, 7) commanded, Nm.
    distances
        (n,) of the flange from the target, m.
    stop_reason
        Empty if nothing stopped the arm.
    failure
        Why there is no plan, if there is none; the episode ends with it.
    plans
        All plans in order.
    """

    duration: float
    start_position: Array
    positions: Array
    joints: Array
    link_forces: Array
    external_torques: Array
    torques: Array
    distances: Array
    stop_reason: str
    failure: str
    plans: list[Plan]

    @property
    def contact_forces(self) -> Array:
        """(n,) largest on one body, N."""
        return self.link_forces.max(axis=1)

    @property
    def reached(self) -> bool:
        """Whether the goal was reached and nothing stopped the arm."""
        return bool(np.isfinite(self.duration)) and not self.stop_reason


def run_episode(
    scene: Scene,
    method: Method,
    options: EpisodeOptions,
    watch: Callable[[int, Plant], None] | None = None,
) -> EpisodeResult:
    """Run one episode until the goal is reached, the arm is stopped or the time is over.

    Parameters
    ----------
    scene
        With target and obstacles.
    method
        With room for the scene's obstacles; it forgets what it did before.
    options
        Everything else.
    watch
        Called after each tick with its number and the plant.
    """
    plant = Plant(scene, options.sensors, options.joints, options.noise_seed)
    drive = Drive(plant, WatchdogSettings())
    observer = MomentumObserver(MomentumSettings(), RobotModel())
    monitor = SafetyMonitor(SafetySettings(), options.budget)
    reading = plant.read()
    method.start(reading.position, reading.velocity, 0)
    _, rotation = RobotModel().flange_pose(reading.position)
    goal = Goal(scene.target, rotation if options.hold_orientation else None)

    settle_ticks, period_ticks = round(options.settle / TICK), round(options.period / TICK)
    latency_ns = round(options.latency * NANOSECONDS)
    plans: list[Plan] = []
    positions, joints, forces, residuals, torques, distances = [], [], [], [], [], []
    duration, failure = float("nan"), ""
    start_position = plant.flange_position
    for tick in range(settle_ticks + round(options.timeout / TICK)):
        now_ns = tick * _TICK_NS
        if tick >= settle_ticks and (tick - settle_ticks) % period_ticks == 0:
            spheres = obstacle_spheres(scene, plant.obstacle_positions())
            try:
                plan = method.plan(reading.position, reading.velocity, now_ns, now_ns + latency_ns, goal, spheres)
            except PlanningError as error:
                failure = str(error)
                break
            plans.append(plan)
        torque = method.torque(reading.position, reading.velocity, now_ns)
        drive.command(torque, now_ns)
        drive.tick(now_ns)
        reading = plant.read()
        observer.update(reading.position, reading.velocity, _known(reading), now_ns + _TICK_NS)
        monitor.update(observer.residual, reading.velocity, observer.known_for)
        method.observer_report(monitor.stop_reason, now_ns)
        if watch is not None:
            watch(tick, plant)
        if tick >= settle_ticks:
            positions.append(plant.flange_position)
            joints.append(plant.data.qpos[: iiwa14.N_JOINTS].copy())
            forces.append(plant.contact_forces())
            residuals.append(observer.residual)
            torques.append(torque)
            distances.append(float(np.linalg.norm(positions[-1] - scene.target)))
            if distances[-1] <= options.success:
                duration = (tick - settle_ticks + 1) * TICK
                break
        if method.stop_reason:
            break
    return EpisodeResult(
        duration=duration,
        start_position=start_position,
        positions=np.reshape(positions, (-1, 3)),
        joints=np.reshape(joints, (-1, iiwa14.N_JOINTS)),
        link_forces=np.reshape(forces, (-1, len(CONTACT_BODIES))),
        external_torques=np.reshape(residuals, (-1, iiwa14.N_JOINTS)),
        torques=np.reshape(torques, (-1, iiwa14.N_JOINTS)),
        distances=np.array(distances),
        stop_reason=method.stop_reason,
        failure=failure,
        plans=plans,
    )


def _known(reading: Reading) -> Array | None:
    return reading.torque if np.isfinite(reading.torque.sum()) else None
