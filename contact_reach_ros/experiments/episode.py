"""One episode in this process, in lockstep and without ROS: the very objects that the nodes run.

The same arguments give the same result, bit for bit, as long as the planner has no wall-clock deadline.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.controller import Controller, ControllerSettings, Mode
from contact_reach_ros.control.reference import PoseKnots, PostureKnots
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings
from contact_reach_ros.observer.safety import SafetyMonitor, SafetySettings
from contact_reach_ros.planning.problem import Goal, Plan
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.plant.drive import Drive, WatchdogSettings
from contact_reach_ros.plant.plant import TICK, Plant, Reading
from contact_reach_ros.plant.settings import JointSettings, MismatchSettings, SensorSettings
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
    """

    period: float = 0.04
    latency: float = 0.04
    settle: float = 0.8
    timeout: float = 20.0
    success: float = 0.01
    hold_orientation: bool = True
    budget: ContactBudget = field(default_factory=ContactBudget)
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    sensors: SensorSettings = field(default_factory=SensorSettings)
    joints: JointSettings = field(default_factory=JointSettings)
    mismatch: MismatchSettings = field(default_factory=MismatchSettings)


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """What happened, from the moment the goal was given.

    Attributes
    ----------
    duration
        Time until the goal was reached, s; NaN if it was not.
    distances
        (n,) of the flange from the target at each tick, m.
    contact_forces
        (n,) largest on one body, N.
    external_torques
        (n, 7) residuals, Nm.
    stop_reason
        Empty if nothing stopped the arm.
    plans
        All plans in order.
    """

    duration: float
    distances: Array
    contact_forces: Array
    external_torques: Array
    stop_reason: str
    plans: list[Plan]

    @property
    def reached(self) -> bool:
        """Whether the goal was reached and nothing stopped the arm."""
        return bool(np.isfinite(self.duration)) and not self.stop_reason


def run_episode(
    scene: Scene,
    planner: RecedingHorizonPlanner,
    options: EpisodeOptions,
    watch: Callable[[int, Plant], None] | None = None,
) -> EpisodeResult:
    """Run one episode until the goal is reached, the arm is stopped or the time is over.

    Parameters
    ----------
    scene
        With target and obstacles.
    planner
        With room for the scene's obstacles; it is reset first.
    options
        Everything else.
    watch
        Called after each tick with its number and the plant.
    """
    plant = Plant(scene, options.sensors, options.joints, options.mismatch)
    drive = Drive(plant, WatchdogSettings())
    controller = Controller(options.controller, RobotModel())
    observer = MomentumObserver(MomentumSettings(), RobotModel())
    monitor = SafetyMonitor(SafetySettings(), options.budget)
    planner.reset()
    reading = plant.read()
    controller.start(reading.position, reading.velocity, 0)
    _, rotation = controller.model.flange_pose(reading.position)
    goal = Goal(scene.target, rotation if options.hold_orientation else None)

    settle_ticks, period_ticks = round(options.settle / TICK), round(options.period / TICK)
    latency_ns = round(options.latency * NANOSECONDS)
    plans: list[Plan] = []
    distances, forces, torques = [], [], []
    duration = float("nan")
    for tick in range(settle_ticks + round(options.timeout / TICK)):
        now_ns = tick * _TICK_NS
        if tick >= settle_ticks and (tick - settle_ticks) % period_ticks == 0:
            spheres = obstacle_spheres(scene, plant.obstacle_positions())
            plan = planner.plan(reading.position, reading.velocity, now_ns, now_ns + latency_ns, goal, spheres)
            plans.append(plan)
            _offer(controller, plan, now_ns)
        drive.command(controller.tick(reading.position, reading.velocity, now_ns, now_ns), now_ns)
        drive.tick(now_ns)
        reading = plant.read()
        observer.update(reading.position, reading.velocity, _known(reading), now_ns + _TICK_NS)
        monitor.update(observer.residual, reading.velocity)
        controller.observer_report(monitor.stop_reason, now_ns)
        if watch is not None:
            watch(tick, plant)
        if tick >= settle_ticks:
            distances.append(float(np.linalg.norm(plant.flange_position - scene.target)))
            forces.append(float(plant.contact_forces().max()))
            torques.append(observer.residual)
            if distances[-1] <= options.success:
                duration = (tick - settle_ticks + 1) * TICK
                break
        if controller.mode is Mode.STOPPED:
            break
    return EpisodeResult(
        duration=duration,
        distances=np.array(distances),
        contact_forces=np.array(forces),
        external_torques=np.array(torques),
        stop_reason=controller.stop_reason,
        plans=plans,
    )


def _offer(controller: Controller, plan: Plan, now_ns: int) -> None:
    knot_ns = round(plan.knot_duration_s * NANOSECONDS)
    ends = tuple((index + 1) * knot_ns for index in range(len(plan.positions)))
    controller.references.offer_poses(PoseKnots(plan.effect_ns, ends, plan.positions, plan.rotations), now_ns)
    controller.references.offer_postures(PostureKnots(plan.effect_ns, ends, plan.postures), now_ns)


def _known(reading: Reading) -> Array | None:
    return reading.torque if np.isfinite(reading.torque.sum()) else None
