"""Well-typed but absurd messages, requests and transitions at every node: none ends it, and refusals are counted.

The nodes are real ones, in this process; their loops take a turn when the test lets them, so that nothing that a loop
raises is lost in a thread.
"""

import copy
import functools
import time
import traceback

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from builtin_interfaces.msg import Time
from hostile import hostile
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from interfaces import HEARD_BY_VIEWER
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from plans import make_plan
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.serialization import deserialize_message, serialize_message
from stack_helpers import SAMPLE, UNWATCHED, Beside, ros
from std_srvs.srv import Trigger

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_status
from contact_reach_ros.messages.obstacle_markers import obstacle_markers
from contact_reach_ros.messages.safety_state import WARN
from contact_reach_ros.nodes import planner as planner_module
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.nodes.viewer import ViewerNode
from contact_reach_ros.ros.lockstep import Lockstep
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.obstacle import BallSettings, WallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import rest_positions

POSITION, ROTATION = RobotModel(ARM).tip_pose(HOME)
KNOTS = 5

EXAMPLES = 16
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
        return make_plan(
            np.tile(POSITION, (KNOTS, 1)),
            np.tile(ROTATION, (KNOTS, 1, 1)),
            np.tile(HOME, (KNOTS, 1)),
            effect_ns=request.effect_ns,
            predicted_q=np.tile(HOME, (KNOTS + 1, 1)),
            predicted_positions=np.tile(POSITION, (KNOTS + 1, 1)),
            predicted_contact_forces=np.full((KNOTS, len(ARM.contact_links)), 3.0),
        )


@functools.cache
def recorded():
    """What had last come on each topic of a recorded stack, by name, when the arm was on its way."""
    types, heard, plans = {topic.name: topic.type for topic in topics.ALL}, {}, 0
    for raw in BagReader(SAMPLE).raw_messages():
        heard[raw.topic.removeprefix("/")] = raw.data
        plans += raw.topic == "/reference/posture"
        if plans == 10:
            break
    heard = {name: deserialize_message(data, types[name]) for name, data in heard.items() if name in types}
    obstacles = [*BallSettings().at(POSITION), *WallSettings(nodes=(2, 2, 2)).at(POSITION)[:1]]
    scene = Scene("test", ARM, 0, HOME, np.zeros(3), tuple(obstacles))
    shown = obstacle_markers(scene, rest_positions(scene), heard["joint_states"].header.stamp.sec * NANOSECONDS)
    touched = {"level": "contact", "contact link": ARM.contact_links[-1], "contact position xyz m": "0 0 1"}
    safety = to_status("observer", "contact", {**touched, "contact force xyz N": "0 12 0"}, WARN)
    made = {topics.OBSTACLES: shown, topics.SAFETY_STATE: safety, topics.ADAPTER_COMMANDS: heard[topics.COMMANDS.name]}
    return {**heard, **{topic.name: message for topic, message in made.items()}}


NO_MESSAGE = b"\0\1\0\0\xff\xff\xff\x7f"
_WAIT_NS = 10_000_000

SIMULATED = "use_sim_time:=true"
CONTROLLER_HEARS = (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE, topics.SAFETY_STATE, topics.LOCKSTEP_HORIZON)
NODES = {
    ControllerNode: ([SIMULATED, UNWATCHED], (topics.JOINT_STATES, *CONTROLLER_HEARS)),
    DriverNode: (["use_sim_time:=true", "scene:=free"], (topics.COMMANDS, topics.LOCKSTEP_HORIZON)),
    ObserverNode: ([SIMULATED], (topics.JOINT_STATES, topics.CLOCK)),
    PlannerNode: (
        [SIMULATED],
        (topics.JOINT_STATES, topics.GOAL_POSE, topics.OBSTACLES, topics.SAFETY_STATE),
    ),
    ViewerNode: (["port:=0"], HEARD_BY_VIEWER),
    AdapterNode: (["kind:=effort"], (topics.JOINT_STATES, topics.ADAPTER_COMMANDS, topics.SETTINGS)),
    RecorderNode: ([], (topics.JOINT_STATES, topics.REFERENCE_POSTURE, topics.OBSTACLES)),
}
"""Parameters of each node, and the topics that are attacked."""


def late_and_early(message):
    """The same message with stamps at the ends of what its type can hold."""
    message = copy.deepcopy(message)
    if hasattr(message, "header"):
        for sec, nanosec in ((2**31 - 1, 0), (2**31 - 1, 999_999_999), (2**31 - 1, 2**32 - 1), (-(2**31), 0)):
            message.header.stamp = Time(sec=sec, nanosec=nanosec)
            yield serialize_message(message)


class Bench(Beside):
    """A node whose loop and services run when the test lets them, and an attacker beside it."""

    def __init__(self, node_class):
        super().__init__(node_class())
        self.faults = []
        self.node.boundary._on_fault = lambda _, error: self.faults.append(error)
        self._publishers = {}
        self._clients = {}
        self.node.trigger_configure()
        self.node.trigger_activate()
        assert self.node.running

    def send(self, topic, data):
        """Publish, and let the node take what has come."""
        if topic.name not in self._publishers:
            publisher = self._publishers[topic.name] = self.publish(topic)
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
        self.executor.spin_once(0.001)

    def call(self, kind, service, request):
        """The answer of one of the node's services."""
        if service not in self._clients:
            self._clients[service] = self.other.create_client(kind, f"{self.node.get_name()}/{service}")
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


@pytest.fixture(params=NODES, ids=lambda node_class: node_class.NAME)
def bench(request, tmp_path, monkeypatch):
    """Each node, with something to lose."""
    node_class = request.param
    monkeypatch.setattr(planner_module, "RecedingHorizonPlanner", StandingStill)
    # Nobody promises anything here.
    monkeypatch.setattr(Lockstep, "may_handle", lambda *_: True)
    parameters, attacked = NODES[node_class]
    with ros(*parameters, *[f"bag:={tmp_path / 'bag'}"] * (node_class is RecorderNode)):
        made = Bench(node_class)
        if node_class is ViewerNode:
            # Without a browser the page draws nothing.
            monkeypatch.setattr(made.node._server, "get_clients", lambda: {0: None})
        for heard in (topics.JOINT_STATES, topics.GOAL_POSE):
            if heard in attacked:
                made.send(heard, recorded()[heard.name])
        yield made
        made.node.deactivate()
        made.node.destroy_node()


def test_absurd_messages_are_refused(bench):
    node, commands = bench.node, []
    if isinstance(node, ControllerNode):
        node._write_commands = commands.append
        node.look_around()
    for topic in NODES[type(node)][1]:
        before, valid = sum(node.refused.values()), recorded()[topic.name]
        bench.attack(hostile(valid), functools.partial(bench.send, topic), [NO_MESSAGE, *late_and_early(valid)])
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
