"""The planner node: what it knows of obstacles, contact, frames and its controller, and when it does not plan."""

import types

import numpy as np
import pytest
import rclpy
from arm_simulation import ARM, HOME, REST, TICK_NS, rotation_about
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from plans import make_plan
from rclpy.serialization import deserialize_message, serialize_message
from stack_helpers import Published, hand_in, ros, wait_for
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import (
    to_goal_pose,
    to_marker,
    to_point,
    to_quaternion,
    to_status,
    to_time,
)
from contact_reach_ros.messages.obstacle_markers import obstacle_markers
from contact_reach_ros.messages.safety_state import ERROR, OK, WARN
from contact_reach_ros.messages.serialized import joint_state_writer
from contact_reach_ros.messages.values import quaternion, vector
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.planning.goal_progress import GoalPhase
from contact_reach_ros.ros import frames
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.world.obstacle import BallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import rest_positions

BALL, WALL = load_scene("ball"), load_scene("wall")
GOAL = np.array([0.5, 0.1, 0.4])
PLAN = make_plan(
    np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 7)), predicted_positions=np.arange(12.0).reshape(4, 3)
)
FLANGE, _ = RobotModel(ARM).tip_pose(HOME)
WRITER = joint_state_writer(ARM.joint_names, ARM.base_frame, ["position", "velocity"])


@pytest.fixture
def planner():
    """A node that compiles nothing and notes what it would solve; it has seen the arm at tick 1000."""
    with ros():
        node = PlannerNode()
        node.asked = []
        node._make_plan = node.asked.append
        node.show = lambda tick: node._on_state(WRITER.write(HOME, REST, stamp_ns=tick * TICK_NS))
        node.show(1000)
        yield node


def send(planner, topic, message):
    hand_in(planner.inbox, topic, serialize_message(message))


def send_goal(planner):
    send(planner, topics.GOAL_POSE, to_goal_pose(GOAL, ARM.base_frame, to_time(0)))


def ball(tick):
    return obstacle_markers(BALL, rest_positions(BALL), tick * TICK_NS)


def test_before_the_first_message_of_obstacles_goals_are_refused_and_counted(planner):
    assert planner.diagnosis()[0] == topics.WAITING_FOR_OBSTACLES
    send_goal(planner)
    assert planner.refused == {"goals": 1} and planner._planner.goal is None
    assert "obstacles: none received yet; expected a message" in planner.boundary.last_refusals()[0]
    send(planner, topics.OBSTACLES, MarkerArray())
    send_goal(planner)
    planner.show(1001)
    assert len(planner.asked) == 1


def test_obstacles_count_from_their_stamps_or_else_from_their_arrival(planner):
    for tick in (499, 500, 0):
        send(planner, topics.OBSTACLES, ball(tick))
        send_goal(planner)
        assert planner.refused == {"goals": 1}, tick
    assert "0.501 s ago; expected max_obstacle_age, 0.5 s" in planner.boundary.last_refusals()[0]


def test_obstacles_that_go_stale_end_the_plans_and_new_ones_resume_them_for_the_same_goal(planner):
    send(planner, topics.OBSTACLES, MarkerArray())
    send_goal(planner)
    for tick in (1500, *range(1501, 1600)):
        planner.show(tick)
    assert len(planner.asked) == 1 and planner.refused == {"plans": 3}
    summary, values = planner.diagnosis()
    assert summary.startswith("obstacles: last seen 0.599 s ago") and values["obstacle age s"] == pytest.approx(0.599)
    send(planner, topics.OBSTACLES, ball(1599))
    planner.show(1640)
    assert len(planner.asked) == 2


def test_a_driver_publishes_a_scene_with_nothing_but_a_floor_again_and_again(monkeypatch):
    with ros("scene:=free"):
        driver, shown = DriverNode(), []
        monkeypatch.setattr(driver._obstacles, "publish", shown.append)
        for _ in range(100):
            driver._publish(driver.robot.read(), driver.robot.shows_obstacles())
            driver._tick(0)
    markers = [deserialize_message(data, MarkerArray).markers for data in shown]
    assert [[marker.text for marker in each] for each in markers] == 5 * [["floor"]]


@pytest.fixture
def leading(planner):
    """A planner on the way to a goal that it has just planned for."""
    send(planner, topics.OBSTACLES, MarkerArray())
    send_goal(planner)
    planner.tick = 1000

    def report(**values):
        """The observer reports contact, and the arm moves on; returns what happened to the goal."""
        named = {name.replace("_", " "): value for name, value in values.items()}
        send(planner, topics.SAFETY_STATE, to_status("observer", "contact", named, WARN))
        planner.tick += 40
        planner.show(planner.tick)
        return planner._planner.goal_state

    planner.report = report
    planner.show(1000)
    return planner


