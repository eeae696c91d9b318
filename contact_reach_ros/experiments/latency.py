"""How long plans take on this machine, measured on closed-loop runs; episodes are then run with that latency."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.baselines.method import Method
from contact_reach_ros.experiments.episode import run_episode
from contact_reach_ros.experiments.grid import GOALS, Setup, concrete_scene, prepared
from contact_reach_ros.planning.problem import Goal, Plan, Spheres
from contact_reach_ros.scenes.scene import SceneFile

Array = NDArray[np.float64]

MIN_LATENCY = 0.01
"""Nobody is asked for plans more often, s: those who plan once only hand out the next piece of their path."""

_PLANS, _ENOUGH_PLANS, _PATIENCE = 30, 4, 6.0
"""Plans that the median is taken of; fewer, but not fewer than enough, when they take longer than this, s."""
_PERIODS = (0.08, 0.5)
"""Least and greatest time between plans while measuring, s: a few seconds of motion, contact included."""


@dataclass(frozen=True)
class LatencyTask:
    """What is to be measured; `target` is the seed of the first scene that the arm moves in."""

    scene: SceneFile
    method: str
    target: int
    setup: Setup


class _Enough(Exception):  # noqa: N818
    """Ends a run when there are enough plans."""


class _Stopwatch:
    """A method whose plans are timed; the first of each run, which has nothing to start from, is not counted."""

    def __init__(self, method: Method) -> None:
        self._method = method
        self._begin = time.perf_counter()
        self._first = True
        self.seconds: list[float] = []
        self.cpu_seconds: list[float] = []

    @property
    def stop_reason(self) -> str:
        return self._method.stop_reason

    def warm_up(self, progress: Any) -> None:
        self._method.warm_up(progress)

    def reseed(self, seed: int) -> None:
        self._method.reseed(seed)

    def start(self, q: Array, v: Array, now_ns: int) -> None:
        self._first = True
        self._method.start(q, v, now_ns)

    def plan(self, q: Array, v: Array, now_ns: int, effect_ns: int, goal: Goal, spheres: Spheres) -> Plan:
        wall, cpu = time.perf_counter(), time.process_time()
        plan = self._method.plan(q, v, now_ns, effect_ns, goal, spheres)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        if not self._first:
            self.seconds.append(wall)
            self.cpu_seconds.append(cpu)
        elif not self.seconds:
            # What a search over several seconds took is no reason to measure less of what comes after it.
            self._begin = time.perf_counter()
        self._first = False
        late = time.perf_counter() - self._begin > _PATIENCE
        if len(self.seconds) >= (_ENOUGH_PLANS if late else _PLANS):
            raise _Enough
        return plan

    def torque(self, q: Array, v: Array, now_ns: int, clock_ns: int) -> Array | None:
        return self._method.torque(q, v, now_ns, clock_ns)

    def observer_report(self, stopped_because: str, clock_ns: int, distrust: str = "") -> None:
        self._method.observer_report(stopped_because, clock_ns, distrust)


def measure_latency(task: LatencyTask) -> dict[str, Any]:
    """Median time of a plan, to be run on one process with no other task at the same time.

    Returns `latency_s`, the median rounded up to ms and at least `MIN_LATENCY`, with what it comes from: `median_s` of
    the wall-clock time, `cpu_median_s` of the processor's time and `plans`. On one thread of a CPU the two differ by
    what other programs take, which is not the planner's; with a GPU only the wall clock knows. A method that finds no
    way to the first target has `MIN_LATENCY` and no medians.
    """
    method = prepared(task.method, task.scene, task.setup)
    watch = _Stopwatch(method)
    method.reseed(task.target)
    period = _PERIODS[0]
    # Each scene's first target once with either goal; usually the first of them is enough.
    scene = concrete_scene(task.scene, task.target)
    for goal in GOALS:
        try:
            run_episode(scene, watch, task.setup.options(task.method, goal, period))
        except _Enough:
            break
        if watch.seconds:
            period = float(np.clip(np.median(watch.cpu_seconds), *_PERIODS))
    if not watch.seconds:
        return {"latency_s": MIN_LATENCY, "median_s": None, "cpu_median_s": None, "plans": 0}
    median, cpu_median = float(np.median(watch.seconds)), float(np.median(watch.cpu_seconds))
    return {
        "latency_s": rounded_up(cpu_median if jax.default_backend() == "cpu" else median),
        "median_s": median,
        "cpu_median_s": cpu_median,
        "plans": len(watch.seconds),
    }


def rounded_up(seconds: float) -> float:
    """To the next ms, the tick of an episode, and to `MIN_LATENCY` at least."""
    return max(MIN_LATENCY, math.ceil(round(1e3 * seconds, 6)) / 1e3)
