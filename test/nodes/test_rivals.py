"""Nobody else may command the arm, or publish what it is commanded by."""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import rclpy
from arm_simulation import ARM, HOME, REST
from builtin_interfaces.msg import Time
from rclpy.serialization import serialize_message
from stack_helpers import UNWATCHED, AtRest, Beside, hand_in, ros
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import InputError, StopCode
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose
from contact_reach_ros.messages.serialized import joint_state_writer
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.ros.graph import rivalry
from contact_reach_ros.ros.interfaces import ALONE
from contact_reach_ros.world.spheres import Spheres

WRITER = joint_state_writer(ARM.joint_names, ARM.base_frame, ["position", "velocity"])


@contextmanager
def beside(node_class):
    with ros():
        yield Beside(node_class())


@contextmanager
def moving(*parameters, rules=()):
    """A controller that answers joint states with commands."""
    with ros(UNWATCHED, *parameters, more=rules):
        it = Beside(ControllerNode())
        it.supervisor = it.node._controller.supervisor
        it.give = AtRest(it.node).give
        it.until(lambda: it.node._intake.outputs > 3, "commands", it.give)
        assert not it.supervisor.stop_reason
        yield it


@pytest.mark.parametrize("topic", ALONE, ids=lambda topic: topic.name)
def test_the_controller_stops_for_a_second_publisher_and_says_who(topic):
    with moving() as it:
        # The controller itself is the one that may publish commands.
        alone = None if topic is topics.COMMANDS else it.publish(topic)
        rival = it.publish(topic)
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.startswith(f"2 publishers on /{topic.name} (")
        assert "/intruder" in it.supervisor.stop_reason
        with pytest.raises(InputError, match="end the others first"):
            it.node._answer_reset()
        it.other.destroy_publisher(rival)
        it.until(lambda: not it.node._controller.not_yet, "the rival is gone")
        with pytest.raises(InputError, match="reset needs one of the last 75 ms"):
            it.node._answer_reset()
        it.give()
        it.node._answer_reset()
        assert not it.supervisor.stop_reason
        del alone


@pytest.mark.parametrize("name", ["intruder", "controller"])
def test_the_controller_stops_for_a_stranger_or_a_second_node_of_a_name_in_safety_state(name):
    with moving() as it:
        others = [rclpy.create_node(other) for other in ("driver", "observer")]
        published = [it.publish(topics.SAFETY_STATE, other) for other in others]
        it.until(lambda: it.node.count_publishers(topics.SAFETY_STATE.name) == 3, "all are found")
        it.node.look_around()
        assert not it.node._controller.not_yet
        rival = it.other if name == "intruder" else rclpy.create_node(name)
        published.append(it.publish(topics.SAFETY_STATE, rival))
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.code is StopCode.RIVAL
        names = ", ".join(sorted(["/driver", "/observer", "/controller", f"/{name}"]))
        assert it.supervisor.stop_reason.startswith(f"4 publishers on /safety_state ({names}), expected one each of")


@pytest.mark.parametrize(("known", "unknown", "is_wrong"), [(1, 3, False), (1, 4, True), (4, 1, True)])
def test_endpoints_that_are_discovered_before_their_nodes_may_be_those_that_are_missing(known, unknown, is_wrong):
    names = ["driver", "controller", "observer", "adapter"][:known] + unknown * ["_NODE_NAME_UNKNOWN_"]
    infos = [SimpleNamespace(node_namespace="/", node_name=name) for name in names]
    node = SimpleNamespace(resolve_topic_name=str, get_publishers_info_by_topic=lambda _: infos)
    assert bool(rivalry(node, [topics.SAFETY_STATE])) is is_wrong


@pytest.mark.parametrize(
    ("rule", "resolved"),
    [("__ns:=/left", "/left/joint_states"), ("joint_states:=/arm/it", "/arm/it")],
    ids=["namespace", "remapped"],
)
def test_topics_are_looked_at_by_the_names_that_they_have_here(rule, resolved):
    with moving(rules=("-r", rule)) as it:
        stranger = rclpy.create_node("stranger")
        rivals = [it.publish(topics.JOINT_STATES, stranger) for _ in range(2)]
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.startswith(f"2 publishers on {resolved} (")
        del rivals