TOUCHED = {"contact_link": "lbr_link_7", "contact_position_xyz_m": " ".join(map(str, FLANGE))}
SUDDEN = " ".join(map(str, RobotModel(ARM).jacobian_at(HOME)[:3].T @ [0.0, 12.0, 0.0]))


def test_an_unexpected_contact_that_stays_withdraws_the_goal_and_what_the_controller_follows(leading):
    leading._poses, leading._planner.plan = Published(), PLAN
    pushed = {**TOUCHED, "contact_force_xyz_N": "0 12 0", "sudden_torque_Nm": SUDDEN}
    assert leading.report(**pushed).phase.is_open
    state = leading.report(**pushed)
    assert state.phase is GoalPhase.WITHDRAWN and state.reason.startswith("unexpected contact of 12 N at lbr_link_7")
    (nothing,) = leading._poses.messages
    assert not nothing.points and leading.diagnosis()[0] == topics.WAITING_FOR_CONTROLLER
    asked = len(leading.asked)
    leading.report(level="free")
    assert len(leading.asked) == asked
    send_goal(leading)
    assert leading.report(level="free").phase.is_open and len(leading.asked) == asked + 1


def test_contact_with_an_obstacle_that_was_seen_withdraws_nothing_up_to_the_permitted_force(leading):
    settings = BallSettings()
    beside = FLANGE - [0.0, ARM.capsules[-1].radius + settings.radius, 0.0]
    seen = Scene("seen", ARM, 0, HOME, GOAL, tuple(settings.at(beside)))
    send(leading, topics.OBSTACLES, obstacle_markers(seen, rest_positions(seen), 1000 * TICK_NS))
    pushed = {**TOUCHED, "contact_force_xyz_N": "0 12 0", "sudden_torque_Nm": SUDDEN}
    for _ in range(3):
        assert leading.report(**pushed).phase.is_open
    state = leading.report(**pushed, contact_above_permitted_force="true")
    assert state.reason == "contact of 12 N at lbr_link_7, more than the permitted force"


@pytest.mark.parametrize("wrong", [{"contact_force_xyz_N": "0 x 0"}, {"sudden_torque_Nm": "1 2"}])
def test_no_contact_and_one_that_is_none_change_nothing(leading, wrong):
    for _ in range(3):
        assert leading.report(level="free").phase.is_open
        assert leading.report(**{**TOUCHED, "contact_force_xyz_N": "0 12 0", **wrong}).phase.is_open
    assert leading.refused == {"safety states": 3}


def test_goals_that_came_before_the_planner_was_active_never_move_the_arm(planner):
    """They wait in the middleware while it compiles."""
    send(planner, topics.OBSTACLES, MarkerArray())
    planner.activate()
    reports = planner._goal_states = Published()
    send_goal(planner)
    send(planner, topics.GOAL_POSE, to_goal_pose(GOAL, "camera", to_time(0)))
    for tick in range(1001, 1100):
        planner.show(tick)
    assert not planner.asked and planner.refused == {"goals": 2}
    reasons = [{entry.key: entry.value for entry in message.values}["reason"] for message in reports.messages]
    assert [reason[:37] for reason in reasons] == 2 * ["goal: there is no joint state yet; ex"]


def test_goals_as_other_programs_send_them_are_taken(planner):
    """The orientation of the message does not count by default."""
    send(planner, topics.OBSTACLES, MarkerArray())
    zero, unset, undefined = Quaternion(w=0.0), Quaternion(), Quaternion(x=np.nan)
    for place, frame, seconds, turn in (
        ((0.5, 0.1, 0.4), "", 0, unset),
        ((0.5, 0.2, 0.4), ARM.base_frame, 2_147_483_000, unset),
        ((0.5, 0.3, 0.4), ARM.base_frame, 0, zero),
        ((0.5, 0.1, 0.5), ARM.base_frame, 0, undefined),
    ):
        goal = to_goal_pose(place, frame, Time(sec=seconds))
        goal.pose.orientation = turn
        send(planner, topics.GOAL_POSE, goal)
        assert planner._planner.goal.position == pytest.approx(place)
    assert not planner.refused


