"""Starts and supervises the whole stack: `ros2 run contact_reach_ros bringup`."""

from __future__ import annotations

import dataclasses
import itertools
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from contact_reach_ros.bringup.children import Interruption, StackError
from contact_reach_ros.bringup.processes import processes, stack_arm
from contact_reach_ros.bringup.settings import BRINGUP_SECTIONS, BringupOptions
from contact_reach_ros.bringup.stack_processes import StackProcesses
from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.ros.boundary import Boundary
from contact_reach_ros.ros.client import Client
from contact_reach_ros.ros.discovery import reach
from contact_reach_ros.ros.interfaces import VIEWER
from contact_reach_ros.ros.parameters import check_arguments, declare, early_value
from contact_reach_ros.ros.process import bare_node
from contact_reach_ros.ros.running import refuse_beside_another
from contact_reach_ros.scenes.generate import make_scene, parse_target
from contact_reach_ros.settings import check_node_names, sections_of_others
from contact_reach_ros.world.scene_file import read_scene

NAME = "bringup"

STARTUP_TIMEOUT_S = 240.0
"""The first start compiles the planner."""


CHANGEABLE = ("scene", "seed", "target", "overrides")
"""Parameters that may be set while the stack runs; ~/restart applies them."""

SECTIONS = BRINGUP_SECTIONS


def main() -> None:
    """Bring the stack up and supervise it until Ctrl-C, SIGTERM or the end of one process."""
    sys.exit(run_bringup(sys.argv))


def run_bringup(arguments: list[str]) -> int:
    """Run with a command line, program name first; returns the exit code."""
    interruption = Interruption()
    try:
        arm = check_arguments(arguments, NAME, SECTIONS)
        (wanted,) = (entry for entry in BringupOptions.declared() if entry.name == "discovery")
        with bare_node(NAME, early_value(arguments, NAME, wanted), arguments) as node:
            began = time.monotonic()
            configuration = _Configuration(node, declare(node, SECTIONS, arm, CHANGEABLE)[""])
            options = configuration.options
            _check_own_files(arguments, options)
            _say_discovery(node, options.discovery)
            table = processes(options)
            refuse_beside_another(node, [process.name for process in table], began)
            passed_on = _remappings(arguments)
            client = Client(node, _protect(node).refuse)
            stack = StackProcesses(client, table, options.parameter_file, interruption, passed_on=passed_on)
            try:
                _supervise(configuration, stack)
            except StackError as error:
                print(f"{NAME}: {error}; ending the stack", file=sys.stderr)
                return 1
            finally:
                stack.shutdown()
    except ContactReachError as error:
        print(f"{NAME}: {error}", file=sys.stderr)
        return 2
    return 0


def _protect(node: Node) -> Boundary:
    """Refuse bad requests, and log the last of each kind once a second."""
    boundary, log = Boundary(node.get_logger().error), node.get_logger()

    def log_refusals() -> None:
        for line in boundary.last_refusals():
            log.warning(line)

    node.create_timer(1.0, log_refusals, clock=Clock(clock_type=ClockType.STEADY_TIME))
    boundary.protect(node)
    return boundary


def _remappings(arguments: Sequence[str]) -> list[str]:
    """The remappings of topics and services on the command line: they hold for all nodes."""
    found = []
    for option, value in itertools.pairwise(arguments):
        if option in ("-r", "--remap") and not value.startswith("__"):
            found += [option, value]
    return found


def _check_own_files(arguments: Sequence[str], options: BringupOptions) -> None:
    """Refuse parameters of other nodes in a file that is for bring-up alone: nobody would read them."""
    for option, value in itertools.pairwise(arguments):
        file = Path(value)
        if option != "--params-file" or file.resolve() == options.parameter_file.resolve():
            continue
        check_node_names(file)
        others = sections_of_others(file, NAME)
        if others:
            raise SettingsError(
                f"{file}: bring-up does not pass on what is for {', '.join(others)}; give the nodes' file as "
                f"-p parameters:={file}"
            )


def _say_discovery(node: Node, wanted: str) -> None:
    heard = reach(os.environ)
    line = heard.text
    if heard.choice != wanted:
        line += f"; the environment decides, parameter discovery = '{wanted}' has no effect"
    if heard.choice == wanted == "host":
        node.get_logger().info(line)
    else:
        node.get_logger().warning(line)


class _Configuration:
    """The options that are running, and those of the next restart."""

    def __init__(self, node: Node, options: BringupOptions) -> None:
        self.node = node
        self.options = options
        self.restarting = threading.Event()
        self._wanted = options
        node.add_on_set_parameters_callback(self._on_parameters)
        node.create_service(Trigger, "~/restart", self._on_restart)

    def next_options(self) -> BringupOptions:
        """Options that the parameters ask for, with a new bag."""
        bag = self.options.bag
        return dataclasses.replace(self._wanted, bag=_next_bag(bag) if bag else "")

    def keep(self, options: BringupOptions) -> None:
        """Remember the options that are running now."""
        self.options = options

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        changes = {parameter.name: parameter.value for parameter in parameters if parameter.name in CHANGEABLE}
        try:
            wanted = BringupOptions.from_mapping({**vars(self._wanted), **changes}, f"parameters of {NAME}")
            processes(wanted)
            make_scene(read_scene(wanted.scene), stack_arm(wanted), wanted.seed, parse_target(wanted.target))
        except ContactReachError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._wanted = wanted
        return SetParametersResult(successful=True)

    def _on_restart(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.restarting.set()
        response.success, response.message = True, "the stack restarts"
        return response


def _next_bag(bag: str) -> str:
    """The name with the first free number appended."""
    numbers = itertools.count(2)
    return next(name for number in numbers if not os.path.exists(name := f"{bag}_{number}"))


def _supervise(configuration: _Configuration, stack: StackProcesses) -> None:
    log = configuration.node.get_logger()
    shown = ""

    def progress(line: str) -> None:
        nonlocal shown
        if line != shown:
            log.info(line)
            shown = line

    try:
        stack.bring_up(STARTUP_TIMEOUT_S, progress)
        log.info("all nodes are active; send a goal to goal_pose")
        while True:
            stack.watch(0.1)
            if configuration.restarting.is_set():
                configuration.restarting.clear()
                _restart(configuration, stack, progress)
    except KeyboardInterrupt:
        return


def _restart(configuration: _Configuration, stack: StackProcesses, progress: Callable[[str], None]) -> None:
    """Restart the stack; if it does not come up, as with a parameter that a node refuses, restore what ran before."""
    log = configuration.node.get_logger()
    before, options = configuration.options, configuration.next_options()
    log.info(f"restarting with scene {options.scene}, seed {options.seed}")
    try:
        stack.restart(processes(options), (VIEWER,), STARTUP_TIMEOUT_S, progress)
    except StackError as error:
        log.error(f"{error}; going back to what ran before")
        options = dataclasses.replace(before, bag=_next_bag(before.bag) if before.bag else "")
        stack.restart(processes(options), (VIEWER,), STARTUP_TIMEOUT_S, progress)
    configuration.keep(options)
    log.info("all nodes are active again")


if __name__ == "__main__":
    main()
