"""All checks before a run, in order."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.doctor import arm as joints
from contact_reach_ros.doctor import machine, software
from contact_reach_ros.doctor.findings import Finding, Report, check, exit_code, failed, print_table, write_json
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.parameter_files import DEFAULT_PARAMETERS, arm_in, parameters_in, robot_in
from contact_reach_ros.resources import config_file

_LISTEN_S = 1.0


def run_doctor(parameters: Path | None = None, discovery: str = "host", file: Path | None = None) -> int:
    """Make all checks and print them; returns the exit code: 1 if something failed, else 0.

    `parameters` is the parameter file of the nodes, the package's own when None; `discovery` how far to look for them;
    `file` takes the findings as JSON.
    """
    console, used = Console(), parameters or config_file(DEFAULT_PARAMETERS)
    with console.status("looking at this machine and its software ..."):
        try:
            arm = load_arm(robot_in(used))
        except SettingsError:
            # The check of the file says why.
            arm = load_arm()
        report = examine(used, discovery, arm)
    print_table(report, console)
    if file is not None:
        write_json(report, file)
    return exit_code(report)


def examine(file: Path, discovery: str, arm: Arm) -> Report:
    """Make all checks, of the nodes with a parameter file; findings by part."""
    report = {
        "machine": [machine.realtime_permission(), machine.timer_jitter(), machine.processors()],
        "software": [software.python_packages()],
    }
    try:
        # rclpy is only needed, and only has to be installed, for what follows.
        from contact_reach_ros.doctor import stack
        from contact_reach_ros.ros.discovery import choose_discovery
    except ImportError as error:
        report["software"].append(_without_ros(error))
        return report
    choose_discovery(discovery)
    report["software"] += [
        software.ros_version(),
        stack.discovery_in_use(),
        software.parameter_file(file),
        software.contact_budget(file, arm),
    ]
    return {**report, **_stack(discovery, file, arm)}


@check("gravity against torque")
def _gravity(record: joints.JointRecord, file: Path, settings: Mapping[str, Any]) -> Finding:
    """`settings`: the controller's, with the arm and its tool."""
    arm = arm_in(settings, "the controller")
    budget = load_budget(parameters_in(file, "observer").get("contact_budget", "")).resolve(arm)
    return joints.gravity(record, RobotModel(arm), budget)


@check("rclpy")
def _without_ros(error: ImportError) -> Finding:
    fix = "source /opt/ros/jazzy/setup.bash, or install the wheels with make venv"
    return failed(f"cannot be imported ({error}): no node can run", fix)


def _stack(discovery: str, file: Path, arm: Arm) -> dict[str, list[Finding]]:
    """Check what is running; looks around first, which takes seconds."""
    from contact_reach_ros.doctor import stack
    from contact_reach_ros.doctor.listening import Look, look_around
    from contact_reach_ros.messages import topics

    looks: list[Look] = []

    @check("nodes", "see whether the middleware works: RMW_IMPLEMENTATION, ROS_DOMAIN_ID, the Fast DDS profile file")
    def nodes() -> Finding:
        looks.append(look_around(discovery, _LISTEN_S, arm))
        return stack.nodes(looks[0].graph)

    parts = {"stack": [nodes()]}
    if looks and looks[0].graph.running:
        graph = looks[0].graph
        checks = (stack.lifecycle, stack.time_source, stack.gains, stack.safety_state)
        parts["stack"] += [check(graph) for check in checks]
        parts["topics"] = [stack.topic(graph, topic) for topic in topics.ALL]
        record, clock = looks[0].joint_record(), looks[0].clock_at_states()
        parts["arm"] = [
            joints.joint_names(record, arm, looks[0].command_order),
            joints.driver_rate(record, clock is not None, graph.nominal_rate),
            joints.clock_skew(record, clock),
            _gravity(record, file, graph.settings.get("controller", parameters_in(file, "controller"))),
        ]
    return parts