def test_an_old_goal_is_refused_and_the_one_in_force_stays(planner):
    send(planner, topics.OBSTACLES, MarkerArray())
    send_goal(planner)
    planner.show(9000)
    send(planner, topics.OBSTACLES, MarkerArray())
    send_goal(planner)
    in_force = planner._planner.goal
    send(planner, topics.GOAL_POSE, to_goal_pose(GOAL + 0.05, ARM.base_frame, to_time(6999 * TICK_NS)))
    assert "its stamp is 2.001 s older than the last joint state" in planner.boundary.last_refusals()[0]
    assert planner.refused == {"goals": 1} and planner._planner.goal is in_force


def test_a_goal_in_force_ends_with_a_gap_in_the_states_and_the_controller_hears_it(planner):
    send(planner, topics.OBSTACLES, MarkerArray())
    send_goal(planner)
    planner.show(1000)
    planner._poses = Published()
    planner.show(3001)
    send(planner, topics.OBSTACLES, MarkerArray())
    planner.show(3040)
    assert len(planner.asked) == 1 and planner._planner.goal_state.phase is GoalPhase.WITHDRAWN
    (nothing,) = planner._poses.messages
    assert not nothing.points


def test_a_stopped_arm_takes_no_goal(planner):
    """Otherwise a reset would move it."""
    stopped, free = (to_status("controller", text, {}, level) for text, level in (("pushed", ERROR), ("holding", OK)))
    send(planner, topics.OBSTACLES, MarkerArray())
    send_goal(planner)
    assert planner._planner.has_goal
    for _ in range(2):
        send(planner, topics.SAFETY_STATE, stopped)
        assert not planner._planner.has_goal
        planner.show(1000)
        send_goal(planner)
    assert not planner._planner.has_goal and planner.refused == {"goals": 2}
    assert "controller has stopped the arm (pushed); first: contact-reach reset" in planner.boundary.last_refusals()[0]
    send(planner, topics.SAFETY_STATE, free)
    planner.show(1040)
    assert not planner._planner.has_goal and not planner.asked
    send_goal(planner)
    assert planner._planner.has_goal


def other_node(name, heard, published=()):
    node = rclpy.create_node(name)
    for topic in heard:
        node.create_subscription(topic.type, topic.name, lambda _: None, qos_profile(topic.qos))
    for topic in published:
        node.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
    return node


def test_only_a_node_that_commands_the_arm_and_hears_both_halves_of_a_plan_counts_as_its_controller(planner):
    send(planner, topics.OBSTACLES, MarkerArray())
    halves = (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE)

    def found(topic, act, *names):
        infos = getattr(planner, f"get_{act}_info_by_topic")(topic.name)
        return {info.node_name for info in infos} == set(names)

    others = [other_node("recorder", (*halves, topics.COMMANDS)), other_node("half", halves[:1], (topics.COMMANDS,))]
    wait_for(lambda: found(topics.REFERENCE_POSE, "subscriptions", "recorder", "half"), 10, "both hear")
    wait_for(lambda: found(topics.COMMANDS, "publishers", "half"), 10, "one commands")
    summary, values = planner.diagnosis()
    assert (summary, values["heard by"]) == (topics.WAITING_FOR_CONTROLLER, "")
    controller = other_node("some_controller", halves, (topics.COMMANDS,))
    wait_for(lambda: planner.diagnosis()[1]["heard by"] == "/some_controller", 10, "the controller is found")
    assert planner.diagnosis()[0] == "waiting for a goal"
    controller.destroy_node()
    wait_for(lambda: planner.diagnosis()[0] == topics.WAITING_FOR_CONTROLLER, 10, "the controller is gone")
    others.append(other_node("shadow", halves, (topics.SHADOW_COMMANDS,)))
    wait_for(lambda: planner.diagnosis()[1]["heard by"] == "/shadow", 10, "one that only computes counts, too")


def test_a_withdrawn_plan_is_no_longer_shown(planner):
    planner._markers = Published()
    planner._planner.plan = PLAN
    planner._withdraw("a stop")
    (nothing,) = planner._markers.messages
    assert [marker.action for marker in nothing.markers] == [Marker.DELETEALL]


CAMERA, SEEN_NS = "camera", 997 * TICK_NS
TURN, ORIGIN = rotation_about((0.6, 0.0, 0.8), 0.7), np.array([0.4, -0.3, 0.9])
"""Where the camera is in the base frame."""


class TransformError(Exception):
    """As in tf2."""


class Buffer:
    """As in tf2_ros, with one transform, which is known at one time only."""

    def lookup_transform(self, target, source, time):
        if (target, source) != (ARM.base_frame, CAMERA) or time.nanoseconds not in (0, SEEN_NS):
            raise TransformError(f'"{source}" does not exist. ')
        origin = Vector3(x=ORIGIN[0], y=ORIGIN[1], z=ORIGIN[2])
        return TransformStamped(transform=Transform(translation=origin, rotation=to_quaternion(TURN)))


