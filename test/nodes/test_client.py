"""What a client makes of messages, without any other node; commands with a stack run in test_doctor.py."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from stack_helpers import hand_in, ros

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms.iiwa14 import ARM
from contact_reach_ros.bringup.follower import Follower
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_status, to_stop_state
from contact_reach_ros.messages.goal_state import to_goal_state
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.ros import client as client_module


@pytest.fixture
def client():
    with ros():
        node = Node("demo")
        follower = Follower(node, RobotModel(ARM), np.zeros(3))
        yield follower
        follower.close()
        node.destroy_node()


def hear(client, topic, message):
    hand_in(client.inbox, topic, serialize_message(message))


def diagnostics(name, summary=""):
    return DiagnosticArray(status=[to_status(name, summary, {})])


def test_what_is_missing_is_named_by_topic_until_it_is_heard(client):
    steps = [
        (topics.DIAGNOSTICS, diagnostics("planner", topics.WAITING_FOR_STATE), "diagnostics of the planner"),
        (topics.SETTINGS, to_status("planner", "", {}), "settings of the planner"),
        (topics.DIAGNOSTICS, diagnostics("controller"), "diagnostics of the controller"),
        (topics.DIAGNOSTICS, diagnostics("planner"), "reference/pose, as the planner is waiting for the first joint"),
    ]
    for topic, message, missing in steps:
        assert missing in ", ".join(client.missing())
        hear(client, topic, message)
        assert missing not in ", ".join(client.missing())
    rest, unknown = [0.0] * ARM.n, [float("nan")] * ARM.n
    state = JointState(name=ARM.joint_names, position=ARM.home, velocity=rest, effort=unknown)
    state.header.stamp.sec = 1
    assert "joint_states" in client.missing()
    hear(client, topics.JOINT_STATES, state)
    state.effort = rest
    assert client.missing()[-1] == "effort_controller/commands by the driver, whose brakes are closed"
    hear(client, topics.JOINT_STATES, state)
    assert client.missing() == ["goal_pose by the planner"]


def test_without_a_planner_it_is_named(client, monkeypatch):
    monkeypatch.setattr(client_module, "_FOUND_S", 0.1)
    with pytest.raises(ContactReachError, match="no stack answers in ROS domain"):
        client.find()
    client.node.create_publisher(DiagnosticStatus, topics.SAFETY_STATE.name, 1)
    hear(client, topics.DIAGNOSTICS, diagnostics("controller"))
    with pytest.raises(ContactReachError, match="not heard: diagnostics of the planner, settings of the planner, goal"):
        client.wait_for(client.missing)


def test_stops_are_those_in_force_by_node(client):
    for node, reason in (("controller", "too fast"), ("driver", "silence"), ("controller", "")):
        hear(client, topics.SAFETY_STATE, to_stop_state(node, ARM, reason, "holding", {}))
    assert client.stops == {"driver": "silence"} and client.safety == "holding"
    assert client.state == "STOP by driver: silence"


def test_states_of_other_goals_do_not_count(client):
    client.send_goal(np.zeros(3), stamp_ns=7)
    for stamp_ns in (6, 7, 8):
        state = GoalState(GoalPhase.RUNNING, distance=0.001 * stamp_ns)
        hear(client, topics.GOAL_STATE, to_goal_state(state, stamp_ns, "planner", ARM))
    assert client.goal_state.distance == pytest.approx(0.007)


BEFORE = {"plans accepted": "7"}
RUNNING = GoalState(GoalPhase.RUNNING)


def judge(client, state, now):
    client.goal_state, client.diagnostics["controller"] = state, now
    return client.judge_goal(BEFORE)


def test_a_goal_is_taken_when_the_controller_follows_plans_for_it(client):
    for state in (None, GoalState(GoalPhase.ACCEPTED), RUNNING):
        assert judge(client, state, BEFORE) is None
    later = {"plans accepted": "8"}
    assert judge(client, RUNNING, later).done
    assert judge(client, None, later) is None, "these are plans for another goal"


def test_a_goal_that_planner_or_controller_refuse_comes_with_the_reason(client):
    for phase in (GoalPhase.REFUSED, GoalPhase.WITHDRAWN):
        outcome = judge(client, GoalState(phase, "out of reach"), BEFORE)
        assert not outcome.done and f"{phase.value}: out of reach" in outcome.text
    for what in ("references", "plans"):
        now = {**BEFORE, f"refused {what}": "1", f"last refusal of {what}": "other gains"}
        outcome = judge(client, RUNNING, now)
        assert not outcome.done and "other gains" in outcome.text
