"""All checks before a run, in order."""

from __future__ import annotations

import os
from pathlib import Path

from rich.console import Console

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import arm_in
from contact_reach_ros.doctor import arm as joints
from contact_reach_ros.doctor import machine
from contact_reach_ros.doctor.findings import (
    Finding,
    Report,
    Verdict,
    exit_code,
    failed,
    print_table,
    write_json,
)
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.presets import check_parameters
from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import DEFAULT_PARAMETERS, NODES, RATE, ROBOT, parameters_in

_LISTEN_S = 1.0


def run_doctor(parameters: Path | None = None, discovery: str = "host", file: Path | None = None) -> int:
    """Make all checks and print them; returns the exit code: 1 if something failed, else 0.

    `parameters` is the parameter file of the nodes, the package's own when None; `discovery` how far to look for them;
    `file` takes the findings as JSON. Raises `InputError` if it cannot be written.
    """
    console, used = Console(), parameters or config_file(DEFAULT_PARAMETERS)
    with console.status("looking at this machine and its software ..."):
        report = examine(used, discovery)
    print_table(report, console)
    if file is not None:
        write_json(report, file)
    return exit_code(report)


def examine(file: Path, discovery: str) -> Report:
    """Make all checks, of the nodes with a parameter file."""
    report = {
        "machine": {"timer at 1 kHz": machine.timer_jitter()},
        "software": {"parameters": _parameters(file, discovery)},
    }
    try:
        # rclpy is only needed, and only has to be installed, for what follows.
        from contact_reach_ros.doctor import stack
        from contact_reach_ros.messages import topics
        from contact_reach_ros.ros.discovery import environment
    except ImportError as error:
        fix = "source /opt/ros/jazzy/setup.bash, or install the wheels with make venv"
        report["software"]["rclpy"] = failed(f"cannot be imported ({error}): no node can run", fix)
        return report
    os.environ.update(environment(discovery))
    report["software"]["discovery"] = stack.discovery_in_use()
    try:
        graph, heard = stack.look_around(discovery, _LISTEN_S)
    except ContactReachError as error:
        fix = "see whether the middleware works: RMW_IMPLEMENTATION, ROS_DOMAIN_ID, the Fast DDS profile file"
        report["stack"] = {"nodes": failed(str(error), fix)}
        return report
    report["stack"] = {"nodes": stack.nodes(graph)}
    if graph.running:
        report["stack"]["safety state"] = stack.safety_state(graph)
        report["stack"]["without commands"] = stack.commands_end(graph)
        report["topics"] = {topic.name: stack.topic(graph, topic) for topic in topics.ALL}
        try:
            settings = graph.settings.get("controller") or parameters_in(file, "controller") | _arm_of(file, discovery)
            arm = arm_in(settings, "the controller")
            budget = load_budget(parameters_in(file, "observer").get("contact_budget", "")).resolve(arm)
        except ContactReachError:
            # The check of the file says why.
            return report
        record = stack.joint_record(heard, arm)
        report["arm"] = {
            "joint names and order": joints.joint_names(record, arm, graph.command_order),
            "gravity against torque": joints.gravity(record, RobotModel(arm), budget),
        }
        # Simulated time may run at any speed.
        if not graph.publishers[topics.CLOCK.name]:
            report["arm"]["driver rate"] = joints.driver_rate(record, settings.get(RATE.name, RATE.default))
            report["arm"]["clocks"] = joints.clock_skew(record)
    return report


def _arm_of(file: Path, discovery: str) -> dict[str, str]:
    """The parameter `robot` in place of a file's that stands for the arm that its driver describes; else none."""
    try:
        from contact_reach_ros.ros.process import described
    except ImportError:
        return {}
    robot = str(parameters_in(file, "controller").get(ROBOT.name, ""))
    path = described(robot, "doctor", discovery)
    return {ROBOT.name: path} if path != robot else {}


def _parameters(file: Path, discovery: str) -> Finding:
    """Check the whole parameter file as bring-up does."""
    try:
        check_parameters(file, robot=_arm_of(file, discovery).get(ROBOT.name, ""))
    except ContactReachError as error:
        return failed(str(error), "correct what the message names")
    return Finding(Verdict.PASS, f"{file}: valid for {', '.join(NODES)}")