@pytest.fixture
def tf2_ros(monkeypatch):
    """No registry has tf2 as wheels: the part of its interface that is used."""
    names = {"Buffer": Buffer, "TransformListener": lambda *_: None, "TransformException": TransformError}
    monkeypatch.setattr(frames, "tf2_ros", types.SimpleNamespace(**names))


@pytest.fixture
def transforming(tf2_ros, planner):
    """A planner that knows where a camera is; `again` is what it publishes again."""
    send(planner, topics.OBSTACLES, MarkerArray())
    planner.again = []
    planner._frames._goals = planner._frames._obstacles = types.SimpleNamespace(publish=planner.again.append)
    return planner


def seen_goal(frame, stamp_ns):
    return to_goal_pose(TURN.T @ (GOAL - ORIGIN), frame, to_time(stamp_ns), TURN.T)


def test_a_goal_in_another_frame_is_published_again_in_the_base_frame_and_taken_then(transforming):
    send(transforming, topics.GOAL_POSE, seen_goal(CAMERA, SEEN_NS))
    (again,) = transforming.again
    assert transforming._planner.goal is None and not transforming.refused
    assert again.header.frame_id == ARM.base_frame and again.header.stamp == to_time(SEEN_NS)
    assert vector(again.pose.position) == pytest.approx(GOAL, abs=1e-12)
    assert np.abs(quaternion(again.pose.orientation)) == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-12)
    send(transforming, topics.GOAL_POSE, again)
    assert transforming._planner.goal.position == pytest.approx(GOAL)


@pytest.mark.parametrize(("frame", "stamp_ns"), [("elsewhere", SEEN_NS), (CAMERA, 9 * TICK_NS)])
def test_without_a_transform_a_goal_is_refused_with_its_reason(transforming, frame, stamp_ns):
    send(transforming, topics.GOAL_POSE, seen_goal(frame, stamp_ns))
    (refusal,) = transforming.boundary.last_refusals()
    assert f"goal: no transform from '{frame}' to '{ARM.base_frame}': \"{frame}\" does not exist." in refusal
    assert transforming.refused == {"goals": 1} and not transforming.again


def test_without_tf2_other_frames_are_refused(planner, monkeypatch):
    monkeypatch.setattr(frames, "tf2_ros", None)
    markers = ball(997)
    markers.markers[0].header.frame_id = CAMERA
    send(planner, topics.OBSTACLES, MarkerArray())
    send(planner, topics.GOAL_POSE, seen_goal(CAMERA, SEEN_NS))
    send(planner, topics.OBSTACLES, markers)
    assert planner.refused == {"goals": 1, "obstacles": 1}
    assert all("frame 'camera' is unknown; expected 'lbr_link_0'" in line for line in planner.boundary.last_refusals())
    # As in ROS 1.
    send(planner, topics.GOAL_POSE, to_goal_pose(GOAL, "/lbr_link_0", to_time(0)))
    assert "frame '/lbr_link_0' is unknown; expected 'lbr_link_0'" in planner.boundary.last_refusals()[-1]


def test_obstacles_of_any_kind_are_where_they_were_seen(transforming):
    """Walls, as lists of points, and the floor, as a turned box; those already in the base frame stay."""
    expected = obstacle_markers(WALL, rest_positions(WALL), SEEN_NS)
    stays = to_marker("obstacles", 99, 2, 3 * [0.1], (1, 1, 1, 1))
    stays.header.frame_id, stays.header.stamp, stays.pose.position = ARM.base_frame, to_time(SEEN_NS), to_point(GOAL)
    expected.markers.append(stays)
    truth = transforming._obstacle_reader.read(serialize_message(expected))
    for marker in expected.markers[:-1]:
        marker.header.frame_id = CAMERA
        marker.points = [to_point(TURN.T @ (vector(point) - ORIGIN)) for point in marker.points]
        if not marker.points:
            marker.pose.position = to_point(TURN.T @ (vector(marker.pose.position) - ORIGIN))
            marker.pose.orientation = to_quaternion(TURN.T)
    send(transforming, topics.OBSTACLES, expected)
    assert not transforming.refused
    moved = transforming._obstacle_reader.read(serialize_message(transforming.again[0]))
    assert np.abs(moved.center - truth.center).max() < 1e-9 and np.array_equal(moved.edges, truth.edges)
    for body, other in zip(moved.environment, truth.environment, strict=True):
        assert body.point == pytest.approx(other.point) and body.normal == pytest.approx(other.normal)
