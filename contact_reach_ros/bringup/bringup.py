"""Starts and supervises the whole stack: `ros2 run contact_reach_ros bringup`."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rclpy.node import Node

from contact_reach_ros.bringup.processes import resolved
from contact_reach_ros.bringup.settings import BRINGUP_SECTIONS, BringupOptions
from contact_reach_ros.bringup.stack_processes import StackError, StackProcesses
from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.ros.client import Client
from contact_reach_ros.ros.discovery import environment, reach
from contact_reach_ros.ros.parameters import check_arguments, namespace_in
from contact_reach_ros.ros.process import bare_node, in_namespace, with_description
from contact_reach_ros.settings import NODES, as_arguments, parameters_in

NAME = "bringup"


def main() -> None:
    """Bring the stack up and supervise it until Ctrl-C, SIGTERM, SIGHUP or the end of one process."""
    sys.exit(run_bringup(sys.argv))


def up(namespace: str = "", **options: Any) -> int:
    """Start the stack in a namespace, with options of `BringupOptions`, and supervise it, as the executable does."""
    return run_bringup([NAME, "--ros-args", *as_arguments(options), *in_namespace(namespace)])


def run_bringup(arguments: list[str]) -> int:
    """Run with a command line, program name first; returns the exit code."""
    try:
        arguments = with_description(arguments, NAME)
        options = resolved(check_arguments(arguments, NAME, BRINGUP_SECTIONS)[""], NAME, arguments)
        _check_own_files(arguments, options)
        arguments = [*arguments, *options.remappings]
        os.environ.update(environment(options.discovery))
        with bare_node(NAME, arguments) as node:
            _say_discovery(node, options.discovery)
            with StackProcesses(Client(node), options, passed_on=_remappings(arguments)) as stack:
                try:
                    log = node.get_logger()
                    stack.bring_up(lambda line: log.info(line))
                    log.info("all nodes are active; send a goal to goal_pose")
                    while True:
                        stack.watch(0.1)
                except KeyboardInterrupt:
                    return 0
                except StackError as error:
                    print(f"{NAME}: {error}; ending the stack", file=sys.stderr)
                    return 1
    except ContactReachError as error:
        print(f"{NAME}: {error}", file=sys.stderr)
        return 2
    return 0


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
        own = parameters_in(file, NAME, namespace_in(arguments)).keys()
        others = [node for node in NODES if parameters_in(file, node, namespace_in(arguments)).keys() - own]
        if others:
            raise SettingsError(
                f"{file}: bring-up does not pass on what is for {', '.join(others)}; give the nodes' file as "
                f"-p parameters:={file}"
            )


def _say_discovery(node: Node, wanted: str) -> None:
    choice, line = reach(os.environ)
    if choice != wanted:
        line += f"; the environment decides, parameter discovery = '{wanted}' has no effect"
    log = node.get_logger()
    (log.info if choice == wanted == "host" else log.warning)(line)


if __name__ == "__main__":
    main()
