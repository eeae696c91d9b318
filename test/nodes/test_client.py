"""What a client makes of messages, without any other node; commands with a stack run in test_lockstep_stack.py."""

import itertools
import time
from unittest.mock import Mock

import numpy as np
import pytest
import rclpy
from arm_simulation import ARM
from contact_reach_command import contact_reach
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from stack_helpers import hand_in, ros

from contact_reach_ros.bringup import commands, stack_processes
from contact_reach_ros.bringup.settings import BringupOptions
from contact_reach_ros.bringup.stack_processes import StackProcesses
from contact_reach_ros.errors import ContactReachError, requested
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_status, to_stop_state, to_time
from contact_reach_ros.messages.goal_state import to_goal_state
from contact_reach_ros.messages.safety_state import STOPS_CALLED
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.ros import client as client_module
from contact_reach_ros.ros.client import Outcome, StackClient
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.timing import NANOSECONDS


@pytest.fixture
def client():
    with ros():
        node = Node("operator")
        client = StackClient(node)
        yield client
        client.close()
        node.destroy_node()


def hear(client, topic, message):
    hand_in(client.inbox, topic, serialize_message(message))


def diagnostics(name, summary="", **values):
    return DiagnosticArray(status=[to_status(name, summary, {key.replace("_", " "): values[key] for key in values})])


def test_what_is_missing_is_named_by_topic_until_it_is_heard(client):
    waiting = "reference/pose, as the planner is waiting for the first joint"
    steps = [
        (topics.DIAGNOSTICS, diagnostics("planner", topics.WAITING_FOR_STATE), "diagnostics of the planner"),
        (topics.SETTINGS, to_status("planner", "", {}), "settings of the planner"),
        (topics.DIAGNOSTICS, diagnostics("controller"), "diagnostics of the controller"),
        (topics.DIAGNOSTICS, diagnostics("planner"), waiting),
    ]
    for topic, message, missing in steps:
        assert missing in ", ".join(client.missing())
        hear(client, topic, message)
        assert missing not in ", ".join(client.missing())
    with pytest.raises(ContactReachError, match=r"in ROS domain \d+, namespace /: goal_pose by the planner; start"):
        client.wait_for(client.missing, 0.1)


@pytest.mark.parametrize("node", ["controller", "adapter"])
def test_no_goal_is_sent_while_nothing_is_commanded(node, client, monkeypatch):
    monkeypatch.setattr(client_module, "_CHECKED_S", 0.1)
    monkeypatch.setattr(client, "hear_stops", lambda: None)
    hear(client, topics.DIAGNOSTICS, diagnostics(node, "the arm has a stiffness"))
    outcome = client.go(np.zeros(3), None)
    assert not outcome.done and outcome.text == f"not sent, nothing is commanded: {node}: the arm has a stiffness"


def test_goals_go_where_the_planner_takes_them_from_once_it_is_ready(client, monkeypatch):
    assert not client.reaches_planner()
    planner, heard = rclpy.create_node("planner", cli_args=["--ros-args", "-r", "goal_pose:=reach_goal"]), []
    planner.create_subscription(PoseStamped, "goal_pose", heard.append, 10)
    assert client.until(client.reaches_planner, 30.0)

    def is_heard():
        client.send_goal(np.zeros(3))
        rclpy.spin_once(planner, timeout_sec=0.05)
        return bool(heard)

    assert client.until(is_heard, 30.0)
    # Without settings it compiles, which takes longer than to hear nodes that are up.
    monkeypatch.setattr(client_module, "_FOUND_S", 0.2)
    patience = []
    monkeypatch.setattr(client, "wait_for", lambda missing, timeout: patience.append(timeout))
    client.wait_until_ready()
    hear(client, topics.SETTINGS, to_status("planner", "", {}))
    client.wait_until_ready()
    assert patience == [client_module._COMPILED_S, client_module._FOUND_S]


def test_stops_are_those_in_force_by_node(client):
    for node, reason in (("controller", "too fast"), ("driver", "silence"), ("controller", "")):
        hear(client, topics.SAFETY_STATE, to_stop_state(node, ARM, reason, "holding", {}))
    assert client.stops == {"driver": "silence"} and client.safety["controller"] == "holding"
    assert client.why_stopped == "driver: silence"


