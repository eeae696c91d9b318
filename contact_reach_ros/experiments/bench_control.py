"""`contact-reach bench control`: what one tick of controller and observer costs, arithmetic only."""

from __future__ import annotations

import gc
import json
import time
from pathlib import Path

import numpy as np

from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.reference import PoseKnots, PostureKnots
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings
from contact_reach_ros.observer.safety import SafetyMonitor, SafetySettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.timing import Histogram
from contact_reach_ros.units import NANOSECONDS

_TICK_NS = 1_000_000
_WARM_UP = 500


def bench_control(ticks: int, file: Path | None) -> dict[str, dict[str, float]]:
    """Time `ticks` ticks along a moving trajectory with a plan in force; print a table and write JSON to `file`."""
    random = np.random.default_rng(0)
    settings = ControllerSettings()
    controller = Controller(settings, RobotModel())
    observer = MomentumObserver(MomentumSettings(), RobotModel())
    monitor = SafetyMonitor(SafetySettings(), load_budget())
    home = np.array(iiwa14.HOME_POSITION)
    controller.start(home, np.zeros(iiwa14.N_JOINTS), 0)
    _add_plan(controller, (ticks + _WARM_UP + 1) * _TICK_NS)
    times = {"controller": Histogram(), "observer": Histogram()}
    gc.collect()
    gc.disable()
    try:
        for tick in range(ticks + _WARM_UP):
            now_ns = tick * _TICK_NS
            phase = now_ns / NANOSECONDS + np.arange(iiwa14.N_JOINTS)
            q = home + 0.2 * np.sin(phase)
            v = 0.2 * np.cos(phase) + 1e-3 * random.standard_normal(iiwa14.N_JOINTS)
            began_ns = time.perf_counter_ns()
            torque = controller.tick(q, v, now_ns, now_ns)
            between_ns = time.perf_counter_ns()
            monitor.update(observer.update(q, v, torque, now_ns), v, observer.known_for)
            ended_ns = time.perf_counter_ns()
            if tick >= _WARM_UP:
                times["controller"].add(between_ns - began_ns)
                times["observer"].add(ended_ns - between_ns)
    finally:
        gc.enable()
    report = {name: {**histogram.summary(), "max": histogram.maximum_ns / 1000} for name, histogram in times.items()}
    print(f"arithmetic of one tick, {ticks} ticks, us")
    for name, values in report.items():
        print(f"  {name:12}" + "  ".join(f"{key} {value:6.0f}" for key, value in values.items()))
    if file is not None:
        file.write_text(json.dumps({"compute_us": report}, indent=2) + "\n")
    return report


def _add_plan(controller: Controller, end_ns: int) -> None:
    position, rotation = controller.model.flange_pose(np.array(iiwa14.HOME_POSITION))
    controller.references.offer_poses(PoseKnots(0, (end_ns,), position[None], rotation[None]), 0)
    controller.references.offer_postures(PostureKnots(0, (end_ns,), np.array([iiwa14.HOME_POSITION])), 0)
