"""How long plans take on this machine, measured on closed-loop runs; episodes are then run with that latency."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.experiments.episode import run_episode
from contact_reach_ros.experiments.grid import GOALS, Setup, concrete_scene, prepared
from contact_reach_ros.experiments.workers import run_all
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.planner import PlanningCore
from contact_reach_ros.world.scene import SceneFile

if TYPE_CHECKING:
    from distributed import Client

MIN_LATENCY = 0.01
"""Least latency, s: methods that plan once only hand out the next piece of their path."""

_PLANS, _ENOUGH_PLANS, _PATIENCE = 30, 4, 6.0
"""Plans that the median is taken of; fewer, but not fewer than enough, when they take longer than this, s."""
_PERIODS = (0.08, 0.5)
"""Least and greatest time between plans while measuring, s: a few seconds of motion, contact included."""


@dataclass(frozen=True)
class LatencyTask:
    """What to measure; `target` is the seed of the scene that the arm moves in."""

    scene: SceneFile
    method: str
    target: int
    setup: Setup


class _Enough(Exception):  # noqa: N818
    """Ends a run when there are enough plans."""


class _Stopwatch:
    """Times the plans of a core; the first of each run, which has nothing to start from, is not counted."""

    def __init__(self, core: PlanningCore) -> None:
        self._core = core
        self._begin = time.perf_counter()
        self._first = True
        self.seconds: list[float] = []
        self.cpu_seconds: list[float] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._core, name)

    def reset(self) -> None:
        self._first = True
        self._core.reset()

    def plan(self, *request: Any) -> Plan:
        wall, cpu = time.perf_counter(), time.process_time()
        plan = self._core.plan(*request)
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


def measure_latency(task: LatencyTask) -> dict[str, Any]:
    """Median time of a plan, to be run on one process with no other task at the same time.

    Returns `latency_s`, the median rounded up to ms and at least `MIN_LATENCY`, with what it comes from: `median_s` of
    the wall-clock time, `cpu_median_s` of the processor's time and `plans`. On one thread of a CPU the two differ by
    what other programs take, which is not the planner's; with a GPU only the wall clock knows. A method that finds no
    way to the first target has `MIN_LATENCY` and no medians.
    """
    method = prepared(task.method, task.scene, task.setup)
    watch = _Stopwatch(method.planner)
    timed = dataclasses.replace(method, planner=watch)
    method.reseed(task.target)
    period = _PERIODS[0]
    # Usually the first of the goals gives plans enough.
    scene = concrete_scene(task.scene, load_arm(task.setup.arm), task.target)
    for goal in GOALS:
        try:
            run_episode(scene, timed, task.setup.options(task.method, goal, period))
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


def measure_latencies(client: Client, tasks: Sequence[LatencyTask]) -> Iterator[tuple[LatencyTask, dict[str, Any]]]:
    """Yield each task with the result of `measure_latency`, one after the other on otherwise idle workers.

    Raises
    ------
    SettingsError
        If a measurement ends in an error.
    """
    for task in tasks:
        # One at a time: together, they would keep all workers busy.
        ((_, found),) = run_all(client, measure_latency, [task])
        if isinstance(found, BaseException):
            raise SettingsError(f"the time of a plan of {task.method} in {task.scene.name} cannot be measured: {found}")
        yield task, found


def rounded_up(seconds: float) -> float:
    """To the next ms, the tick of an episode, and to `MIN_LATENCY` at least."""
    return max(MIN_LATENCY, math.ceil(round(1e3 * seconds, 6)) / 1e3)
