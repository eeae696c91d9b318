"""Starts and supervises the whole stack: `ros2 run contact_reach_ros bringup`."""

from __future__ import annotations

import dataclasses
import itertools
import os
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.nodes.discovery import CHOICES, reach
from contact_reach_ros.nodes.interruption import Interruption
from contact_reach_ros.nodes.managed import initialise
from contact_reach_ros.nodes.parameters import check_arguments, declare, early_value
from contact_reach_ros.nodes.processes import VIEWER, Override, StackOptions, processes
from contact_reach_ros.nodes.supervisor import StackError, Supervisor
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.scene import parse_target
from contact_reach_ros.settings import Settings, setting

NAME = "bringup"

STARTUP_TIMEOUT_S = 240.0
"""The first start compiles the planner."""


@dataclass(frozen=True)
class BringupSettings(Settings):
    """What to start."""

    scene: str = setting("ball", "scene: a name or the path of a YAML file")
    seed: int = setting(0, "seed of the scene and the sensor noise", minimum=0, maximum=2**31 - 1)
    target: str = setting("", "flange position that the scene is built for, 'x y z' in m; drawn when empty")
    lockstep: bool = setting(False, "simulated time that waits for every node, instead of real time")
    bag: str = setting("", "directory to record a bag to; none when empty")
    parameters: str = setting("", "parameter file for the nodes; the package's own when empty")
    driver: bool = setting(True, "start the simulated driver; false with a real robot's driver")
    discovery: str = setting(
        "host", "who hears the nodes: this host only, or everybody on the subnet, see docs/security.md", choices=CHOICES
    )
    view: bool = setting(False, "start the viewer, a page for browsers")
    overrides: tuple[str, ...] = setting(
        (), "parameters of nodes besides the file's: node:parameter=value each, the value as YAML"
    )


CHANGEABLE = ("scene", "seed", "target", "overrides")
"""Parameters that may be set while the stack runs; ~/restart puts them in force."""

SECTIONS = {"": BringupSettings}


def main() -> None:
    """Bring the stack up and supervise it until Ctrl-C, SIGTERM or the end of one process."""
    sys.exit(_run(sys.argv))


def _run(arguments: list[str]) -> int:
    interruption = Interruption()
    node: Node | None = None
    supervisor: Supervisor | None = None
    try:
        check_arguments(arguments, NAME, SECTIONS)
        (wanted,) = (entry for entry in BringupSettings.declared() if entry.name == "discovery")
        initialise(arguments, early_value(arguments, NAME, wanted))
        node = Node(NAME)
        stack = _Stack(node, _options(vars(declare(node, SECTIONS, CHANGEABLE)[""])))
        _say_discovery(node, stack.options.discovery)
        supervisor = Supervisor(node, processes(stack.options), stack.options.parameter_file, interruption)
        _supervise(stack, supervisor)
        return 0
    except StackError as error:
        print(f"{NAME}: {error}; ending the stack", file=sys.stderr)
        return 1
    except ContactReachError as error:
        print(f"{NAME}: {error}", file=sys.stderr)
        return 2
    finally:
        if supervisor is not None:
            supervisor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _say_discovery(node: Node, wanted: str) -> None:
    heard = reach(os.environ)
    line = heard.text
    if heard.choice != wanted:
        line += f"; the environment decides, parameter discovery = '{wanted}' has no effect"
    if heard.choice == wanted == "host":
        node.get_logger().info(line)
    else:
        node.get_logger().warning(line)


class _Stack:
    """What runs, and what shall run after the next restart."""

    def __init__(self, node: Node, options: StackOptions) -> None:
        self.node = node
        self.options = options
        self.restarting = threading.Event()
        self._wanted = options
        node.add_on_set_parameters_callback(self._on_parameters)
        node.create_service(Trigger, "~/restart", self._on_restart)

    def next_options(self) -> StackOptions:
        """What the parameters ask for, with a bag of its own."""
        bag = self.options.bag
        return dataclasses.replace(self._wanted, bag=_next_bag(bag) if bag else "")

    def keep(self, options: StackOptions) -> None:
        """Take note of what runs now."""
        self.options = options

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        known = {entry.name: entry for entry in BringupSettings.declared()}
        try:
            values = {
                parameter.name: known[parameter.name].check(parameter.value, f"parameter {parameter.name}")
                for parameter in parameters
                if parameter.name in CHANGEABLE
            }
            wanted = dataclasses.replace(self._wanted, **values)  # type: ignore[arg-type]
            table = processes(wanted)
            make_scene(read_scene(wanted.scene), wanted.seed, parse_target(wanted.target))
        except ContactReachError as error:
            return SetParametersResult(successful=False, reason=str(error))
        started = {entry.name for entry in table}
        for text in wanted.overrides:
            if Override.parse(text).node not in started:
                return SetParametersResult(successful=False, reason=f"override '{text}': this node is not started here")
        self._wanted = wanted
        return SetParametersResult(successful=True)

    def _on_restart(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.restarting.set()
        response.success, response.message = True, "the stack restarts"
        return response


def _options(values: Mapping[str, Any]) -> StackOptions:
    return StackOptions(**{**values, "overrides": tuple(values["overrides"])})


def _next_bag(bag: str) -> str:
    """The name with the first number behind it that is free."""
    numbers = itertools.count(2)
    return next(name for number in numbers if not Path(name := f"{bag}_{number}").exists())


def _supervise(stack: _Stack, supervisor: Supervisor) -> None:
    log = stack.node.get_logger()
    said = ""

    def progress(line: str) -> None:
        nonlocal said
        if line != said:
            log.info(line)
            said = line

    try:
        supervisor.bring_up(STARTUP_TIMEOUT_S, progress)
        log.info("all nodes are active; send a goal to goal_pose")
        while True:
            supervisor.check()
            supervisor.spin(0.1)
            if stack.restarting.is_set():
                stack.restarting.clear()
                _restart(stack, supervisor, progress)
    except KeyboardInterrupt:
        return


def _restart(stack: _Stack, supervisor: Supervisor, progress: Callable[[str], None]) -> None:
    """Another run; when it does not come up, as with a parameter that a node refuses, what ran before runs again."""
    log = stack.node.get_logger()
    before, options = stack.options, stack.next_options()
    log.info(f"restarting with scene {options.scene}, seed {options.seed}")
    try:
        supervisor.restart(processes(options), (VIEWER,), STARTUP_TIMEOUT_S, progress)
    except StackError as error:
        log.error(f"{error}; going back to what ran before")
        options = dataclasses.replace(before, bag=_next_bag(before.bag) if before.bag else "")
        supervisor.restart(processes(options), (VIEWER,), STARTUP_TIMEOUT_S, progress)
    stack.keep(options)
    log.info("all nodes are active again")


if __name__ == "__main__":
    main()