def test_in_the_shadow_of_another_controller_nothing_is_commanded():
    with moving("supervision.shadow:=true") as it:
        rival = it.publish(topics.COMMANDS)
        it.until(lambda: it.node.count_publishers(topics.COMMANDS.name), "the other one is found")
        it.node.look_around()
        assert it.node.count_publishers(topics.COMMANDS.name) == it.node.count_publishers("shadow/commands") == 1
        assert not it.node.rivals and not it.supervisor.stop_reason
        del rival


TWO_STATES = "2 publishers on /joint_states (/intruder, /intruder), expected the"


def test_the_observer_stops_for_a_second_publisher_of_joint_states_and_is_not_reset_beside_it():
    with beside(ObserverNode) as it:
        observer, publishers = it.node, [it.publish(topics.JOINT_STATES) for _ in range(2)]
        observer.trigger_configure()
        it.until(lambda: observer.rivals, "both are found")
        # Not active, it watches nothing.
        assert observer.diagnosis()[0].startswith(TWO_STATES) and not observer._observer.monitor.stop_reason
        observer.trigger_activate()
        observer.look_around()
        observer.inbox.run_tasks()
        assert observer._observer.monitor.stop_reason.code is StopCode.RIVAL
        with pytest.raises(InputError, match="end the others first"):
            observer._answer_reset()
        it.other.destroy_publisher(publishers.pop())
        it.until(lambda: not observer.rivals, "the rival is gone")
        with pytest.raises(InputError, match="no joint state with a torque yet"):
            observer._answer_reset()
        AtRest(observer).give(10, RobotModel(ARM).gravity_at(HOME))
        observer._answer_reset()
        assert not observer._observer.monitor.stop_reason


def test_the_planner_withdraws_its_goal_and_takes_none_beside_a_second_publisher():
    with beside(PlannerNode) as it:
        planner, goal = it.node, to_goal_pose([0.5, 0.1, 0.4], ARM.base_frame, Time())
        planner._planner.see(Spheres.none())
        planner._on_state(WRITER.write(HOME, REST, stamp_ns=0))
        publishers = [it.publish(topics.JOINT_STATES)]
        planner._on_goal(goal)
        it.until(lambda: planner.count_publishers(topics.JOINT_STATES.name), "the first one is found")
        planner.look_around()
        planner.inbox.run_tasks()
        assert planner._planner.goal is not None
        publishers.append(it.publish(topics.JOINT_STATES))
        it.until(lambda: planner.rivals and planner._planner.goal is None, "the goal is withdrawn")
        assert planner.diagnosis()[0].startswith(TWO_STATES)
        hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal))
        assert planner._planner.goal is None and planner.refused == {"goals": 1}
        assert planner.boundary.last_refusals()[-1].endswith("no goal is taken; end the others")
        it.other.destroy_publisher(publishers.pop())
        it.until(lambda: not planner.rivals, "the rival is gone")
        planner._on_goal(goal)
        assert planner._planner.goal is not None


def test_the_driver_takes_no_command_from_two_and_says_who_they_are():
    with beside(DriverNode) as it:
        driver, publishers = it.node, [it.publish(topics.COMMANDS) for _ in range(2)]
        # As after the hand-over.
        drive = driver.robot
        drive.is_open = True
        it.until(lambda: drive.stop_reason, "the stop")
        assert drive.stop_reason.startswith("2 publishers on /effort_controller/commands (/intruder, /intruder)")
        command = serialize_message(Float64MultiArray(data=[1.0] * 7))
        hand_in(driver.inbox, topics.COMMANDS, command)
        assert driver.refused == {"commands": 1} and drive._command is None
        it.other.destroy_publisher(publishers.pop())
        it.until(lambda: not driver.rivals, "the rival is gone")
        hand_in(driver.inbox, topics.COMMANDS, command)
        assert driver.refused == {"commands": 1}
