"""The part of `contact-reach doctor` that needs ROS."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rclpy
from ament_index_python.packages import get_package_share_directory
from rclpy.node import Node
from rclpy.utilities import get_rmw_implementation_identifier

from contact_reach_ros.doctor import arm, sockets
from contact_reach_ros.doctor.findings import Check, Finding, failed, passed, warned
from contact_reach_ros.doctor.machine import disk
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.nodes import bringup, graph_checks, topics
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.discovery import OLD_SWITCH, RANGE, choose_discovery, reach
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.interfaces import DOCTOR
from contact_reach_ros.nodes.listening import Look
from contact_reach_ros.nodes.managed import initialise
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.parameters import Sections, check_arguments
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.nodes.processes import VIEWER, StackOptions
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.parameter_files import full_name, parameters_in
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.settings import read_yaml
from contact_reach_ros.viewer.settings import ViewerSettings

_DISTRIBUTION = "jazzy"
_LISTEN_S = 1.0
_COMPRESSED = 0.5
"""Size of what the recorder writes, as a share of what it gets."""

_MANAGED = (DriverNode, ControllerNode, ObserverNode, PlannerNode, RecorderNode)
_SECTIONS: Mapping[str, Sections] = {
    **{node.NAME: node.SECTIONS for node in _MANAGED},
    VIEWER: {"": ViewerSettings},
    bringup.NAME: bringup.SECTIONS,
}


class RosDoctor:
    """Checks of the ROS installation, the parameters and the running stack.

    Parameters
    ----------
    parameters
        Parameter file of the nodes; the package's own when empty.
    discovery
        How far to look for nodes, one of `discovery.CHOICES`.
    """

    def __init__(self, parameters: str, discovery: str) -> None:
        self._file = StackOptions(parameters=parameters).parameter_file
        self._discovery = discovery
        choose_discovery(discovery)

    def software(self) -> list[Check]:
        """Of the installation and its configuration."""
        return [
            Check("rclpy", ros_version),
            Check("middleware", middleware),
            Check("discovery", discovery_in_use),
            Check("sockets", running_sockets),
            Check("parameters", lambda: parameter_file(self._file)),
            Check("contact budget", lambda: contact_budget(self._file)),
        ]

    def planner_parameters(self) -> dict[str, Any]:
        """Of the planner node, dotted names, as it would start with.

        Raises
        ------
        SettingsError
            If the parameter file cannot be read.
        """
        own = {
            full_name(prefix, entry.name): list(entry.default) if isinstance(entry.default, tuple) else entry.default
            for prefix, settings in PlannerNode.SECTIONS.items()
            for entry in settings.declared()
        }
        given = parameters_in(self._file, PlannerNode.NAME)
        return own | {name: value for name, value in given.items() if name in own}

    def stack(self, bags: Path) -> dict[str, list[Check]]:
        """Of what is running, by part; looks around first, which takes seconds.

        Parameters
        ----------
        bags
            Where bags are recorded to.
        """
        initialise([DOCTOR], self._discovery)
        try:
            node = Node(DOCTOR)
            look = Look(node, _LISTEN_S)
            node.destroy_node()
        finally:
            rclpy.try_shutdown()
        graph = look.graph
        parts = {"stack": [Check("nodes", lambda: graph_checks.nodes(graph))]}
        rate = None
        if graph.running:
            parts["stack"] += [
                Check("lifecycle", lambda: graph_checks.lifecycle(graph)),
                Check("time source", lambda: graph_checks.time_source(graph)),
                Check("safety state", lambda: graph_checks.safety_state(graph)),
            ]
            parts["topics"] = [_topic_check(graph, topic) for topic in topics.ALL]
            parts["arm"] = self._arm(look)
            rate = look.bytes_per_second()
        parts["recording"] = [Check("disk for bags", lambda: disk(bags, rate and rate * _COMPRESSED))]
        return parts

    def _arm(self, look: Look) -> list[Check]:
        record, clock = look.joint_record(), look.clock_at_states()

        def gravity() -> Finding:
            budget = load_budget(parameters_in(self._file, ObserverNode.NAME).get("contact_budget", ""))
            return arm.gravity(record, RobotModel(), budget)

        return [
            Check("joint names and order", lambda: arm.joint_names(record, look.command_order)),
            Check("driver rate", lambda: arm.driver_rate(record, clock is not None)),
            Check("clocks", lambda: arm.clock_skew(record, clock)),
            Check("gravity against torque", gravity),
        ]


def _topic_check(graph: graph_checks.Graph, topic: graph_checks.Topic) -> Check:
    return Check(topic.name, lambda: graph_checks.topic(graph, topic))


def ros_version() -> Finding:
    """Which rclpy this is, and where it comes from."""
    name, distribution = "rclpy", os.environ.get("ROS_DISTRO", "")
    try:
        number = f"{importlib.metadata.version('ros-rclpy')} from unofficial wheels"
        wheels = True
    except importlib.metadata.PackageNotFoundError:
        manifest = Path(get_package_share_directory("rclpy")) / "package.xml"
        number, wheels = _manifest_version(manifest), False
    place = str(Path(rclpy.__file__).parent)
    sourced = any(
        place.startswith(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix
    )
    if distribution and not sourced:
        fix = "use the interpreter and environment that ROS uses (make venv with ROS sourced), or a shell without ROS"
        return warned(name, f"ROS 2 {distribution} is sourced, but rclpy {number} is imported from elsewhere", fix)
    if sourced and distribution != _DISTRIBUTION:
        fix = f"source ROS 2 {_DISTRIBUTION}: source /opt/ros/{_DISTRIBUTION}/setup.bash"
        return warned(name, f"rclpy {number}, ROS 2 {distribution or 'of unknown name'}", fix)
    words = f"{number}: for trying and testing; a robot uses the ROS 2 {_DISTRIBUTION} that is sourced"
    return passed(name, words if wheels else f"{number}, sourced ROS 2 {distribution}", wheels=wheels)


def middleware() -> Finding:
    """Which middleware carries the messages."""
    name, used = "middleware", get_rmw_implementation_identifier()
    try:
        number = importlib.metadata.version(f"ros-{used.replace('_', '-')}")
    except importlib.metadata.PackageNotFoundError:
        number = _manifest_version(Path(get_package_share_directory(used)) / "package.xml")
    found = f"{used} {number}, domain {os.environ.get('ROS_DOMAIN_ID', '0')}"
    if used != "rmw_fastrtps_cpp":
        fix = "export RMW_IMPLEMENTATION=rmw_fastrtps_cpp, which this package is measured with"
        return warned(name, f"{found}: config/fastdds.xml has no effect", fix)
    return passed(name, found)


def _manifest_version(manifest: Path) -> str:
    _, _, after = manifest.read_text().partition("<version>")
    return after.partition("<")[0]


def discovery_in_use() -> Finding:
    """Who can hear nodes that are started from here."""
    name, heard = "discovery", reach(os.environ)
    if heard.choice == "subnet":
        fix = (
            f"leave discovery at host and unset {RANGE}; else use a network of its own or SROS 2, see docs/security.md"
        )
        return warned(name, f"open to everybody on the subnet ({heard.why})", fix, choice=heard.choice)
    if not heard.choice:
        fix = "see that the file keeps to 127.0.0.1, or unset the variable to use the package's own profile"
        return warned(name, f"as {heard.why} says", fix, choice=heard.choice)
    if heard.shared_memory:
        variable = OLD_SWITCH if os.environ.get(OLD_SWITCH) == "1" else RANGE
        fix = f"unset {variable}: the package keeps to this host by itself"
        found = f"this host only ({heard.why}), also by shared memory, in which publishers were seen to stall"
        return warned(name, found, fix, choice=heard.choice)
    return passed(name, f"this host only ({heard.why})", choice=heard.choice)


def running_sockets() -> Finding:
    """Whether the nodes that run talk on this host only, whatever they were told."""
    name = "sockets"
    processes = sockets.node_processes(os.environ.get("ROS_DOMAIN_ID", "0"))
    opened: dict[str, list[str]] = {}
    looked = []
    for process, node in processes.items():
        try:
            addresses = sockets.bound_addresses(process)
        except OSError:
            continue
        looked.append(node)
        outside = sorted(address for address in addresses if not sockets.stays_on_this_host(address))
        if outside:
            opened[node] = outside
    if not looked:
        return passed(name, "no process of this package's nodes runs in this domain")
    if opened:
        where = "; ".join(f"{node} on {', '.join(addresses)}" for node, addresses in sorted(opened.items()))
        fix = "start the stack again with discovery: host if nobody outside shall command the arm, see docs/security.md"
        return warned(name, f"reachable from outside: {where}", fix, opened=opened)
    return passed(name, f"{', '.join(sorted(looked))} on 127.0.0.1 and its multicast only")


def parameter_file(file: Path) -> Finding:
    """Whether the nodes would start with the parameters of a file."""
    name = "parameters"
    fix = f"correct {file}; the pages in msg_docs/ list what each node accepts"
    try:
        patterns = list(read_yaml(file))
        for node, sections in _SECTIONS.items():
            check_arguments(["", "--params-file", str(file)], node, sections)
            _check_whole(file, node, sections)
    except ContactReachError as error:
        return failed(name, str(error), fix)
    nobody = [
        str(pattern) for pattern in patterns if "*" not in str(pattern) and str(pattern).strip("/") not in _SECTIONS
    ]
    if nobody:
        return warned(
            name, f"{file}: no node is called {', '.join(nobody)}", f"name one of {', '.join(_SECTIONS)} in {file}"
        )
    return passed(name, f"{file}: valid for {', '.join(_SECTIONS)}")


def _check_whole(file: Path, node: str, sections: Sections) -> None:
    """Make the settings objects, which also checks values against each other."""
    given = parameters_in(file, node)
    for prefix, settings in sections.items():
        names = {entry.name for entry in settings.declared()}
        own = {name: given[full_name(prefix, name)] for name in names if full_name(prefix, name) in given}
        settings.from_mapping(own, f"{file}: {node}.{prefix}".rstrip("."))


def contact_budget(file: Path) -> Finding:
    """Whether planner and observer have a contact budget, and the same."""
    name = "contact budget"
    paths = {
        node: parameters_in(file, node).get("contact_budget", "") for node in (PlannerNode.NAME, ObserverNode.NAME)
    }
    fix = "set contact_budget of planner and observer to one readable file (see config/contact_budget.yaml)"
    try:
        budgets = {node: load_budget(path) for node, path in paths.items()}
    except ContactReachError as error:
        return failed(name, str(error), fix)
    planner, observer = budgets.values()
    if planner != observer:
        return failed(name, f"planner and observer read different budgets: {paths}", fix)
    thresholds = ", ".join(f"{value:g}" for value in planner.torque_thresholds)
    return passed(name, f"{planner.permitted_force:g} N on one body, stop above {thresholds} Nm (A1 to A7)")
