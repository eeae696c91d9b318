"""The planner node makes no plan while it does not know where the obstacles are."""

import time

import pytest
import rclpy
from arm_simulation import ARM, HOME, REST, TICK_NS
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message
from stack_helpers import SMALL_PLANNER, environment, module, parameter_file, ros, running, wait_for
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose
from contact_reach_ros.messages.obstacle_markers import obstacle_markers
from contact_reach_ros.messages.serialized import JointStateWriter
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.ros.qos import qos_profile
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.world.spheres import rest_positions

BALL = load_scene("ball")
WRITER = JointStateWriter(ARM.joint_names, ARM.base_frame, ["position", "velocity"])


def goal() -> PoseStamped:
    return to_goal_pose(BALL.target.tolist(), ARM.base_frame, Time())


def ball(stamp_ns: int) -> bytes:
    return serialize_message(obstacle_markers(BALL, rest_positions(BALL), stamp_ns))


@pytest.fixture
def planner():
    """A node that compiles nothing and notes what it would solve; it knows the arm since tick 1000."""
    with ros():
        node = PlannerNode()
        node.asked = []
        node._solve = node.asked.append
        node.show = lambda tick: node._on_state(WRITER.write(tick * TICK_NS, HOME, REST))
        node.show(1000)
        yield node


def test_a_driver_publishes_a_scene_with_nothing_but_a_floor_again_and_again(monkeypatch):
    with ros("--ros-args", "-p", "scene:=free"):
        driver = DriverNode()
        driver._prepare_messages()
        shown = []
        monkeypatch.setattr(driver._obstacles, "publish", shown.append)
        for _ in range(100):
            driver._publish(driver._read())
            driver._tick(0)
        markers = [deserialize_message(data, MarkerArray).markers for data in shown]
        assert [[marker.text for marker in each] for each in markers] == 5 * [["floor"]]


def test_before_the_first_message_goals_are_refused_and_counted(planner):
    assert planner.diagnosis()[0] == topics.WAITING_FOR_OBSTACLES
    planner.inbox.give(topics.GOAL_POSE, serialize_message(goal()))
    assert planner.refused == {"goals": 1} and planner._planner.goal is None
    (refusal,) = planner.boundary.last_refusals()
    assert "obstacles: none received yet; expected a message, empty where" in refusal
    planner._on_obstacles(serialize_message(MarkerArray()))
    planner.inbox.give(topics.GOAL_POSE, serialize_message(goal()))
    planner.show(1001)
    assert len(planner.asked) == 1


def test_a_message_counts_from_the_stamps_of_its_markers(planner):
    for number, (stamp, refused) in enumerate([(499, 1), (500, 1), (0, 1)]):
        planner._on_obstacles(ball(stamp * TICK_NS))
        planner.inbox.give(topics.GOAL_POSE, serialize_message(goal()))
        assert planner.refused == {"goals": refused}, number
    (refusal,) = planner.boundary.last_refusals()
    assert "0.501 s ago; expected max_obstacle_age, 0.5 s" in refusal


def test_an_empty_message_counts_from_its_arrival_and_goes_stale_too(planner):
    planner._on_obstacles(serialize_message(MarkerArray()))
    planner.inbox.give(topics.GOAL_POSE, serialize_message(goal()))
    planner.show(1500)
    assert len(planner.asked) == 1 and not planner.refused
    for tick in range(1501, 1600):
        planner.show(tick)
    assert len(planner.asked) == 1
    assert planner.refused == {"plans": 3}
    summary, values = planner.diagnosis()
    assert summary.startswith("obstacles: last seen 0.599 s ago") and values["obstacle age s"] == pytest.approx(0.599)


SEEN = "seen_obstacles"
"""What the driver publishes in place of `obstacles`."""


class Listener:
    """Counts plans, keeps what the planner reports of itself, and passes the obstacles on while `relays`."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("listener")
        self.plans, self.summary, self.values = 0, "", {}
        plan, diagnostics = topics.REFERENCE_POSE, topics.DIAGNOSTICS
        self.node.create_subscription(plan.type, plan.name, self._on_plan, qos_profile(plan.qos))
        self.node.create_subscription(DiagnosticArray, diagnostics.name, self._on_diagnostics, 10)
        self.goals = self.node.create_publisher(PoseStamped, topics.GOAL_POSE.name, qos_profile(topics.GOAL_POSE.qos))
        self.relays = True
        obstacles = topics.OBSTACLES
        self._relay = self.node.create_publisher(obstacles.type, obstacles.name, qos_profile(obstacles.qos))
        self.node.create_subscription(obstacles.type, SEEN, self._on_obstacles, qos_profile(obstacles.qos))
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def _on_plan(self, _) -> None:
        self.plans += 1

    def _on_obstacles(self, message: MarkerArray) -> None:
        if self.relays:
            self._relay.publish(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "planner":
                self.summary, self.values = status.message, {entry.key: entry.value for entry in status.values}

    def spin(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            self._executor.spin_once(left)

    def until(self, condition, timeout: float, what: str) -> None:
        wait_for(lambda: self.spin(0.1) or condition(), timeout, what)


@pytest.mark.slow
def test_obstacles_that_stop_coming_end_the_plans_and_new_ones_resume_them(tmp_path):
    """Driver and planner as processes; messages of obstacles get lost between them."""
    env, logs = environment(), {name: tmp_path / f"{name}.log" for name in ("driver", "planner")}
    parameters = parameter_file(tmp_path / "small.yaml", planner=SMALL_PLANNER)

    def start(name: str, *arguments: str):
        command = [*module(f"nodes.{name}"), "--ros-args", "--params-file", str(parameters), *arguments]
        return running(command, env, logs[name])

    with ros(domain=env["ROS_DOMAIN_ID"]):
        listener = Listener()
        with start("planner"), start("driver", "-r", f"obstacles:={SEEN}"):
            listener.until(lambda: listener.summary == topics.WAITING_FOR_CONTROLLER, 180, "planner ready")
            listener.until(listener.goals.get_subscription_count, 20, "goals heard")
            listener.goals.publish(goal())
            listener.until(lambda: listener.plans > 3, 20, "plans")
            listener.relays = False
            listener.until(lambda: listener.summary.startswith("obstacles: last seen"), 20, "they are stale")
            before = listener.plans
            listener.goals.publish(goal())
            listener.until(lambda: int(listener.values.get("refused goals", 0)) == 1, 20, "the goal is refused")
            assert listener.plans == before
            assert int(listener.values["refused plans"]) > 10
            # Many refusals, few lines.
            logged = [line for line in logs["planner"].read_text().splitlines() if "last seen" in line]
            assert 2 <= len(logged) < int(listener.values["refused plans"]) / 5
            listener.relays = True
            listener.until(lambda: listener.plans > before + 3, 20, "plans again")
