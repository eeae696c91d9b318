"""`contact-reach bench`: does this machine keep the loop's time? The running stack is timed beside other programs."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from contact_reach_ros.arm import Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup.processes import BringupOptions
from contact_reach_ros.bringup.stack_processes import StackError, StackProcesses
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.goal_progress import GoalPhase
from contact_reach_ros.resources import write_json
from contact_reach_ros.ros.client import StackClient
from contact_reach_ros.ros.interfaces import CONTROLLER, DRIVER
from contact_reach_ros.ros.process import bare_node
from contact_reach_ros.scenes.generate import load_scene

NAME = "fitness"
SCENE = "ball"
"""Where the arm moves to and fro between its start and the target."""

_LOOK_S = 0.1
_GOAL_S = 8.0
"""After this time the next goal is sent."""
_SETTLE_S = 3.0
"""After bring-up, before the measurement."""
_HOG = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: sum(range(1000000))"

Counters = Mapping[str, Mapping[str, str]]
"""Newest values in the diagnostics of driver and controller, by node and name."""


def run_fitness(file: Path | None = None, seconds: float = 60.0, load: int = 0) -> None:
    """Time the stack under load, print a table and write JSON to `file`.

    Parameters
    ----------
    file
        For the numbers; None for none.
    seconds
        Time in which missed ticks are counted, s; percentiles are of the last minute.
    load
        Number of processes beside the stack that never sleep.

    Raises
    ------
    ContactReachError
        If an option is out of range, the file cannot be written, or the stack does not come up or is stopped.
    """
    if not 2.0 <= seconds <= 86400.0:
        raise SettingsError(f"--seconds {seconds:g}: expected 2 to 86400 s")
    if not 0 <= load <= 64:
        raise SettingsError(f"--load {load}: expected 0 to 64 processes")
    scene = load_scene(SCENE, load_arm())
    # Removed only on success, so that the log of a failure remains.
    directory = Path(tempfile.mkdtemp(prefix=f"{NAME}_"))
    options = BringupOptions(scene=SCENE, bag=str(directory / "bag"))
    with bare_node(NAME) as node:
        client = StackClient(node)
        start, _ = RobotModel(scene.arm).tip_pose(scene.start)
        goals = itertools.cycle([scene.target, start])
        with StackProcesses(client, options, directory / "log") as stack:
            report = {"seconds": seconds, "load": load, **_measure(seconds, load, stack, client, goals)}
    shutil.rmtree(directory)
    print_report(report)
    if file is not None:
        write_json(file, report)


def _measure(
    seconds: float, load: int, stack: StackProcesses, client: StackClient, goals: Iterator[Array]
) -> dict[str, Any]:
    began = time.monotonic()
    stack.bring_up(lambda line: None)
    stack.wait_to_start(client)
    up = f"stack active after {time.monotonic() - began:.1f} s; {seconds:g} s beside {load} programs"
    print(up, file=sys.stderr, flush=True)
    with _hogs(load):
        _drive(stack, client, goals, _SETTLE_S)
        first = {name: client.diagnostics[name] for name in (DRIVER, CONTROLLER)}
        reached = _drive(stack, client, goals, seconds)
        last = {name: client.diagnostics[name] for name in (DRIVER, CONTROLLER)}
    return {**timing_between(first, last), "goals_reached": reached}


def _drive(stack: StackProcesses, client: StackClient, goals: Iterator[Array], seconds: float) -> int:
    """Send one goal after the other for some seconds; returns how many were reached."""
    end, due, reached = time.monotonic() + seconds, 0.0, 0
    client.goal_state = None
    while time.monotonic() < end:
        arrived = client.goal_state is not None and client.goal_state.phase in (GoalPhase.REACHED, GoalPhase.SETTLED)
        if arrived or time.monotonic() > due:
            reached += arrived
            client.send_goal(next(goals))
            due = time.monotonic() + _GOAL_S
        stack.watch(_LOOK_S)
        if client.stops:
            raise StackError(f"stopped by {client.why_stopped}")
    return reached


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


def timing_between(first: Counters, last: Counters) -> dict[str, Any]:
    """Ticks and the share of them that were missed between two readings, and percentiles of the last minute, µs."""
    ticks, missed = (int(last[DRIVER][name]) - int(first[DRIVER][name]) for name in ("ticks", "missed ticks"))

    def percentiles(node: str, name: str) -> dict[str, float]:
        return {key: float(last[node][f"{name} {key} us"]) for key in ("p50", "p99", "p999")}

    return {
        "ticks": ticks,
        "missed_fraction": missed / max(ticks, 1),
        "round_trip_us": percentiles(DRIVER, "round trip"),
        "wakeup_late_us": percentiles(DRIVER, "wake-up late"),
        "compute_us": percentiles(CONTROLLER, "compute"),
    }


def print_report(report: Mapping[str, Any]) -> None:
    """The result as a table."""

    def us(key: str) -> str:
        return "p50 {p50:.0f}, p99 {p99:.0f}, p99.9 {p999:.0f} us".format(**report[key])

    rows = [
        ("ticks", f"{report['ticks']}, missed {100 * report['missed_fraction']:.3f} %"),
        ("round trip", us("round_trip_us")),
        ("woken up late", us("wakeup_late_us")),
        ("controller", us("compute_us")),
        ("goals reached", f"{report['goals_reached']}"),
    ]
    for label, text in rows:
        print(f"  {label:20}{text}")
