"""Well-typed but absurd messages, requests and transitions at every node: none ends it, and refusals are counted.

The nodes are real ones, in this process; their loops take a turn when the test lets them, so that nothing that a loop
raises is lost in a thread.
"""

import time
import traceback
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME, REST
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
from hostile import hostile
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from plans import make_plan
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from stack_helpers import environment
from std_msgs.msg import Float64MultiArray, Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import iiwa14
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose, to_time
from contact_reach_ros.messages.plan_messages import to_markers, to_references
from contact_reach_ros.messages.values import goal_values
from contact_reach_ros.nodes import planner as planner_module
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.nodes.viewer import ViewerNode
from contact_reach_ros.ros import inbox as inbox_module
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.ros.interfaces import HEARD_BY_VIEWER

ARM = iiwa14.ARM
START_NS = 1_000_000_000_000
MODEL = RobotModel(ARM)
POSITION, ROTATION = MODEL.tip_pose(HOME)
KNOTS = 5

EXAMPLES = 40
"""Of messages of a topic, and of requests."""


class StandingStill:
    """A core whose plans keep the arm where it is."""

    memory = None
    since_reset = 1
    candidates = 1

    def __init__(self, *_):
        pass

    def warm_up(self, progress):
        pass

    def reset(self):
        pass

    def plan(self, request):
        return still(request.effect_ns)


def still(effect_ns):
    return make_plan(
        np.tile(POSITION, (KNOTS, 1)),
        np.tile(ROTATION, (KNOTS, 1, 1)),
        np.tile(HOME, (KNOTS, 1)),
        effect_ns=effect_ns,
        predicted_q=np.tile(HOME, (KNOTS + 1, 1)),
        predicted_positions=np.tile(POSITION, (KNOTS + 1, 1)),
        predicted_contact_forces=np.full((KNOTS, len(ARM.contact_links)), 3.0),
    )


def joint_state(stamp_ns):
    message = JointState(
        name=list(ARM.joint_names),
        position=HOME.tolist(),
        velocity=REST.tolist(),
        effort=MODEL.gravity_at(HOME).tolist(),
    )
    message.header.frame_id = ARM.base_frame
    message.header.stamp = to_time(stamp_ns)
    return message


def goal():
    return to_goal_pose([0.5, 0.0, 0.4], ARM.base_frame, Time())


def obstacles():
    message = MarkerArray()
    for number, (namespace, kind) in enumerate(
        [
            ("obstacles", Marker.SPHERE_LIST),
            ("fixed", Marker.SPHERE_LIST),
            ("edges", Marker.LINE_LIST),
            ("ball", Marker.SPHERE),
        ]
    ):
        marker = Marker(ns=namespace, id=3 if number < 3 else 4, type=kind)
        marker.header.frame_id = ARM.base_frame
        marker.scale.x = 0.05
        if kind != Marker.SPHERE:
            marker.pose.orientation.w = 0.0
            marker.points = [Point(x=0.5, y=0.1 * (number == 1)), Point(x=0.6)][: 1 if number < 2 else 2]
        message.markers.append(marker)
    message.markers[2].points = [Point(x=0.5), Point(x=0.5, y=0.1)]
    return message


def safety_state():
    values = {
        "level": "contact",
        "contact link": ARM.contact_links[-1],
        "contact force xyz N": "0 12 0",
        "contact position xyz m": "0.5 0 0.4",
    }
    message = DiagnosticStatus(level=DiagnosticStatus.WARN, name="observer", message="contact")
    message.values = [KeyValue(key=key, value=value) for key, value in values.items()]
    return message


def contacts():
    return JointState(name=[*ARM.contact_links, "sum", "max"], effort=[1.0] * (len(ARM.contact_links) + 2))


def plan_markers():
    shown = to_markers(still(START_NS), ARM)
    # A path, and of the other kinds one each.
    kinds = {marker.ns: marker for marker in shown.markers}
    return MarkerArray(markers=list(kinds.values()))


def controller_settings():
    entry = KeyValue(key="supervision.gravity_compensation", value="false")
    return DiagnosticStatus(name="controller", message="contact_reach_ros", values=[entry])


def diagnostics():
    entry = KeyValue(key="round trip p50 us", value="300")
    return DiagnosticArray(status=[DiagnosticStatus(name="driver", message="ok", values=[entry])])


def plan_statistics():
    entries = [KeyValue(key=key, value=str(value)) for key, value in goal_values(np.array([0.5, 0.1, 0.3])).items()]
    return DiagnosticArray(status=[DiagnosticStatus(name="planner", message="max_steps", values=entries)])


VALID = {
    topics.JOINT_STATES: lambda: joint_state(START_NS),
    topics.COMMANDS: lambda: Float64MultiArray(data=[1.0] * 7),
    topics.REFERENCE_POSE: lambda: to_references(still(START_NS + 10_000_000), ARM)[0],
    topics.REFERENCE_POSTURE: lambda: to_references(still(START_NS + 10_000_000), ARM)[1],
    topics.SAFETY_STATE: safety_state,
    topics.LOCKSTEP_HORIZON: lambda: Header(frame_id="observer"),
    topics.GOAL_POSE: goal,
    topics.OBSTACLES: obstacles,
    topics.EXTERNAL_TORQUE: lambda: joint_state(START_NS),
    topics.PLAN_MARKERS: plan_markers,
    topics.SIM_CONTACTS: contacts,
    topics.DIAGNOSTICS: diagnostics,
    topics.PLAN_STATISTICS: plan_statistics,
    topics.CLOCK: Clock,
    topics.SETTINGS: controller_settings,
}

VALID[topics.ADAPTER_COMMANDS] = VALID[topics.COMMANDS]

NO_MESSAGE = b"\0\1\0\0\xff\xff\xff\x7f"
_WAIT_NS = 10_000_000

ATTACKS = {
    ControllerNode: (
        topics.JOINT_STATES,
        topics.REFERENCE_POSE,
        topics.REFERENCE_POSTURE,
        topics.SAFETY_STATE,
        topics.LOCKSTEP_HORIZON,
        topics.CLOCK,
    ),
    DriverNode: (topics.COMMANDS, topics.LOCKSTEP_HORIZON),
    ObserverNode: (topics.JOINT_STATES, topics.CLOCK),
    PlannerNode: (topics.JOINT_STATES, topics.GOAL_POSE, topics.OBSTACLES, topics.SAFETY_STATE, topics.CLOCK),
    ViewerNode: HEARD_BY_VIEWER,
    AdapterNode: (topics.JOINT_STATES, topics.ADAPTER_COMMANDS, topics.SETTINGS),
    RecorderNode: (topics.JOINT_STATES, topics.REFERENCE_POSTURE, topics.OBSTACLES),
}

PARAMETERS = {
    ControllerNode: ("use_sim_time:=true", "supervision.require_observer:=false"),
    DriverNode: ("lockstep:=true", "scene:=free"),
    ObserverNode: ("use_sim_time:=true",),
    PlannerNode: ("use_sim_time:=true",),
    ViewerNode: ("port:=0",),
    AdapterNode: ("kind:=effort",),
    RecorderNode: (),
}


def late_and_early(message):
    """The same message with stamps at the ends of what its type can hold."""
    if hasattr(message, "header"):
        for sec, nanosec in ((2**31 - 1, 0), (2**31 - 1, 999_999_999), (2**31 - 1, 2**32 - 1), (-(2**31), 0)):
            message.header.stamp = Time(sec=sec, nanosec=nanosec)
            yield serialize_message(message)


class Bench:
    """A node whose loop and services run when the test lets them, and an attacker beside it."""

    def __init__(self, node_class):
        self.node = node_class()
        self.node.boundary.protect(self.node)
        self.faults = []
        self.node.boundary._on_fault = lambda _, error: self.faults.append(error)
        self.attacker = rclpy.create_node("attacker", use_global_arguments=False)
        self._publishers = {}
        self._clients = {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._executor.add_node(self.attacker)
        self.node.trigger_configure()
        self.node.trigger_activate()
        assert self.node.running

    @property
    def refusals(self):
        return sum(self.node.refused.values())

    def send(self, topic, data):
        """Publish, and let the node take what has come."""
        publisher = self._publishers.get(topic.name)
        if publisher is None:
            publisher = self.attacker.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
            self._publishers[topic.name] = publisher
            while not publisher.get_subscription_count():
                self.turn()
        publisher.publish(data)
        self.turn()

    def attack(self, strategy, act, always=()):
        """Do something with many examples, and with these; none of them may be a fault of the node's program."""

        slow = isinstance(self.node, ViewerNode | RecorderNode)

        @settings(
            max_examples=EXAMPLES // 3 if slow else EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck)
        )
        @given(strategy)
        def attack(what):
            act(what)
            faults, self.faults = self.faults, []
            assert not faults, "".join(traceback.format_exception(faults[0]))

        for what in always:
            attack = example(what)(attack)
        attack()

    def turn(self):
        node = self.node
        if isinstance(node, ViewerNode | RecorderNode):
            node._due = 0.0
            node.turn()
        else:
            node.inbox.wait(_WAIT_NS)
        if isinstance(node, DriverNode):
            node._tick(node.robot.now_ns)
            node._publish(node.robot.read(), node.robot.shows_obstacles())
        self._executor.spin_once(0.001)

    def call(self, kind, service, request):
        """The answer of one of the node's services."""
        client = self._clients.get(service)
        if client is None:
            client = self._clients[service] = self.attacker.create_client(kind, f"{self.node.get_name()}/{service}")
            assert client.wait_for_service(10.0)
        answer = client.call_async(request)
        deadline = time.monotonic() + 10.0
        while not answer.done():
            assert time.monotonic() < deadline, f"{service} does not answer"
            self.turn()
        return answer.result()

    def state(self):
        return self.call(GetState, "get_state", GetState.Request()).current_state.id

    def check(self):
        """The node is active, and nothing that came was a fault of its program."""
        self.node._publish_diagnostics()
        self.node.write_out()
        assert self.state() == State.PRIMARY_STATE_ACTIVE


@contextmanager
def bench(node_class, folder, monkeypatch):
    monkeypatch.setattr(planner_module, "RecedingHorizonPlanner", StandingStill)
    # Nobody promises anything here.
    monkeypatch.setattr(inbox_module, "_LONGEST_HOLD_S", 0.0)
    parameters = [*PARAMETERS[node_class]]
    if node_class is RecorderNode:
        parameters.append(f"bag:={folder / 'bag'}")
    arguments = [part for parameter in parameters for part in ("-p", parameter)]
    rclpy.init(args=["--ros-args", *arguments], domain_id=int(environment()["ROS_DOMAIN_ID"]))
    made = None
    try:
        made = Bench(node_class)
        if node_class is ViewerNode:
            # Without a browser the page draws nothing.
            monkeypatch.setattr(made.node._server, "get_clients", lambda: {0: None})
        yield made
    finally:
        if made is not None:
            made.node.close()
        rclpy.shutdown()


@pytest.mark.parametrize("node_class", ATTACKS, ids=lambda node_class: node_class.NAME)
def test_absurd_messages_are_refused(node_class, tmp_path, monkeypatch):
    with bench(node_class, tmp_path, monkeypatch) as it:
        commands = []
        if node_class is ControllerNode:
            it.node._write_commands = commands.append
            it.node.look_around()
        for heard in (topics.JOINT_STATES, topics.GOAL_POSE):
            if heard in ATTACKS[node_class]:
                # So that there is something to lose.
                it.send(heard, VALID[heard]())
        for topic in ATTACKS[node_class]:
            before = it.refusals

            valid = VALID[topic]()
            it.attack(hostile(valid), partial(it.send, topic), [NO_MESSAGE, *late_and_early(valid)])
            it.check()
            if node_class is not RecorderNode and topic not in (topics.CLOCK,):
                assert it.refusals > before, topic.name
        assert all(np.isfinite(np.frombuffer(data[-56:])).all() for data in commands)


@st.composite
def requests(draw):
    """A service of a node, its type, and a request that is mostly absurd."""
    number, text = draw(st.integers(0, 255)), draw(st.sampled_from(NAMES))
    entry = Parameter(name=text, value=ParameterValue(type=number, string_value=text))
    made = {
        "change_state": ChangeState.Request(transition=Transition(id=draw(st.sampled_from(TRANSITIONS)), label=text)),
        "stop": Trigger.Request(),
        "reset": Trigger.Request(),
        "set_parameters": SetParameters.Request(parameters=[entry]),
        "set_parameters_atomically": SetParametersAtomically.Request(parameters=[entry] * 3),
        "get_parameters": GetParameters.Request(names=[text] * number),
        "describe_parameters": DescribeParameters.Request(names=[text]),
        "list_parameters": ListParameters.Request(prefixes=[text], depth=2**64 - 1 - number),
    }
    # Transitions half of the time: what the others do depends on the state.
    service = draw(st.just("change_state") | st.sampled_from(sorted(made)))
    return SERVICES[service], service, made[service]


NAMES = ("", "robot", "use_sim_time", "cpus", "seed", ".", "configure", "x" * 300, "\N{SNOWMAN}")

TRANSITIONS = (1, 2, 3, 4, 0, 8, 10, 60, 255)
"""Ids: the four that a user needs, and others that are not for users or do not exist; not those that end the node."""

SERVICES = {
    "change_state": ChangeState,
    "stop": Trigger,
    "reset": Trigger,
    "set_parameters": SetParameters,
    "set_parameters_atomically": SetParametersAtomically,
    "get_parameters": GetParameters,
    "describe_parameters": DescribeParameters,
    "list_parameters": ListParameters,
}


@pytest.mark.parametrize("node_class", ATTACKS, ids=lambda node_class: node_class.NAME)
def test_absurd_requests_are_answered(node_class, tmp_path, monkeypatch):
    with bench(node_class, tmp_path, monkeypatch) as it:
        for heard in (topics.JOINT_STATES, topics.GOAL_POSE):
            if heard in ATTACKS[node_class]:
                it.send(heard, VALID[heard]())
        services = {service.srv_name.rpartition("/")[2] for service in it.node.services}
        before = it.refusals

        def ask(request):
            kind, service, content = request
            if service in services:
                it.call(kind, service, content)

        it.attack(requests(), ask)
        assert it.state() in (
            State.PRIMARY_STATE_UNCONFIGURED,
            State.PRIMARY_STATE_INACTIVE,
            State.PRIMARY_STATE_ACTIVE,
        )
        assert it.refusals > before
