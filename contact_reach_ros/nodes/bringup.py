"""Starts and supervises the whole stack: `ros2 run contact_reach_ros bringup`."""

from __future__ import annotations

import os
import signal
import sys
import threading
from dataclasses import dataclass

import rclpy
from rclpy.node import Node

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.nodes.discovery import CHOICES, reach
from contact_reach_ros.nodes.managed import initialise
from contact_reach_ros.nodes.parameters import check_arguments, declare, early_value
from contact_reach_ros.nodes.processes import StackOptions, processes
from contact_reach_ros.nodes.supervisor import StackError, Supervisor
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


SECTIONS = {"": BringupSettings}


def main() -> None:
    """Bring the stack up and supervise it until Ctrl-C, SIGTERM or the end of one process."""
    sys.exit(_run(sys.argv))


def _run(arguments: list[str]) -> int:
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    node: Node | None = None
    supervisor: Supervisor | None = None
    try:
        check_arguments(arguments, NAME, SECTIONS)
        (wanted,) = (entry for entry in BringupSettings.declared() if entry.name == "discovery")
        initialise(arguments, early_value(arguments, NAME, wanted))
        node = Node(NAME)
        options = StackOptions(**vars(declare(node, SECTIONS)[""]))
        _say_discovery(node, options.discovery)
        supervisor = Supervisor(node, processes(options), options.parameter_file)
        _supervise(node, supervisor, ended)
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


def _supervise(node: Node, supervisor: Supervisor, ended: threading.Event) -> None:
    said = ""

    def progress(line: str) -> None:
        nonlocal said
        if ended.is_set():
            raise KeyboardInterrupt
        if line != said:
            node.get_logger().info(line)
            said = line

    try:
        supervisor.bring_up(STARTUP_TIMEOUT_S, progress)
    except KeyboardInterrupt:
        return
    node.get_logger().info("all nodes are active; send a goal to goal_pose")
    while not ended.is_set():
        supervisor.check()
        supervisor.spin(0.1)


if __name__ == "__main__":
    main()
