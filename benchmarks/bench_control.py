"""`contact-reach bench control`: what one tick of controller and observer costs, arithmetic only."""

from __future__ import annotations

import gc
import time
from pathlib import Path

import numpy as np

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.arms import load_arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.references import References
from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.experiments.output import write_report
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.stop_reasons import Verdict
from contact_reach_ros.timing import Histogram
from contact_reach_ros.units import NANOSECONDS

_TICK_NS = 1_000_000
_WARM_UP = 500


def bench_control(ticks: int, file: Path | None) -> dict[str, dict[str, float]]:
    """Time `ticks` ticks along a moving trajectory with a plan in force; print a table and write JSON to `file`."""
    random = np.random.default_rng(0)
    arm = load_arm()
    # One plan for the whole trajectory, which does not stay as near to it as a planner's.
    bounds = SupervisionSettings(
        max_plan_duration=60.0, max_position_error=10.0, max_rotation_error=3.2, max_posture_error=7.0
    )
    controller = Controller(arm, ControllerSettings(supervision=bounds))
    observer = Observer(arm, ObserverSettings(), load_budget())
    home, rest = np.array(arm.home), np.zeros(arm.n)
    controller.hear(Verdict(), -_TICK_NS)
    controller.update(JointState(-_TICK_NS, home, rest, None), -_TICK_NS)
    position, rotation = controller.model.tip_pose(home)
    end_ns = (ticks + _WARM_UP + 1) * _TICK_NS
    controller.follow(References(0, (end_ns,), position[None], rotation[None], home[None]))
    torque: Array | None = np.full(arm.n, np.nan)
    times = {"controller": Histogram(), "observer": Histogram()}
    gc.collect()
    gc.disable()
    try:
        for tick in range(ticks + _WARM_UP):
            now_ns = tick * _TICK_NS
            phase = now_ns / NANOSECONDS + np.arange(arm.n)
            q = home + 0.2 * np.sin(phase)
            v = 0.2 * np.cos(phase) + 1e-3 * random.standard_normal(arm.n)
            state = JointState(now_ns, q, v, torque)
            began_ns = time.perf_counter_ns()
            torque = controller.update(state, now_ns)
            between_ns = time.perf_counter_ns()
            seen = observer.update(state)
            ended_ns = time.perf_counter_ns()
            if seen is not None and seen.due:
                controller.hear(seen.verdict, now_ns)
            if tick >= _WARM_UP:
                times["controller"].add(between_ns - began_ns)
                times["observer"].add(ended_ns - between_ns)
    finally:
        gc.enable()
    report = {name: {**histogram.summary(), "max": histogram.maximum_ns / 1000} for name, histogram in times.items()}
    print(f"arithmetic of one tick, {ticks} ticks, us")
    for name, values in report.items():
        print(f"  {name:12}" + "  ".join(f"{key} {value:6.0f}" for key, value in values.items()))
    write_report({"compute_us": report}, file)
    return report
