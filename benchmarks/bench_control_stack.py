"""`contact-reach bench control --seconds`: timing of the running stack, with other programs beside it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup.bringup import STARTUP_TIMEOUT_S
from contact_reach_ros.bringup.children import StackError, end_with_parent
from contact_reach_ros.bringup.interruption import Interruption
from contact_reach_ros.bringup.processes import BringupOptions, processes
from contact_reach_ros.bringup.stack_processes import StackProcesses
from contact_reach_ros.bringup.watcher import DISCOVERY_S, Watcher
from contact_reach_ros.doctor import machine
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.experiments import echo
from contact_reach_ros.experiments.control_report import (
    CONTROLLER,
    DRIVER,
    ControlBench,
    Run,
    Sample,
    make_report,
    print_report,
)
from contact_reach_ros.experiments.machine import hogs, memory_mb
from contact_reach_ros.experiments.output import say, write_report
from contact_reach_ros.messages import topics
from contact_reach_ros.report.plot import SUCCESS_DISTANCE
from contact_reach_ros.ros.interfaces import RECORDER
from contact_reach_ros.ros.process import initialise
from contact_reach_ros.ros.scheduling import DRIVER_PRIORITY
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.generate import make_scene

NAME = "bench_control"

_LOOK_S = 0.1
_GOAL_S = 8.0
"""After this time the next goal is sent."""
_SETTLE_S = 3.0
"""After bring-up, before the measurement."""
_ECHO_S = (3.0, 20.0)
_ECHO_SHARE = 0.25
_TIMER_PRIORITY = DRIVER_PRIORITY + 1


def bench_control_stack(bench: ControlBench, file: Path | None) -> dict[str, Any]:
    """Measure bare echoes, then the stack, under the same load; print a table and write JSON to `file`.

    Raises
    ------
    ContactReachError
        If an option or the scene is wrong, or the stack does not come up or is stopped.
    """
    bench.check()
    scene = make_scene(read_scene(bench.scene), load_arm(), bench.seed)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    # Removed only on success, so that the log of a failure remains.
    directory = Path(tempfile.mkdtemp(prefix=f"{NAME}_"))
    say("bare echoes ...")
    with hogs(bench.load):
        echoes = measure_echo(float(np.clip(_ECHO_SHARE * bench.seconds, *_ECHO_S)))
    options = BringupOptions(scene=bench.scene, seed=bench.seed, bag=str(directory / "bag"))
    interruption = Interruption()
    initialise([NAME])
    node = Node(NAME)
    stack = StackProcesses(node, processes(options), options.parameter_file, interruption, directory / "log")
    watcher = Watcher(node, stack, RobotModel(scene.arm), scene.target)
    try:
        run = _measure(bench, stack, watcher)
    finally:
        interruption.ignore()
        stack.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    shutil.rmtree(directory)
    report = make_report(bench, echoes, run)
    print_report(report)
    write_report(report, file)
    return report


def _measure(bench: ControlBench, stack: StackProcesses, watcher: Watcher) -> Run:
    began = time.monotonic()
    stack.bring_up(STARTUP_TIMEOUT_S, lambda line: None)
    stack.wait_heard(RECORDER, (topics.JOINT_STATES, topics.COMMANDS, topics.GOAL_POSE), DISCOVERY_S)
    watcher.wait_ready(listeners=2)
    say(f"stack active after {time.monotonic() - began:.1f} s; {bench.seconds:g} s with {bench.load} hogs ...")
    identities = stack.process_ids
    realtime = all(os.sched_getscheduler(identities[name]) == os.SCHED_FIFO for name in (DRIVER, CONTROLLER))
    goals = [watcher.target, watcher.position.copy()]
    with hogs(bench.load), _BareTimer() as timer:
        trips = _go_to_and_fro(stack, watcher, goals)
        _until(time.monotonic() + _SETTLE_S, trips)
        samples = [_sample(stack, watcher, timer)]
        for seconds in (bench.settled, bench.seconds - bench.settled):
            _until(time.monotonic() + seconds, trips)
            samples.append(_sample(stack, watcher, timer))
        reached = next(trips)
    first, settled, last = samples
    return Run(first, settled, last, reached, realtime)


def _go_to_and_fro(stack: StackProcesses, watcher: Watcher, goals: Sequence[np.ndarray]) -> Iterator[int]:
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
        stack.spin(_LOOK_S)
        stack.check()
        if watcher.stopped:
            raise StackError(watcher.safety)
        yield reached


def _until(deadline: float, trips: Iterator[int]) -> None:
    while time.monotonic() < deadline:
        next(trips)


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


def _sample(stack: StackProcesses, watcher: Watcher, timer: _BareTimer) -> Sample:
    memory = {name: memory_mb(identity, "VmRSS") for name, identity in stack.process_ids.items()}
    diagnostics = {name: watcher.diagnostics[name] for name in (DRIVER, CONTROLLER)}
    return Sample(diagnostics, memory, timer.counts())


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


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt
