"""The viewer node: the topics of the stack on a page for browsers, and what its users want back to the stack."""

from __future__ import annotations

import json
import struct
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import ParameterDescriptor, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParametersAtomically
from rclpy.client import Client
from rclpy.parameter import Parameter as RosParameter
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.interfaces import STOPPABLE
from contact_reach_ros.nodes.managed import ManagedNode, run
from contact_reach_ros.nodes.messages import quaternion, to_point, vector
from contact_reach_ros.nodes.observer import read_contact
from contact_reach_ros.nodes.obstacle_markers import Material, ObstacleMarkerReader
from contact_reach_ros.nodes.parameters import Sections
from contact_reach_ros.nodes.plan_markers import ARM, ELBOW, FLANGE
from contact_reach_ros.nodes.processes import DEFAULT_PARAMETERS, TUNABLE, VIEWER
from contact_reach_ros.nodes.realtime import Role
from contact_reach_ros.nodes.serialized import JointStateReader, decode
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.resources import config_file
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.joint_order import JointOrder
from contact_reach_ros.robot.kinematics import rotation_from_quaternion
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.viewer.access import call, serve
from contact_reach_ros.viewer.frame import Level, PlanPicture, Status
from contact_reach_ros.viewer.live import LiveState
from contact_reach_ros.viewer.page import Page, Parameter, Source
from contact_reach_ros.viewer.recorded import Decoders, Recording
from contact_reach_ros.viewer.settings import ViewerSettings

TITLE = "contact_reach_ros"
BRINGUP = "bringup"

_ANSWER_S = 3.0
_FEW = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT)
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
# Only positions, radii and edges are shown.
_ANY_MATERIAL = Material(1.0, 1.0, 1.0, 1.0, 1.0)
_HIDDEN = ("use_sim_time", "autostart", "cpus", "start_type_description_service")


def make_decoders() -> Decoders:
    """What reads the messages that a bag holds, and some of those that come by topic."""
    return Decoders(
        ObstacleMarkerReader(_ANY_MATERIAL).read_serialized, read_plan, read_goal, read_status, read_numbers
    )


def read_plan(data: bytes) -> PlanPicture | None:
    """A message of plan/markers; None when it withdraws the plan."""
    message: MarkerArray = decode(data, MarkerArray, topics.PLAN_MARKERS.name)
    paths = {FLANGE: np.zeros((0, 3)), ELBOW: np.zeros((0, 3))}
    starts, ends, radii = [], [], []
    for marker in message.markers:
        if marker.action == Marker.DELETEALL:
            return None
        if marker.action != Marker.ADD:
            continue
        if marker.ns in paths:
            paths[marker.ns] = np.array([vector(point) for point in marker.points]).reshape(-1, 3)
        elif marker.ns == ARM:
            x, y, z, w = quaternion(marker.pose.orientation).tolist()
            half = 0.5 * marker.scale.z * rotation_from_quaternion((w, x, y, z))[:, 2]
            middle = vector(marker.pose.position)
            starts.append(middle - half)
            ends.append(middle + half)
            radii.append(0.5 * marker.scale.x)
    return PlanPicture(
        paths[FLANGE],
        paths[ELBOW],
        np.array(starts).reshape(-1, 3),
        np.array(ends).reshape(-1, 3),
        np.array(radii, float),
    )


def read_goal(data: bytes) -> np.ndarray:
    """Position (3,) in a message of goal_pose, m."""
    message: PoseStamped = decode(data, PoseStamped, topics.GOAL_POSE.name)
    position = vector(message.pose.position)
    if not np.isfinite(position).all():
        raise InputError(f"goal_pose: pose.position = {position.tolist()}; expected finite numbers in m")
    return position


def read_status(data: bytes) -> tuple[str, Status]:
    """Who says it, and what, in a message of safety_state."""
    return _status(decode(data, DiagnosticStatus, topics.SAFETY_STATE.name))


def read_numbers(data: bytes) -> dict[str, float]:
    """Numbers of a message of diagnostics, by '<node>/<key>'."""
    return _numbers(decode(data, DiagnosticArray, topics.DIAGNOSTICS.name))


class ViewerNode(ManagedNode):
    """Keeps the page up to date."""

    NAME = VIEWER
    SECTIONS: ClassVar[Sections] = {"": ViewerSettings}

    def __init__(self) -> None:
        super().__init__()
        settings: ViewerSettings = self.settings[""]
        self._period = 1.0 / settings.rate
        self._due = 0.0
        self._busy_ns = 0
        self._turns = 0
        self.live = LiveState()
        self._states = JointStateReader(iiwa14.JOINT_NAMES, topics.JOINT_STATES.name)
        self._torque_order = JointOrder(iiwa14.JOINT_NAMES)
        decoders = make_decoders()
        self._read_obstacles = decoders.obstacles
        inbox = self.inbox
        # The page shows thirty moments a second: of fast topics, only the newest message of each is ever decoded.
        inbox.add(topics.JOINT_STATES, self._on_state, topics.NEWEST, serialized=True)
        inbox.add(topics.EXTERNAL_TORQUE, self._on_torque, topics.NEWEST)
        inbox.add(topics.OBSTACLES, self._on_obstacles, serialized=True)
        inbox.add(topics.PLAN_MARKERS, self._on_plan, topics.NEWEST, serialized=True)
        inbox.add(topics.REFERENCE_POSE, self._on_plan_stamp, _FEW, serialized=True)
        inbox.add(topics.SIM_CONTACTS, self._on_contacts, _FEW)
        inbox.add(topics.GOAL_POSE, self._on_goal, serialized=True)
        inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        inbox.add(topics.DIAGNOSTICS, self._on_diagnostics, _FEW)
        self._server = serve(settings.address, settings.port, settings.token, TITLE)
        bag = Path(settings.bag)
        source = Source(
            self.live,
            StackActions(self),
            bag.resolve().parent if settings.bag else Path(settings.bags),
            lambda path: Recording(path, make_decoders()),
        )
        budget = load_budget(settings.contact_budget)
        recording = source.open_bag(bag) if settings.bag else None
        self._page = call(self._server, lambda: Page(self._server, source, budget, settings.shadows, settings.dark))
        if recording is not None:
            call(self._server, lambda: self._page.open(recording))
        self.get_logger().info(f"open {settings.page_address(self._server.get_port())}")

    def loop(self) -> None:
        """Take turns; the page starts to wait for joint states now."""
        self.live.start(time.monotonic())
        super().loop()

    def turn(self) -> None:
        """One update of the page."""
        wait = self._due - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        began_ns = time.monotonic_ns()
        self._due = max(self._due + self._period, time.monotonic())
        self.inbox.poll()
        call(self._server, lambda: self._page.turn(time.monotonic()))
        self._busy_ns += time.monotonic_ns() - began_ns
        self._turns += 1

    def close(self) -> None:
        """End the server."""
        self._server.stop()

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Browsers, updates and what they cost."""
        turns, busy_ns = self._turns, self._busy_ns
        self._turns = self._busy_ns = 0
        values = {
            "browsers": len(self._server.get_clients()),
            "updates": turns,
            "mean update ms": busy_ns / max(turns, 1) / 1e6,
        }
        return "", values

    def _on_state(self, data: bytes) -> None:
        try:
            stamp_ns, q, _, _ = self._states.read(data)
            if not np.isfinite(q).all():
                raise InputError(f"joint_states: position = {q.tolist()}; expected finite numbers in rad")
        except InputError as error:
            self.refuse("joint states", error)
            return
        self.live.on_joint_state(stamp_ns, q, time.monotonic())

    def _on_torque(self, message: JointState) -> None:
        try:
            self.live.on_external_torque(self._torque_order.pick(message, "effort", topics.EXTERNAL_TORQUE.name))
        except InputError as error:
            self.refuse("external torques", error)

    def _on_obstacles(self, data: bytes) -> None:
        try:
            self.live.on_obstacles(self._read_obstacles(data))
        except InputError as error:
            self.refuse("obstacles", error)

    def _on_plan(self, data: bytes) -> None:
        try:
            self.live.on_plan(read_plan(data))
        except InputError as error:
            self.refuse("plans", error)

    def _on_plan_stamp(self, data: bytes) -> None:
        if len(data) >= _STAMP_AT + _STAMP.size:
            seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_AT)
            self.live.on_plan_stamp(seconds * NANOSECONDS + nanoseconds)

    def _on_contacts(self, message: JointState) -> None:
        forces = dict(zip(message.name, message.effort, strict=False))
        largest = forces.pop("max", float("nan"))
        forces.pop("sum", None)
        self.live.on_contacts(forces, largest)

    def _on_goal(self, data: bytes) -> None:
        try:
            self.live.goal = read_goal(data)
        except InputError as error:
            self.refuse("goals", error)

    def _on_safety(self, message: DiagnosticStatus) -> None:
        name, status = _status(message)
        self.live.safety[name] = status

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.live.on_numbers(_numbers(message))


class StackActions:
    """What the page's users can do; each method is called in a thread of the server and may wait there."""

    def __init__(self, node: ViewerNode) -> None:
        self._node = node
        self._goals = node.make_publisher(topics.GOAL_POSE)
        self._clients: dict[str, Client] = {}
        self._lock = threading.Lock()

    def send_goal(self, position: np.ndarray) -> str:
        """As `Actions`."""
        if not self._goals.get_subscription_count():
            return "nobody hears goal_pose: is the planner running?"
        goal = PoseStamped()
        goal.header.frame_id = iiwa14.BASE_NAME
        goal.header.stamp = self._node.get_clock().now().to_msg()
        goal.pose.position = to_point(position.tolist())
        goal.pose.orientation.w = 1.0
        self._goals.publish(goal)
        return f"goal {np.round(position, 3).tolist()} m is sent"

    def stop(self) -> str:
        """As `Actions`: by the controller, or if it does not answer by who else can."""
        failures = []
        for name in STOPPABLE:
            try:
                answer = self._trigger(f"{name}/stop")
            except ContactReachError as error:
                failures.append(str(error))
                continue
            return f"{name}: {answer.message}"
        return "NOT stopped: " + "; ".join(failures)

    def reset(self) -> str:
        """As `Actions`: who is stopped, the controller last, since it refuses while the observer is stopped."""
        stopped = [name for name, status in self._node.live.safety.items() if status.level is Level.STOP]
        said = []
        for name in [name for name in reversed(STOPPABLE) if name in stopped]:
            try:
                answer = self._trigger(f"{name}/reset")
            except ContactReachError as error:
                said.append(str(error))
                continue
            said.append(f"{name}: {answer.message if answer.message else 'done'}")
            if not answer.success:
                break
        return "; ".join(said) or "nothing is stopped"

    def restart(self, scene: str, seed: int) -> str:
        """As `Actions`, by bring-up."""
        return self._restart({"scene": scene, "seed": seed})

    def nodes(self) -> Sequence[str]:
        """As `Actions`."""
        return TUNABLE

    def parameters(self, node: str) -> Sequence[Parameter]:
        """As `Actions`: those with a single value."""
        listed = self._call(ListParameters, f"{node}/list_parameters", ListParameters.Request())
        names = sorted(name for name in listed.result.names if name not in _HIDDEN and "qos_overrides" not in name)
        described = self._call(
            DescribeParameters, f"{node}/describe_parameters", DescribeParameters.Request(names=names)
        )
        values = self._call(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=names))
        kinds = (
            ParameterType.PARAMETER_BOOL,
            ParameterType.PARAMETER_INTEGER,
            ParameterType.PARAMETER_DOUBLE,
            ParameterType.PARAMETER_STRING,
        )
        return [
            _parameter(descriptor, value)
            for descriptor, value in zip(described.descriptors, values.values, strict=True)
            if value.type in kinds
        ]

    def apply(self, node: str, values: Mapping[str, bool | int | float | str]) -> str:
        """As `Actions`, by bring-up, which keeps what was changed before."""
        kept: dict[str, str] = {}
        response = self._try(GetParameters, f"{BRINGUP}/get_parameters", GetParameters.Request(names=["overrides"]))
        if isinstance(response, str):
            return response
        # A list that nobody has set has no value.
        for value in response.values:
            for text in value.string_array_value:
                kept[text.partition("=")[0]] = text
        for name, value in values.items():
            text = yaml.safe_dump(value, default_flow_style=True).removesuffix("\n...\n").strip()
            kept[f"{node}:{name}"] = f"{node}:{name}={text}"
        return self._restart({"overrides": list(kept.values())})

    def _restart(self, values: Mapping[str, Any]) -> str:
        request = SetParametersAtomically.Request(
            parameters=[RosParameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        )
        response = self._try(SetParametersAtomically, f"{BRINGUP}/set_parameters_atomically", request)
        if isinstance(response, str):
            return response
        if not response.result.successful:
            return str(response.result.reason)
        answer = self._try(Trigger, f"{BRINGUP}/restart", Trigger.Request())
        return answer if isinstance(answer, str) else str(answer.message)

    def _trigger(self, service: str) -> Any:
        return self._call(Trigger, service, Trigger.Request())

    def _try(self, kind: Any, service: str, request: Any) -> Any:
        """The answer, or what is wrong as a text."""
        try:
            return self._call(kind, service, request)
        except ContactReachError as error:
            return f"{error}; only a stack that bringup has started can be restarted"

    def _call(self, kind: Any, service: str, request: Any) -> Any:
        with self._lock:
            client = self._clients.get(service)
            if client is None:
                client = self._clients[service] = self._node.create_client(kind, service)
        if not client.wait_for_service(timeout_sec=_ANSWER_S):
            raise ContactReachError(f"{service}: there is no such service")
        answered = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(_ANSWER_S):
            client.remove_pending_request(future)
            raise ContactReachError(f"{service}: no answer within {_ANSWER_S:.0f} s")
        return future.result()


def _parameter(descriptor: ParameterDescriptor, value: ParameterValue) -> Parameter:
    ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
    limits = [(float(entry.from_value), float(entry.to_value)) for entry in ranges]
    low, high = limits[0] if limits else (-np.inf, np.inf)
    about = f"{descriptor.description}; {descriptor.additional_constraints}".strip("; ")
    return Parameter(
        descriptor.name,
        parameter_value_to_python(value),
        about,
        low if np.isfinite(low) else None,
        high if np.isfinite(high) else None,
    )


def _status(message: DiagnosticStatus) -> tuple[str, Status]:
    level = message.level[0] if isinstance(message.level, bytes) else int(message.level)
    try:
        contact = read_contact(message)
    except InputError:
        contact = None
    return message.name, Status(Level(min(level, Level.STOP.value)), message.message, contact)


def _numbers(message: DiagnosticArray) -> dict[str, float]:
    found = {}
    for status in message.status:
        for entry in status.values:
            try:
                found[f"{status.name}/{entry.key}"] = float(entry.value)
            except ValueError:
                continue
    return found


def view(chosen: Mapping[str, Any], parameters: Path | None) -> int:
    """Run the viewer with some of its parameters; returns the exit code.

    Parameters
    ----------
    chosen
        By the names of `ViewerSettings`.
    parameters
        Parameter file; the package's own when None.
    """
    file = parameters or config_file(DEFAULT_PARAMETERS)
    arguments = [VIEWER, "--ros-args", "--params-file", str(file)]
    for name, value in chosen.items():
        # JSON is YAML: quoted, a text stays a text.
        arguments += ["-p", f"{name}:={json.dumps(value if isinstance(value, int) else str(value))}"]
    return run(ViewerNode, Role.ONLOOKER, arguments)


def main() -> None:
    """Run the viewer."""
    sys.exit(run(ViewerNode, Role.ONLOOKER, sys.argv))


if __name__ == "__main__":
    main()
