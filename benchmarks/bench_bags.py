"""`contact-reach bench bags`: what recording, replaying and analysing bags costs, and whether messages get lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.doctor.machine import TimerTest
from contact_reach_ros.errors import BagError
from contact_reach_ros.experiments.machine import hogs, machine, memory_mb
from contact_reach_ros.experiments.output import write_report
from contact_reach_ros.experiments.repeat import repeat_bag
from contact_reach_ros.resources import share_directory

SAMPLE = "bags/sample"
"""The recording that comes with the package, below its share directory."""

NAMESPACE = "/bench"
LOADED = ("joint_states", "effort_controller/commands", "external_torque", "external_wrench", "sim/contacts")
"""Topics of `experiments/load_publisher.py`, below `NAMESPACE`."""

_LIMITS = {
    "lost_messages": ("<=", 0.0),
    "recorder_core_fraction": ("<=", 0.25),
    "recorder_mb": ("<=", 150.0),
    "report_s": ("<=", 45.0),
    "report_mb": ("<=", 1000.0),
    "info_s": ("<=", 2.0),
    "reexecution_realtime_factor": (">=", 5.0),
    "replay_jitter_ms_p99": ("<=", 1.0),
}
_MEGA, _KIBI = 1e6, 1024
_PATIENCE_S = 60.0
_REPETITIONS = 3
_REPLAY_PRIORITY = 26
"""Of the replay's thread that publishes."""


def bench_bags(
    seconds: float = 60.0, minutes: float = 10.0, bag: Path | None = None, file: Path | None = None
) -> dict[str, Any]:
    """Measure, print a table, and write JSON to `file`.

    Parameters
    ----------
    seconds
        How long five topics at 1 kHz are recorded and replayed.
    minutes
        Length of the bag that is looked into and reported, made by repeating `bag`.
    bag
        A recording of the stack; the package's sample if None.

    Raises
    ------
    BagError
        If a bag cannot be read or written, or the recorder does not come up.
    """
    source = bag or share_directory() / SAMPLE
    with tempfile.TemporaryDirectory(prefix="bench_bags_") as folder:
        where = Path(folder)
        report: dict[str, Any] = {"machine": machine()}
        report |= _recording(where / "load", seconds)
        report |= _replaying(where / "load", where, seconds)
        count = repeat_bag(source, where / "long", 60.0 * minutes)
        report |= {"long_bag_minutes": minutes, "long_bag_repetitions": count}
        report |= _looking(where / "long")
        report |= _reporting(where / "long", where)
        report |= _recomputing(source, where)
    for name, (sense, limit) in _LIMITS.items():
        value = report[name]
        shown = "not measured" if value is None else f"{value:.4g}"
        print(f"  {name:28}{shown:>14}   wanted {sense} {limit:g}")
    print(f"  a bare timer beside the replay was late by p99 {report['timer_late_ms_p99']:.3g} ms")
    write_report(report, file)
    return report


def _recording(bag: Path, seconds: float) -> dict[str, Any]:
    """Record five topics while every core is kept busy by others."""
    names = ", ".join(f"'{NAMESPACE}/{name}'" for name in LOADED)
    parameters = ["--ros-args", "-p", f"bag:={bag}", "-p", f"topics:=[{names}]"]
    with _process(_module("nodes.recorder", *parameters)) as recorder, hogs(len(os.sched_getaffinity(0))):
        load = subprocess.Popen(
            _module("experiments.load_publisher", "--seconds", str(seconds)), stdout=subprocess.PIPE, text=True
        )
        assert load.stdout is not None
        try:
            if not load.stdout.readline():
                raise BagError("the load could not be published; see above")
            before, began = _cpu_seconds(recorder.pid), time.monotonic()
            count = load.stdout.readline()
            busy, took = _cpu_seconds(recorder.pid) - before, time.monotonic() - began
            memory = memory_mb(recorder.pid, "VmHWM")
            load.wait(_PATIENCE_S)
        finally:
            _end(load)
        _end(recorder)
    if not count or recorder.returncode != 0:
        raise BagError(f"the recording failed with exit code {recorder.returncode}; see above")
    sent = json.loads(count)
    return {
        "lost_messages": count_lost(bag, sent["ticks"]),
        "sent_messages": sent["ticks"] * len(LOADED),
        "late_ticks_of_load": sent["late_ticks"],
        "recorder_core_fraction": busy / took,
        "recorder_mb": memory,
        "recorded_mb": sum(path.stat().st_size for path in bag.iterdir()) / _MEGA,
    }


