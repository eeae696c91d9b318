"""`contact-reach bench`: does this machine keep the loop's time? The running stack is timed beside other programs."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup.children import Interruption, StackError, end_with_parent
from contact_reach_ros.bringup.follower import Follower
from contact_reach_ros.bringup.processes import BringupOptions, processes
from contact_reach_ros.bringup.stack_processes import StackProcesses
from contact_reach_ros.doctor import machine
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.messages import topics
from contact_reach_ros.report.summary import SUCCESS_DISTANCE
from contact_reach_ros.ros.process import initialise
from contact_reach_ros.ros.scheduling import DRIVER_PRIORITY
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.timing import counts_between, percentiles_us, read_counts
from contact_reach_ros.world.scene_file import read_scene

NAME = "fitness"
DRIVER, CONTROLLER = "driver", "controller"
"""Nodes whose counters are read."""

_LOOK_S = 0.1
_GOAL_S = 8.0
"""After this time the next goal is sent."""
_SETTLE_S = 3.0
"""After bring-up, before the measurement."""
_TIMER_PRIORITY = DRIVER_PRIORITY + 1
_HOG = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: sum(range(1000000))"


@dataclass(frozen=True)
class FitnessOptions:
    """What is run.

    Attributes
    ----------
    seconds
        Time that is measured, s.
    load
        Processes beside the stack that never sleep.
    scene, seed
        Where the arm moves to and fro between its start and the target.

    Raises
    ------
    SettingsError
        If a number is out of range.
    """

    seconds: float = 60.0
    load: int = 0
    scene: str = "ball"
    seed: int = 0

    def __post_init__(self) -> None:
        if not 2.0 <= self.seconds <= 86400.0:
            raise SettingsError(f"--seconds {self.seconds:g}: expected 2 to 86400 s")
        if not 0 <= self.load <= 64:
            raise SettingsError(f"--load {self.load}: expected 0 to 64 processes")


@dataclass(frozen=True)
class Sample:
    """Counters at one time.

    Attributes
    ----------
    diagnostics
        Newest values of driver and controller, by name.
    timer
        Ticks of the bare timer that were due, and those of them that were missed.
    """

    diagnostics: Mapping[str, Mapping[str, str]]
    timer: tuple[int, int]

    def number(self, key: str) -> int:
        """One of the driver's counters."""
        return int(self.diagnostics[DRIVER][key])

    def counts(self, node: str, name: str) -> dict[int, int]:
        """One of a node's histograms: counts by upper edge in µs."""
        return read_counts(self.diagnostics[node][f"{name} counts"])


def run_fitness(file: Path | None = None, **options: Any) -> None:
    """Time the stack under load, print a table and write JSON to `file`; `options` are those of `FitnessOptions`.

    Raises
    ------
    ContactReachError
        If an option or the scene is wrong, or the stack does not come up or is stopped.
    """
    chosen = FitnessOptions(**options)
    scene = make_scene(read_scene(chosen.scene), load_arm(), chosen.seed)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    # Removed only on success, so that the log of a failure remains.
    directory = Path(tempfile.mkdtemp(prefix=f"{NAME}_"))
    stack_options = BringupOptions(
        scene=chosen.scene, bag=str(directory / "bag"), overrides=(f"driver:seed={chosen.seed}",)
    )
    interruption = Interruption()
    initialise([NAME])
    node = Node(NAME)
    follower = Follower(node, RobotModel(scene.arm), scene.target)
    stack = StackProcesses(
        follower, processes(stack_options), stack_options.parameter_file, interruption, directory / "log"
    )
    try:
        report = _measure(chosen, stack, follower)
    finally:
        interruption.ignore()
        stack.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    shutil.rmtree(directory)
    print_report(report)
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")


def _measure(options: FitnessOptions, stack: StackProcesses, follower: Follower) -> dict[str, Any]:
    began = time.monotonic()
    stack.bring_up(lambda line: None)
    stack.wait_recorded((topics.JOINT_STATES, topics.COMMANDS, topics.GOAL_POSE))
    follower.wait_to_start(stack)
    _say(f"stack active after {time.monotonic() - began:.1f} s; {options.seconds:g} s beside {options.load} programs")
    identities = stack.process_ids
    realtime = all(os.sched_getscheduler(identities[name]) == os.SCHED_FIFO for name in (DRIVER, CONTROLLER))
    goals = [follower.target, follower.position.copy()]
    with _hogs(options.load), _BareTimer() as timer:
        trips = _go_to_and_fro(stack, follower, goals)
        _until(time.monotonic() + _SETTLE_S, trips)
        first = _sample(follower, timer)
        _until(time.monotonic() + options.seconds, trips)
        last = _sample(follower, timer)
    return make_report(options, first, last, reached=next(trips), realtime=realtime)


