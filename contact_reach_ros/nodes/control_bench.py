"""`contact-reach bench control --seconds`: how well the running stack keeps its time, with other programs beside it."""

from __future__ import annotations

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
from typing import Any, NamedTuple

import numpy as np
import rclpy
from rclpy.node import Node

from contact_reach_ros.doctor import jitter
from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.nodes import driver, echo, topics
from contact_reach_ros.nodes.bringup import STARTUP_TIMEOUT_S
from contact_reach_ros.nodes.interruption import Interruption
from contact_reach_ros.nodes.managed import initialise
from contact_reach_ros.nodes.processes import RECORDER, VIEWER, StackOptions, page_address, processes
from contact_reach_ros.nodes.supervisor import StackError, Supervisor, end_with_parent
from contact_reach_ros.nodes.watcher import DISCOVERY_S, Watcher
from contact_reach_ros.recording.plot import SUCCESS_DISTANCE
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.timing import counts_between, percentiles_us, read_counts
from contact_reach_ros.viewer import pages

NAME = "bench_control"

_DRIVER, _CONTROLLER = "driver", "controller"
_LOOK_S = 0.1
_GOAL_S = 8.0
"""A goal that takes longer is given up for the next one."""
_SETTLE_S = 3.0
"""After bring-up, before anything counts."""
_ECHO_S = (3.0, 20.0)
_ECHO_SHARE = 0.25
_MEMORY_S = 60.0
"""Memory is compared with what it is after the first minute, or after half the time if that is shorter."""
_TURN_S = 20.0
"""Without pages, and then with them."""
_PAGES_S = 30.0
"""For pages to open."""
_TIMER_PRIORITY = driver.PRIORITY + 1
_HOG = "while True: pass"


@dataclass(frozen=True)
class ControlBench:
    """What is run.

    Attributes
    ----------
    seconds
        Time that is measured, s.
    load
        Processes beside the stack that never sleep.
    scene, seed
        Where the arm goes to and fro between its start and the target.
    pages
        The viewer runs, too, and half of the time, in turns, serves so many pages.
    """

    seconds: float = 60.0
    load: int = 2
    scene: str = "ball"
    seed: int = 0
    pages: int = 0

    def check(self) -> None:
        """Raise `SettingsError` for what cannot be run."""
        if not 2.0 <= self.seconds <= 86400.0:
            raise SettingsError(f"--seconds {self.seconds:g}: expected 2 to 86400 s")
        if not 0 <= self.load <= 64:
            raise SettingsError(f"--load {self.load}: expected 0 to 64 processes")
        if not 0 <= self.pages <= 8:
            raise SettingsError(f"--pages {self.pages}: expected 0 to 8 pages")

    @property
    def parts(self) -> list[tuple[float, int]]:
        """What the time is divided into: seconds, and how many pages are open."""
        if not self.pages:
            settled = min(_MEMORY_S, 0.5 * self.seconds)
            return [(settled, 0), (self.seconds - settled, 0)]
        turns = max(round(self.seconds / (2.0 * _TURN_S)), 1)
        return [(self.seconds / (2.0 * turns), count) for _ in range(turns) for count in (0, self.pages)]


@dataclass(frozen=True)
class Sample:
    """What was known at one time.

    Attributes
    ----------
    diagnostics
        Newest values of driver and controller, by name.
    memory
        By process, MB.
    timer
        Ticks of the bare timer that were due, and those of them that were missed.
    """

    diagnostics: Mapping[str, Mapping[str, str]]
    memory: Mapping[str, float]
    timer: tuple[int, int]

    def number(self, key: str) -> int:
        """One of the driver's counters."""
        return int(self.diagnostics[_DRIVER][key])

    def counts(self, node: str, name: str) -> dict[int, int]:
        """One of a node's histograms: counts by upper edge in µs."""
        return read_counts(self.diagnostics[node][f"{name} counts"])