def count_lost(bag: Path, ticks: int) -> int:
    """How many messages are missing where each topic had `ticks`; one that came twice makes up for none.

    Raises
    ------
    BagError
        If the bag cannot be read.
    """
    reader = BagReader(bag)
    arrived: defaultdict[str, set[int]] = defaultdict(set)
    for raw in reader.raw_messages([f"{NAMESPACE}/{name}" for name in LOADED]):
        arrived[raw.topic].add(raw.sequence)
    return ticks * len(LOADED) - sum(map(len, arrived.values()))


def _replaying(bag: Path, folder: Path, seconds: float) -> dict[str, Any]:
    result = folder / "replay.json"
    # What a thread that only sleeps suffers on this machine at the same time.
    timer = TimerTest(seconds, _REPLAY_PRIORITY)
    timer.start()
    run = _run(_module("nodes.replay", str(bag), "--everything", "--json", str(result)))
    timer.join()
    _check(run, "replay")
    late = json.loads(result.read_text())["late_us"]
    return {
        "replay_jitter_ms_p99": late["p99"] / 1000,
        "replay_late_us": late,
        "timer_late_ms_p99": float(np.percentile(timer.late_ns, 99)) / _MEGA,
    }


def _looking(bag: Path) -> dict[str, Any]:
    size = sum(path.stat().st_size for path in bag.iterdir()) / _MEGA
    runs = [_run(_command("bag", "info", str(bag))) for _ in range(_REPETITIONS)]
    _check(runs[0], "bag info")
    return {
        "info_s": min(run.seconds for run in runs),
        "info_cpu_s": min(run.cpu_seconds for run in runs),
        "long_bag_mb": size,
    }


def _reporting(bag: Path, folder: Path) -> dict[str, Any]:
    run = _run(_command("report", str(bag), "-o", str(folder / "report.html")))
    if run.code:
        print(f"  report: {run.error}")
        return {"report_s": None, "report_cpu_s": None, "report_mb": None}
    return {"report_s": run.seconds, "report_cpu_s": run.cpu_seconds, "report_mb": run.peak_mb}


def _recomputing(bag: Path, folder: Path) -> dict[str, Any]:
    result = folder / "reexecution.json"
    run = _run(_command("reexecute", str(bag), "--json", str(result)))
    if not result.is_file():
        print(f"  re-execution: {run.error}")
        return {"reexecution_realtime_factor": None}
    return {"reexecution_realtime_factor": json.loads(result.read_text())["reexecution_realtime_factor"]}


@dataclass(frozen=True)
class _Run:
    """A process that ended: time, processor time, memory, exit code, and the last line of its error output."""

    seconds: float
    cpu_seconds: float
    peak_mb: float
    code: int
    error: str


def _run(command: Sequence[str]) -> _Run:
    with tempfile.TemporaryFile("w+") as errors:
        began = time.monotonic()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            _end(process)
            raise
        seconds = time.monotonic() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        errors.seek(0)
        lines = errors.read().strip().splitlines()
    busy, peak = usage.ru_utime + usage.ru_stime, usage.ru_maxrss * _KIBI / _MEGA
    return _Run(seconds, busy, peak, process.returncode, lines[-1] if lines else "")


def _check(run: _Run, what: str) -> None:
    if run.code:
        raise BagError(f"{what} failed with exit code {run.code}: {run.error}")


def _module(name: str, *arguments: str) -> list[str]:
    return [sys.executable, "-m", f"contact_reach_ros.{name}", *arguments]


def _command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "contact_reach_ros.cli", *arguments]


@contextmanager
def _process(command: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command)
    try:
        yield process
    finally:
        _end(process)


def _end(process: subprocess.Popen[Any]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _cpu_seconds(process: int) -> float:
    """Of all threads so far, in user and system mode."""
    # The name, which may hold anything, is in parentheses.
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
