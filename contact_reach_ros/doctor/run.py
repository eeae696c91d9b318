"""All checks before a run, in order."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

from rich.console import Console

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import arm_in
from contact_reach_ros.bringup.settings import BringupOptions
from contact_reach_ros.doctor import arm as joints
from contact_reach_ros.doctor import machine
from contact_reach_ros.doctor.findings import (
    Finding,
    Report,
    Verdict,
    exit_code,
    failed,
    print_table,
    write_report,
)
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.presets import check_parameters
from contact_reach_ros.settings import NODES, RATE, ROBOT, parameters_in

_LISTEN_S = 1.0


def run_doctor(file: Path | None = None, namespace: str = "", **options: Any) -> int:
    """Make all checks and print them; returns the exit code: 1 if something failed, else 0.

    `file` takes the findings as JSON; `namespace` is that of the stack, such as left; `options` are those of
    `BringupOptions` with which the stack runs or will run. With an adapter's kind and no stack, that driver is
    examined. Raises `InputError` if the file cannot be written.
    """
    console, chosen = Console(), BringupOptions.from_mapping({"driver": False, **options}, "options")
    with console.status("looking at this machine and its software ..."):
        report = examine(chosen, f"/{namespace.strip('/')}")
    print_table(report, console)
    if file is not None:
        write_report(report, file)
    return exit_code(report)


def examine(options: BringupOptions, namespace: str = "/") -> Report:
    """Make all checks, of the nodes with a parameter file in a namespace, such as /left."""
    options, parameters = _parameters(options, namespace)
    report = {
        "machine": {"timer at 1 kHz": machine.timer_jitter()},
        "software": {"parameters": parameters},
    }
    try:
        # rclpy is only needed, and only has to be installed, for what follows.
        from contact_reach_ros.doctor import driver, stack
        from contact_reach_ros.messages import topics
        from contact_reach_ros.ros.discovery import environment
    except ImportError as error:
        fix = "source /opt/ros/jazzy/setup.bash, or install the wheels with make venv"
        report["software"]["rclpy"] = failed(f"cannot be imported ({error}): no node can run", fix)
        return report
    os.environ.update(environment(options.discovery))
    report["software"]["discovery"] = stack.discovery_in_use()
    try:
        graph, heard = stack.look_around(_LISTEN_S, namespace)
    except ContactReachError as error:
        fix = "see whether the middleware works: RMW_IMPLEMENTATION, ROS_DOMAIN_ID, the Fast DDS profile file"
        report["stack"] = {"nodes": failed(str(error), fix)}
        return report
    if is_alone := options.adapter != "none" and not graph.states.keys() & set(stack.NEEDED_NODES):
        report["stack"] = {}
    else:
        report["stack"] = {"nodes": stack.nodes(graph)}
        if not graph.running:
            return report
        report["stack"]["safety state"] = stack.safety_state(graph)
        report["stack"]["without commands"] = stack.commands_end(graph)
        report["topics"] = {topic.name: stack.topic(graph, topic) for topic in topics.ALL}
    try:
        file, given = options.parameter_file, {ROBOT.name: options.robot, RATE.name: options.state_rate}
        asked = {name: value for name, value in given.items() if value}
        settings = graph.settings.get("controller") or parameters_in(file, "controller", namespace) | asked
        rate = settings.get(RATE.name, RATE.default)
        arm = arm_in(settings, "the controller")
        budget = load_budget(parameters_in(file, "observer", namespace).get("contact_budget", "")).resolve(arm)
        if is_alone:
            report["driver"], record = driver.listen(options, arm, 1.0 / rate, _LISTEN_S, namespace)
        else:
            record = stack.joint_record(heard, arm)
    except ContactReachError as error:
        report["arm"] = {"driver": failed(str(error), "correct what the message names")} if is_alone else {}
        return report
    # The adapter puts commands into the drive's order.
    order = arm.joint_names if is_alone or graph.adapter else graph.drive.get("joints")
    report["arm"] = {
        "joint names and order": joints.joint_names(record, arm, order),
        "gravity against torque": joints.gravity(record, RobotModel(arm), budget),
    }
    # Simulated time may run at any speed.
    if not graph.publishers[topics.CLOCK.name]:
        report["arm"]["driver rate"] = joints.driver_rate(record, rate)
        report["arm"]["clocks"] = joints.clock_skew(record)
    return report


def _parameters(options: BringupOptions, namespace: str) -> tuple[BringupOptions, Finding]:
    """Check the whole parameter file as bring-up does; the options have a file for an arm that is described."""
    file = options.parameter_file
    try:
        with contextlib.suppress(ImportError):
            from contact_reach_ros.bringup.processes import resolved

            options = resolved(options, "doctor", ["doctor", "-r", f"__ns:={namespace}"])
        check_parameters(file, robot=options.robot, namespace=namespace)
    except ContactReachError as error:
        return options, failed(str(error), "correct what the message names")
    return options, Finding(Verdict.PASS, f"{file}: valid for {', '.join(NODES)}")