class Part(NamedTuple):
    """Some of the time: how many pages were open, and what was known when it began and ended."""

    pages: int
    first: Sample
    last: Sample

    @property
    def ticks(self) -> int:
        """So many were due."""
        return self.last.number("ticks") - self.first.number("ticks")

    @property
    def missed_fraction(self) -> float:
        """Share of the ticks that were missed."""
        return (self.last.number("missed ticks") - self.first.number("missed ticks")) / max(self.ticks, 1)

    @property
    def timer_missed_fraction(self) -> float:
        """The same of the bare timer."""
        due, missed = np.subtract(self.last.timer, self.first.timer).tolist()
        return float(missed / max(due, 1))


@dataclass(frozen=True)
class Run:
    """What was seen of the stack.

    Attributes
    ----------
    parts
        In order.
    reached
        How many goals were.
    realtime
        Whether the loops had real-time priority.
    """

    parts: Sequence[Part]
    reached: int
    realtime: bool


def bench_control_stack(bench: ControlBench, file: Path | None) -> dict[str, Any]:
    """Measure bare echoes, then the stack, under the same load; print a table and write JSON to `file`.

    Raises
    ------
    ContactReachError
        If an option or the scene is wrong, or the stack does not come up or is stopped.
    """
    bench.check()
    scene = make_scene(read_scene(bench.scene), bench.seed)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    # Removed only when all went well: what a process said is there to be read when it did not.
    directory = Path(tempfile.mkdtemp(prefix=f"{NAME}_"))
    _say("bare echoes ...")
    with _hogs(bench.load):
        echoes = measure_echo(float(np.clip(_ECHO_SHARE * bench.seconds, *_ECHO_S)))
    options = StackOptions(scene=bench.scene, seed=bench.seed, bag=str(directory / "bag"), view=bench.pages > 0)
    interruption = Interruption()
    initialise([NAME])
    node = Node(NAME)
    supervisor = Supervisor(node, processes(options), options.parameter_file, interruption, directory / "log")
    watcher = Watcher(node, supervisor, RobotModel(), scene.target)
    try:
        run = _measure(bench, supervisor, watcher)
    finally:
        interruption.ignore()
        supervisor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    shutil.rmtree(directory)
    report = make_report(bench, echoes, run)
    _print(report)
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")
    return report


def _measure(bench: ControlBench, supervisor: Supervisor, watcher: Watcher) -> Run:
    began = time.monotonic()
    supervisor.bring_up(STARTUP_TIMEOUT_S, lambda line: None)
    supervisor.wait_heard(RECORDER, (topics.JOINT_STATES, topics.COMMANDS, topics.GOAL_POSE), DISCOVERY_S)
    watcher.wait_ready(listeners=3 if bench.pages else 2)
    _say(f"stack active after {time.monotonic() - began:.1f} s; {bench.seconds:g} s with {bench.load} hogs ...")
    identities = supervisor.process_ids
    realtime = all(os.sched_getscheduler(identities[name]) == os.SCHED_FIFO for name in (_DRIVER, _CONTROLLER))
    goals = [watcher.target, watcher.position.copy()]
    with _hogs(bench.load), _BareTimer() as timer:
        trips = _go_to_and_fro(supervisor, watcher, goals)
        _until(time.monotonic() + _SETTLE_S, trips)
        parts = []
        for seconds, count in bench.parts:
            with _pages(count):
                if bench.pages:
                    _wait_pages(count, watcher, trips)
                first = _sample(supervisor, watcher, timer)
                _until(time.monotonic() + seconds, trips)
                parts.append(Part(count, first, _sample(supervisor, watcher, timer)))
        reached = next(trips)
    return Run(parts, reached, realtime)


@contextmanager
def _pages(count: int) -> Iterator[None]:
    """So many pages of the viewer."""
    if not count:
        yield
        return
    command = [sys.executable, "-m", pages.__name__, page_address(StackOptions().parameter_file), str(count)]
    process = subprocess.Popen(command, preexec_fn=end_with_parent, start_new_session=True)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def _wait_pages(count: int, watcher: Watcher, trips: Iterator[int]) -> None:
    """Until the viewer serves at least so many, and a moment longer."""
    deadline = time.monotonic() + _PAGES_S
    while (served := int(watcher.diagnostics.get(VIEWER, {}).get("browsers", "0"))) < count:
        if time.monotonic() > deadline:
            raise StackError(f"{count} pages were opened, and after {_PAGES_S:g} s the viewer serves {served}")
        next(trips)
    _until(time.monotonic() + _SETTLE_S, trips)


