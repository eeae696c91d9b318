"""All checks before a run, in order."""

from __future__ import annotations

import os
from pathlib import Path

from rich.console import Console

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import arm_in
from contact_reach_ros.doctor import arm as joints
from contact_reach_ros.doctor import machine
from contact_reach_ros.doctor.findings import (
    Finding,
    Report,
    Verdict,
    attempt,
    exit_code,
    failed,
    print_table,
    write_json,
)
from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.presets import check_parameters
from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import DEFAULT_PARAMETERS, NODES, RATE, parameters_in

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
        "machine": {"timer at 1 kHz": attempt(machine.timer_jitter)},
        "software": {"parameters": attempt(_parameters, file)},
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
    report["software"]["discovery"] = attempt(stack.discovery_in_use)
    try:
        graph, heard = stack.look_around(discovery, _LISTEN_S)
    except ContactReachError as error:
        fix = "see whether the middleware works: RMW_IMPLEMENTATION, ROS_DOMAIN_ID, the Fast DDS profile file"
        report["stack"] = {"nodes": failed(str(error), fix)}
        return report
    report["stack"] = {"nodes": attempt(stack.nodes, graph)}
    if graph.running:
        report["stack"]["safety state"] = attempt(stack.safety_state, graph)
        report["topics"] = {topic.name: attempt(stack.topic, graph, topic) for topic in topics.ALL}
        try:
            settings = graph.settings.get("controller") or parameters_in(file, "controller")
            arm = arm_in(settings, "the controller")
        except SettingsError:
            # The check of the file says why.
            return report
        record = stack.joint_record(heard, arm)
        report["arm"] = {
            "joint names and order": attempt(joints.joint_names, record, arm, graph.command_order),
            "gravity against torque": attempt(_gravity, record, file, arm),
        }
        # Simulated time may run at any speed.
        if not graph.publishers[topics.CLOCK.name]:
            report["arm"]["driver rate"] = attempt(joints.driver_rate, record, settings.get(RATE.name, RATE.default))
            report["arm"]["clocks"] = attempt(joints.clock_skew, record)
    return report


def _parameters(file: Path) -> Finding:
    """Check the whole parameter file as bring-up does; raises `ContactReachError` where it would not start."""
    check_parameters(file)
    return Finding(Verdict.PASS, f"{file}: valid for {', '.join(NODES)}")


def _gravity(record: joints.JointRecord, file: Path, arm: Arm) -> Finding:
    """`arm`: with its tool."""
    budget = load_budget(parameters_in(file, "observer").get("contact_budget", "")).resolve(arm)
    return joints.gravity(record, RobotModel(arm), budget)