def test_whoever_takes_commands_is_waited_for(client, monkeypatch):
    """On a busy machine a driver was discovered seconds after the controller, and its stop was not heard."""
    passed, spin, safety = [], client.spin, topics.SAFETY_STATE

    def report(node, name, reason):
        publisher = node.create_publisher(safety.type, safety.name, qos_profile(safety.qos))
        publisher.publish(to_stop_state(name, ARM, reason, "", {}))

    def later(seconds):
        spin(seconds)
        if client.safety.keys() >= {"controller", "observer"}:
            before, after = sum(passed), sum([*passed, seconds])
            passed.append(seconds)
            if before <= 1.5 * client_module._SETTLED_S < after:
                driver = rclpy.create_node("driver")
                report(driver, "driver", "silence")
                driver.create_subscription(topics.COMMANDS.type, topics.COMMANDS.name, print, 1)

    monkeypatch.setattr(client, "spin", later)
    controller = rclpy.create_node("controller")
    controller.create_publisher(topics.COMMANDS.type, topics.COMMANDS.name, 1)
    for name in ("controller", "observer"):
        report(controller, name, "")
    client.hear_stops()
    assert client.stops == {"driver": "silence"}


@pytest.mark.parametrize(
    ("name", "why", "stays"),
    [
        ("controller", "too fast", True),
        ("observer", "too much torque", True),
        ("adapter", requested("stop service called"), True),
        ("driver", "no command for 101 ms", False),
    ],
)
def test_a_stop_that_comes_while_another_is_being_released_stays(name, why, stays, client, monkeypatch):
    """But a drive closes its brakes after the stop of the controller."""
    other, asked = "observer" if name == "controller" else "controller", []

    def tell(node, reason):
        client.inbox.sent_ns = time.time_ns()
        client._on_safety(to_stop_state(node, ARM, reason, "", {}))

    def release(names):
        asked.append(set(names))
        for each in list(client.stops):
            tell(each, "")
        return Outcome(True, "released")

    tell(name, "")
    tell(other, "an old one")
    monkeypatch.setattr(client, "hear_stops", lambda: None if asked else tell(name, why))
    monkeypatch.setattr(client, "release", release)
    outcome = client.release_all()
    assert outcome.done != stays and bool(asked) != stays
    if stays:
        assert outcome.text.startswith("not reset, stopped meanwhile: ") and why in outcome.text


def test_a_stop_that_is_called_again_while_the_first_is_being_released_stays(client, monkeypatch):
    def tell(calls):
        client.inbox.sent_ns = time.time_ns()
        client._on_safety(to_stop_state("controller", ARM, "stop service called", "", {STOPS_CALLED: str(calls)}))

    monkeypatch.setattr(client, "release", None)
    tell(1)
    monkeypatch.setattr(client, "hear_stops", lambda: tell(2))
    assert client.release_all().text.startswith("not reset, stopped meanwhile: ")


@pytest.mark.parametrize("timeout", ["0", "-1", "nan", "inf", "soon"])
def test_with_a_timeout_that_is_none_nothing_is_sent(timeout, monkeypatch, capsys):
    monkeypatch.setattr(client_module, "connect", None)
    for command in (["home"], ["goto", "0.5", "0.1", "0.3"]):
        assert contact_reach(*command, "--wait", f"--timeout={timeout}") == 2
        assert "argument --timeout: " in capsys.readouterr().err


def test_ctrl_c_while_a_goal_is_pursued_says_that_the_arm_goes_on(client, monkeypatch, capsys):
    monkeypatch.setattr(client, "go", lambda *_: Outcome(True, "taken"))
    monkeypatch.setattr(client, "watch", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        commands._go(client, np.zeros(3), None, True, 30.0)
    assert "the arm goes on to the goal; to stop it: contact-reach stop" in capsys.readouterr().out


def test_a_stop_of_which_the_history_is_heard_is_released(client, monkeypatch):
    """Its states, one before the stop and the stop, are from before."""
    for reason in ("", "an old one"):
        client.inbox.sent_ns = time.time_ns()
        client._on_safety(to_stop_state("controller", ARM, reason, "", {}))
    monkeypatch.setattr(client, "hear_stops", lambda: None)
    monkeypatch.setattr(client, "release", lambda names: client.stops.clear() or Outcome(True, "released"))
    assert client.release_all() == Outcome(True, "released")


def test_states_of_other_goals_do_not_count(client):
    client.send_goal(np.zeros(3))
    for ahead_ns in (-1, 1):
        hear(client, topics.GOAL_STATE, to_goal_state(RUNNING, client._goal_ns + ahead_ns, "planner", ARM))
        assert client.goal_state is None


RUNNING = GoalState(GoalPhase.RUNNING)
REFUSALS = {"last_refusal_of_plans": "out of the box", "last_refusal_of_references": "other gains"}


@pytest.mark.parametrize(
    ("state", "accepted", "refusals", "stop", "text"),
    [
        (RUNNING, 8, REFUSALS, "", "the goal is taken"),
        (RUNNING, 7, {}, "", "accepts no plan for the goal: run contact-reach doctor"),
        (RUNNING, 7, REFUSALS, "", "accepts no plan for the goal: out of the box; other gains"),
        (GoalState(GoalPhase.REFUSED, "too far"), 7, {}, "", "did not take the goal: refused: too far"),
        (GoalState(GoalPhase.WITHDRAWN, "a rival"), 8, {}, "", "did not take the goal: withdrawn: a rival"),
        # These are plans for another goal.
        (None, 8, {}, "", "nothing heard of the goal"),
        (RUNNING, 8, {}, "too fast", "stopped: controller: too fast"),
    ],
)
def test_a_goal_is_taken_when_the_planner_pursues_it_and_the_controller_accepts_plans(
    client, monkeypatch, state, accepted, refusals, stop, text
):
    monkeypatch.setattr(client_module, "_FOLLOWED_S", 0.1)
    monkeypatch.setattr(client_module, "_FOUND_S", 0.1)
    hear(client, topics.DIAGNOSTICS, diagnostics("controller", plans_accepted=7))

    def spin(_):
        """What is heard before the goal, and what after it."""
        is_sent = client._goal_ns > 0
        reason = stop if is_sent else ""
        hear(client, topics.SAFETY_STATE, to_stop_state("controller", ARM, reason, "holding", {}))
        if is_sent:
            hear(client, topics.DIAGNOSTICS, diagnostics("controller", plans_accepted=accepted, **refusals))
        if is_sent and state is not None:
            hear(client, topics.GOAL_STATE, to_goal_state(state, client._goal_ns, "planner", ARM))

    monkeypatch.setattr(client, "spin", spin)
    monkeypatch.setattr(client.node, "count_publishers", lambda _: 1)
    outcome = client.go(np.zeros(3), None)
    assert text in outcome.text and outcome.done == text.startswith("the goal is taken")


@pytest.mark.parametrize(
    ("advance", "waits"),
    [
        pytest.param(None, False, id="real time"),
        pytest.param(0.0, False, id="simulated time that stands still"),
        pytest.param(0.1, True, id="slow simulated time"),
        pytest.param(10.0, False, id="simulated time of a planner that is silent"),
    ],
)
def test_a_slow_simulation_is_no_silence(client, monkeypatch, advance, waits):
    monkeypatch.setattr(client_module, "_SILENCE_S", 0.1)
    client.send_goal(np.zeros(3))
    spins = itertools.count(1)

    def spin(_):
        """Of the goal is heard after half a second."""
        time.sleep(0.02)
        turn = next(spins)
        if advance is not None:
            now_ns = round((5.0 + 0.02 * advance * turn) * NANOSECONDS)
            hear(client, topics.CLOCK, Clock(clock=to_time(now_ns)))
        if turn == 25:
            hear(
                client,
                topics.GOAL_STATE,
                to_goal_state(GoalState(GoalPhase.SETTLED), client._goal_ns, "planner", ARM),
            )

    monkeypatch.setattr(client, "spin", spin)
    client.spin(0.0)
    outcome = client.watch(60.0)
    assert outcome.done == waits and outcome.text.startswith("settled" if waits else "nothing heard of the goal for")


@pytest.mark.usefixtures("signal_handlers")
def test_a_simulated_arm_waits_for_its_brakes_and_the_recorder(client, monkeypatch):
    monkeypatch.setattr(stack_processes, "_READY_S", 0.1)
    monkeypatch.setattr(client, "missing", list)
    stack = StackProcesses(client, BringupOptions(bag="somewhere"))
    for actuation, reason, missing in (
        ("braked", "", ": open brakes of the driver, goal_pose by the recorder, joint_states by the recorder;"),
        ("commanded", "", ": goal_pose by the recorder, joint_states by the recorder;"),
        ("braked", "silence", "stopped by driver: silence"),
    ):
        hear(client, topics.SAFETY_STATE, to_stop_state("driver", ARM, reason, actuation, {}))
        with pytest.raises(ContactReachError, match=missing):
            stack.wait_to_start(client)
    hear(client, topics.SAFETY_STATE, to_stop_state("driver", ARM, "", "commanded", {}))
    StackProcesses(client, BringupOptions()).wait_to_start(client)