def _go_to_and_fro(supervisor: Supervisor, watcher: Watcher, goals: Sequence[np.ndarray]) -> Iterator[int]:
    """Watch for a moment at each step; yields how many goals were reached so far."""
    reached = sent = 0
    deadline = 0.0
    while True:
        arrived = sent > 0 and watcher.distance <= SUCCESS_DISTANCE
        if arrived or time.monotonic() > deadline:
            reached += arrived
            watcher.target = goals[sent % len(goals)]
            watcher.send_goal()
            sent += 1
            deadline = time.monotonic() + _GOAL_S
            watcher.distance = float("nan")
        supervisor.spin(_LOOK_S)
        supervisor.check()
        if watcher.stopped:
            raise StackError(watcher.safety)
        yield reached


def _until(deadline: float, trips: Iterator[int]) -> None:
    while time.monotonic() < deadline:
        next(trips)


class _BareTimer:
    """A process that does nothing but wake up at 1 kHz, before all others: what it misses is the machine's doing.

    Machines that are shared with others have slow minutes, in which nothing keeps its time.
    """

    def __enter__(self) -> _BareTimer:
        self._counts = (0, 0)
        self._process = subprocess.Popen(
            [sys.executable, "-m", jitter.__name__, str(_TIMER_PRIORITY)],
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
        """Ticks that were due so far, and those of them that were missed, up to the last full second."""
        with suppress(BlockingIOError):
            while data := os.read(self._output, 1 << 16):
                self._rest += data
        *lines, self._rest = self._rest.split(b"\n")
        if lines:
            due, missed = map(int, lines[-1].split())
            self._counts = due, missed
        return self._counts


def _sample(supervisor: Supervisor, watcher: Watcher, timer: _BareTimer) -> Sample:
    memory = {name: _resident_mb(identity) for name, identity in supervisor.process_ids.items()}
    diagnostics = {name: watcher.diagnostics[name] for name in (_DRIVER, _CONTROLLER)}
    return Sample(diagnostics, memory, timer.counts())


def _resident_mb(process: int) -> float:
    """Memory of a process that is in use, MB."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1000.0
    return float("nan")


def make_report(bench: ControlBench, echoes: Mapping[str, float], run: Run) -> dict[str, Any]:
    """The result as JSON has it."""
    whole = Part(bench.pages, run.parts[0].first, run.parts[-1].last)
    first, settled, last = whole.first, run.parts[0].last, whole.last
    trip = percentiles_us(counts_between(first.counts(_DRIVER, "round trip"), last.counts(_DRIVER, "round trip")))
    late = percentiles_us(counts_between(first.counts(_DRIVER, "wake-up late"), last.counts(_DRIVER, "wake-up late")))
    compute = percentiles_us(counts_between(first.counts(_CONTROLLER, "compute"), last.counts(_CONTROLLER, "compute")))
    growth = {name: last.memory[name] - settled.memory[name] for name in last.memory}
    return {
        "seconds": bench.seconds,
        "load": bench.load,
        "scene": bench.scene,
        "realtime": run.realtime,
        "ticks": whole.ticks,
        "missed_fraction": whole.missed_fraction,
        "timer_missed_fraction": whole.timer_missed_fraction,
        "round_trip_us": {key: trip[key] for key in ("p50", "p99", "p999")},
        "wakeup_late_us": {key: late[key] for key in ("p50", "p99")},
        "compute_us": {key: compute[key] for key in ("p50", "p99")},
        "echo_us": dict(echoes),
        "ratio_to_echo": trip["p50"] / echoes["p50"],
        "memory_growth_mb": max(growth.values()),
        "memory_growth_mb_by_process": growth,
        "goals_reached": run.reached,
        "pages": _compare_pages(run.parts) if bench.pages else None,
    }


def _compare_pages(parts: Sequence[Part]) -> dict[str, Any]:
    """Missed ticks with pages and without, from turns next to each other, and the same of the bare timer."""
    closed, opened = ([part.missed_fraction for part in parts[first::2]] for first in (0, 1))
    timers = [np.array([part.timer_missed_fraction for part in parts[first::2]]) for first in (0, 1)]
    differences = np.subtract(opened, closed)
    error = float(differences.std(ddof=1) / np.sqrt(len(differences))) if len(differences) > 1 else None
    return {
        "count": parts[1].pages,
        "missed_fraction_closed": closed,
        "missed_fraction_open": opened,
        "difference_mean": float(differences.mean()),
        "difference_standard_error": error,
        "difference_median": float(np.median(differences)),
        "timer_difference_mean": float((timers[1] - timers[0]).mean()),
    }


def _print(report: Mapping[str, Any]) -> None:
    trip, late, compute, echoes = (report[key] for key in ("round_trip_us", "wakeup_late_us", "compute_us", "echo_us"))
    growth = report["memory_growth_mb_by_process"]
    most = max(growth, key=growth.__getitem__)
    rows = [
        ("ticks", f"{report['ticks']}, missed {100 * report['missed_fraction']:.3f} %"),
        ("bare timer", f"missed {100 * report['timer_missed_fraction']:.3f} % in the same time"),
        ("round trip", f"p50 {trip['p50']:.0f}, p99 {trip['p99']:.0f}, p99.9 {trip['p999']:.0f} us"),
        ("woken up late", f"p50 {late['p50']:.0f}, p99 {late['p99']:.0f} us"),
        ("controller", f"p50 {compute['p50']:.0f}, p99 {compute['p99']:.0f} us"),
        ("bare echo", f"p50 {echoes['p50']:.0f} us; the loop takes {report['ratio_to_echo']:.2f} times as long"),
        ("memory", f"{report['memory_growth_mb']:+.2f} MB at most, {most}"),
        ("goals reached", f"{report['goals_reached']}"),
        ("real time", "SCHED_FIFO" if report["realtime"] else "no: not permitted"),
    ]
    compared = report["pages"]
    if compared is not None:
        means = [100.0 * np.mean(compared[f"missed_fraction_{kind}"]) for kind in ("open", "closed")]
        error = compared["difference_standard_error"]
        text = f"{means[0]:.3f} % missed with {compared['count']} open, {means[1]:.3f} % without"
        text += f": {100.0 * compared['difference_mean']:+.3f} %"
        text += "" if error is None else f", standard error {100.0 * error:.3f} %"
        rows.append(("pages", f"{text}; bare timer {100.0 * compared['timer_difference_mean']:+.3f} %"))
    for label, text in rows:
        print(f"  {label:16}{text}")


def measure_echo(seconds: float) -> dict[str, float]:
    """Percentiles of the round trip between two bare nodes, µs."""
    command = [sys.executable, "-m", echo.__name__]
    pong = subprocess.Popen([*command, echo.PONG], preexec_fn=end_with_parent, start_new_session=True)
    try:
        ping = subprocess.run(
            [*command, echo.PING, "--seconds", str(seconds)], stdout=subprocess.PIPE, text=True, check=False
        )
    finally:
        pong.terminate()
        pong.wait()
    if ping.returncode != 0:
        raise ContactReachError(f"bare echoes: the sender ended with exit code {ping.returncode}, see above")
    result: dict[str, float] = json.loads(ping.stdout)
    return result


@contextmanager
def _hogs(count: int) -> Iterator[None]:
    """Processes that take all the time they get."""
    hogs = [
        subprocess.Popen([sys.executable, "-c", _HOG], preexec_fn=end_with_parent, start_new_session=True)
        for _ in range(count)
    ]
    try:
        yield
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