def _go_to_and_fro(stack: StackProcesses, follower: Follower, goals: Sequence[np.ndarray]) -> Iterator[int]:
    """Watch for a moment at each step; yields how many goals were reached so far."""
    reached = sent = 0
    deadline = 0.0
    while True:
        arrived = sent > 0 and follower.distance <= SUCCESS_DISTANCE
        if arrived or time.monotonic() > deadline:
            reached += arrived
            follower.target = goals[sent % len(goals)]
            follower.send_target()
            sent += 1
            deadline = time.monotonic() + _GOAL_S
            follower.distance = float("nan")
        stack.watch(_LOOK_S)
        if follower.stops:
            raise StackError(follower.state)
        yield reached


def _until(deadline: float, trips: Iterator[int]) -> None:
    while time.monotonic() < deadline:
        next(trips)


def _sample(follower: Follower, timer: _BareTimer) -> Sample:
    return Sample({name: follower.diagnostics[name] for name in (DRIVER, CONTROLLER)}, timer.counts())


class _BareTimer:
    """A process that only wakes up at 1 kHz, before all others: it misses ticks only where the machine stalls.

    Shared machines have slow minutes, in which no program keeps its time.
    """

    def __enter__(self) -> _BareTimer:
        self._counts = (0, 0)
        self._process = subprocess.Popen(
            [sys.executable, "-m", machine.__name__, str(_TIMER_PRIORITY)],
            stdout=subprocess.PIPE,
            preexec_fn=end_with_parent,
            start_new_session=True,
        )
        assert self._process.stdout is not None
        self._output = self._process.stdout.fileno()
        os.set_blocking(self._output, False)
        self._rest = b""
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def counts(self) -> tuple[int, int]:
        """Ticks that were due so far, and how many of them were missed, up to the last full second."""
        with suppress(BlockingIOError):
            while data := os.read(self._output, 1 << 16):
                self._rest += data
        *lines, self._rest = self._rest.split(b"\n")
        if lines:
            due, missed = map(int, lines[-1].split())
            self._counts = due, missed
        return self._counts


@contextmanager
def _hogs(count: int) -> Iterator[None]:
    """Processes that take all the time they get; they end with this one."""
    command = [sys.executable, "-c", _HOG]
    hogs = [subprocess.Popen(command, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def make_report(options: FitnessOptions, first: Sample, last: Sample, reached: int, realtime: bool) -> dict[str, Any]:
    """The differences between two samples, as JSON has them.

    Parameters
    ----------
    reached
        Number of goals that the arm reached.
    realtime
        Whether the loops had real-time priority.
    """
    ticks = last.number("ticks") - first.number("ticks")
    missed = last.number("missed ticks") - first.number("missed ticks")
    timer_due, timer_missed = np.subtract(last.timer, first.timer).tolist()

    def between(node: str, name: str) -> dict[str, float]:
        found = percentiles_us(counts_between(first.counts(node, name), last.counts(node, name)))
        return {key: found[key] for key in ("p50", "p99", "p999")}

    return {
        **dataclasses.asdict(options),
        "realtime": realtime,
        "ticks": ticks,
        "missed_fraction": missed / max(ticks, 1),
        "timer_missed_fraction": timer_missed / max(timer_due, 1),
        "round_trip_us": between(DRIVER, "round trip"),
        "wakeup_late_us": between(DRIVER, "wake-up late"),
        "compute_us": between(CONTROLLER, "compute"),
        "goals_reached": reached,
    }


def print_report(report: Mapping[str, Any]) -> None:
    """The result as a table."""

    def us(key: str) -> str:
        return "p50 {p50:.0f}, p99 {p99:.0f}, p99.9 {p999:.0f} us".format(**report[key])

    rows = [
        ("ticks", f"{report['ticks']}, missed {100 * report['missed_fraction']:.3f} %"),
        ("bare timer", f"missed {100 * report['timer_missed_fraction']:.3f} % in the same time"),
        ("round trip", us("round_trip_us")),
        ("woken up late", us("wakeup_late_us")),
        ("controller", us("compute_us")),
        ("goals reached", f"{report['goals_reached']}"),
        ("real time", "SCHED_FIFO" if report["realtime"] else "no: not permitted, see contact-reach doctor"),
    ]
    for label, text in rows:
        print(f"  {label:16}{text}")


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt
