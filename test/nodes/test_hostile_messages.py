"""Well-typed but absurd messages, requests and transitions at every node: none ends it, and refusals are counted.

The nodes are real ones, in this process; their loops take a turn when the test lets them, so that nothing that a loop
raises is lost in a thread.
"""

import time
import traceback
from functools import partial

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME, REST
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point
from hostile import hostile
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from plans import make_plan
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from stack_helpers import ros
from std_msgs.msg import Float64MultiArray, Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import iiwa14
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose, to_status, to_time
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

EXAMPLES = 25
"""Of messages of a topic, and of requests."""


class StandingStill:
    """A core whose plans keep the arm where it is."""

    memory = None
    since_reset = candidates = 1

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


def joint_state():
    efforts = MODEL.gravity_at(HOME).tolist()
    message = JointState(name=list(ARM.joint_names), position=HOME.tolist(), velocity=REST.tolist(), effort=efforts)
    message.header.frame_id, message.header.stamp = ARM.base_frame, to_time(START_NS)
    return message


def obstacles():
    """Two spheres that an edge joins, one of which is fixed, and a ball."""

    def marker(namespace, number, kind, *places):
        made = Marker(ns=namespace, id=number, type=kind, points=[Point(x=0.5, y=y) for y in places])
        made.header.frame_id, made.scale.x, made.pose.orientation.w = ARM.base_frame, 0.05, float(not places)
        return made

    spheres = [marker(name, 3, Marker.SPHERE_LIST, y) for name, y in (("obstacles", 0.0), ("fixed", 0.1))]
    edges, ball = marker("edges", 3, Marker.LINE_LIST, 0.0, 0.1), marker("ball", 4, Marker.SPHERE)
    return MarkerArray(markers=[*spheres, edges, ball])


def safety_state():
    contact = {
        "contact link": ARM.contact_links[-1],
        "contact force xyz N": "0 12 0",
        "contact position xyz m": "0 0 1",
    }
    return to_status("observer", "contact", {"level": "contact", **contact}, level=1)


def plan_markers():
    """A path, and of the other kinds one each."""
    return MarkerArray(
        markers=list({marker.ns: marker for marker in to_markers(still(START_NS), ARM).markers}.values())
    )


VALID = {
    topics.JOINT_STATES: joint_state,
    topics.COMMANDS: lambda: Float64MultiArray(data=[1.0] * 7),
    topics.ADAPTER_COMMANDS: lambda: Float64MultiArray(data=[1.0] * 7),
    topics.REFERENCE_POSE: lambda: to_references(still(START_NS + 10_000_000), ARM)[0],
    topics.REFERENCE_POSTURE: lambda: to_references(still(START_NS + 10_000_000), ARM)[1],
    topics.SAFETY_STATE: safety_state,
    topics.LOCKSTEP_HORIZON: lambda: Header(frame_id="observer"),
    topics.GOAL_POSE: lambda: to_goal_pose([0.5, 0.0, 0.4], ARM.base_frame, Time()),
    topics.OBSTACLES: obstacles,
    topics.EXTERNAL_TORQUE: joint_state,
    topics.PLAN_MARKERS: plan_markers,
    topics.SIM_CONTACTS: lambda: JointState(name=[*ARM.contact_links, "sum"], effort=[1.0] * 7),
    topics.DIAGNOSTICS: lambda: DiagnosticArray(status=[to_status("driver", "ok", {"round trip p50 us": "300"})]),
    topics.PLAN_STATISTICS: lambda: DiagnosticArray(status=[to_status("planner", "max_steps", goal_values(HOME[:3]))]),
    topics.CLOCK: Clock,
    topics.SETTINGS: lambda: to_status("controller", "", {"supervision.gravity_compensation": "false"}),
}

NO_MESSAGE = b"\0\1\0\0\xff\xff\xff\x7f"
_WAIT_NS = 10_000_000

CONTROLLER_HEARS = (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE, topics.SAFETY_STATE, topics.LOCKSTEP_HORIZON)
ATTACKS = {
    ControllerNode: (topics.JOINT_STATES, *CONTROLLER_HEARS, topics.CLOCK),
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

    def send(self, topic, data):
        """Publish, and let the node take what has come."""
        if topic.name not in self._publishers:
            publisher = self.attacker.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
            self._publishers[topic.name] = publisher
            while not publisher.get_subscription_count():
                self.turn()
        self._publishers[topic.name].publish(data)
        self.turn()

    def attack(self, strategy, act, always=()):
        """Do something with many examples, and with these; none of them may be a fault of the node's program."""
        count = EXAMPLES // 3 if isinstance(self.node, ViewerNode | RecorderNode) else EXAMPLES

        @settings(max_examples=count, suppress_health_check=list(HealthCheck))
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
        if service not in self._clients:
            self._clients[service] = self.attacker.create_client(kind, f"{self.node.get_name()}/{service}")
            assert self._clients[service].wait_for_service(10.0)
        answer = self._clients[service].call_async(request)
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


@pytest.fixture(params=ATTACKS, ids=lambda node_class: node_class.NAME)
def bench(request, tmp_path, monkeypatch):
    """Each node, with something to lose."""
    node_class = request.param
    monkeypatch.setattr(planner_module, "RecedingHorizonPlanner", StandingStill)
    # Nobody promises anything here.
    monkeypatch.setattr(inbox_module, "_LONGEST_HOLD_S", 0.0)
    parameters = (*PARAMETERS[node_class], *([f"bag:={tmp_path / 'bag'}"] if node_class is RecorderNode else []))
    with ros("--ros-args", *(part for parameter in parameters for part in ("-p", parameter))):
        made = Bench(node_class)
        if node_class is ViewerNode:
            # Without a browser the page draws nothing.
            monkeypatch.setattr(made.node._server, "get_clients", lambda: {0: None})
        for heard in (topics.JOINT_STATES, topics.GOAL_POSE):
            if heard in ATTACKS[node_class]:
                made.send(heard, VALID[heard]())
        yield made
        made.node.close()


def test_absurd_messages_are_refused(bench):
    node, commands = bench.node, []
    if isinstance(node, ControllerNode):
        node._write_commands = commands.append
        node.look_around()
    for topic in ATTACKS[type(node)]:
        before, valid = sum(node.refused.values()), VALID[topic]()
        bench.attack(hostile(valid), partial(bench.send, topic), [NO_MESSAGE, *late_and_early(valid)])
        bench.check()
        if not isinstance(node, RecorderNode) and topic is not topics.CLOCK:
            assert sum(node.refused.values()) > before, topic.name
    assert all(np.isfinite(np.frombuffer(data[-56:])).all() for data in commands)


NAMES = ("", "robot", "use_sim_time", "cpus", "seed", ".", "configure", "x" * 300, "\N{SNOWMAN}")
TRANSITIONS = (1, 2, 3, 4, 0, 8, 10, 60, 255)
"""Ids: the four that a user needs, and others that are not for users or do not exist; not those that end the node."""


@st.composite
def requests(draw):
    """The type of a node's service, its name, and a request that is mostly absurd."""
    number, text = draw(st.integers(0, 255)), draw(st.sampled_from(NAMES))
    entry = Parameter(name=text, value=ParameterValue(type=number, string_value=text))
    transition = Transition(id=draw(st.sampled_from(TRANSITIONS)), label=text)
    made = [
        (ChangeState, "change_state", ChangeState.Request(transition=transition)),
        (Trigger, "stop", Trigger.Request()),
        (Trigger, "reset", Trigger.Request()),
        (SetParameters, "set_parameters", SetParameters.Request(parameters=[entry])),
        (GetParameters, "get_parameters", GetParameters.Request(names=[text] * number)),
        (DescribeParameters, "describe_parameters", DescribeParameters.Request(names=[text])),
    ]
    # Transitions half of the time: what the others do depends on the state.
    return draw(st.just(made[0]) | st.sampled_from(made))


def test_absurd_requests_are_answered(bench):
    services = {service.srv_name.rpartition("/")[2] for service in bench.node.services}
    before = sum(bench.node.refused.values())
    bench.attack(requests().filter(lambda request: request[1] in services), lambda request: bench.call(*request))
    assert bench.state() <= State.PRIMARY_STATE_ACTIVE
    assert sum(bench.node.refused.values()) > before
