"""All checks before a run, in order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from contact_reach_ros.doctor import machine
from contact_reach_ros.doctor.findings import Check, Finding, failed
from contact_reach_ros.doctor.jitter import timer_jitter
from contact_reach_ros.doctor.planner import planner_speed
from contact_reach_ros.doctor.report import Report, exit_code, print_table, write_json
from contact_reach_ros.doctor.software import python_packages

_TIMER_S, _QUICK_TIMER_S = 5.0, 0.5


@dataclass(frozen=True)
class DoctorOptions:
    """What the command line asks for."""

    quick: bool = False
    """A short timer test, and no planner."""
    parameters: str = ""
    """Parameter file of the nodes; the package's own when empty."""
    discovery: str = "host"
    """How far to look for nodes."""
    bags: Path = Path("bags")
    json: Path | None = None


def run_doctor(options: DoctorOptions) -> int:
    """Make all checks and print them; returns the exit code: 1 if something failed, else 0."""
    console = Console()
    with console.status("looking at this machine and its software ..."):
        report = examine(options)
    print_table(report, console)
    if options.json is not None:
        write_json(report, options.json)
    return exit_code(report)


def examine(options: DoctorOptions) -> Report:
    """Make all checks; findings by part."""
    seconds = _QUICK_TIMER_S if options.quick else _TIMER_S
    report = {
        "machine": _make(
            [
                Check("real-time priority", machine.realtime_permission),
                Check("locked memory", machine.memory_lock),
                Check("timer at 1 kHz", lambda: timer_jitter(seconds)),
                Check("processors", machine.processors),
                Check("frequency scaling", machine.frequency_scaling),
                Check("real-time throttling", machine.realtime_throttling),
                Check("kernel", machine.kernel),
            ]
        ),
        "software": _make([Check("Python packages", python_packages)]),
    }
    try:
        # rclpy is only needed, and only has to be installed, for what follows.
        from contact_reach_ros.nodes.doctor import RosDoctor
    except ImportError as error:
        fix = "source /opt/ros/jazzy/setup.bash, or install the wheels: pip install -c constraints.txt '.[ros]'"
        report["software"].append(failed("rclpy", f"cannot be imported ({error}): no node can run", fix))
        report["recording"] = _make([Check("disk for bags", lambda: machine.disk(options.bags))])
        if not options.quick:
            report["planner"] = _make([Check("planner", lambda: planner_speed({}))])
        return report
    doctor = RosDoctor(options.parameters, options.discovery)
    report["software"] += _make(doctor.software())
    if not options.quick:
        report["planner"] = _make([Check("planner", lambda: planner_speed(doctor.planner_parameters()))])
    try:
        parts = doctor.stack(options.bags)
    except Exception as error:  # as in every check: what is wrong is reported
        fix = "see whether the middleware works: RMW_IMPLEMENTATION, ROS_DOMAIN_ID, the Fast DDS profile file"
        report["stack"] = [failed("nodes", f"{type(error).__name__}: {error}", fix)]
        return report
    return {**report, **{part: _make(checks) for part, checks in parts.items()}}


def _make(checks: Sequence[Check]) -> list[Finding]:
    return [finding for check in checks for finding in check.run()]
