"""What has to be refused does not end a node: it is counted, or answered with the reason, and the node goes on."""

import pytest
import rclpy
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from serialized_helpers import garbage
from stack_helpers import environment, module, ros, running
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.ros.qos import qos_profile

NO_MESSAGES = list(garbage(serialize_message(Float64MultiArray(data=[1.0] * 7))))[::20]
NO_TORQUES = [serialize_message(Float64MultiArray(data=data)) for data in ([1.0] * 6, [float("nan")] * 7)]

_ATTEMPTS = 200
_PATIENCE_NS = 50_000_000


@pytest.mark.parametrize(
    ("node_class", "topic", "refused", "messages"),
    [
        (ControllerNode, topics.JOINT_STATES, "joint states", NO_MESSAGES),
        (ObserverNode, topics.JOINT_STATES, "joint states", NO_MESSAGES),
        (ObserverNode, topics.COMMANDS, "commands", NO_MESSAGES + NO_TORQUES),
        (AdapterNode, topics.JOINT_STATES, "joint states", NO_MESSAGES),
        (AdapterNode, topics.ADAPTER_COMMANDS, "commands", NO_MESSAGES + NO_TORQUES),
        (DriverNode, topics.COMMANDS, "commands", NO_MESSAGES + NO_TORQUES),
    ],
)
def test_nodes_count_what_is_no_message(node_class, topic, refused, messages):
    with ros("--ros-args", "-p", "torque_source:=commanded"):
        node, other = node_class(), rclpy.create_node("other")
        publisher = other.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
        for data in messages:
            before = node.refused.get(refused, 0)
            # The nodes listen best-effort: what is published before they are found is lost.
            for _ in range(_ATTEMPTS):
                publisher.publish(data)
                node.inbox.wait(_PATIENCE_NS)
                if node.refused.get(refused, 0) > before:
                    break
            assert node.refused == {refused: node.refused.get(refused)}
            assert node.refused[refused] > before


def test_a_refused_reset_leaves_the_loop_running(tmp_path):
    """With a loop in a thread of its own, as in a process."""
    env, log = environment(), tmp_path / "controller.log"
    with ros(domain=env["ROS_DOMAIN_ID"]):
        asking = rclpy.create_node("asking")
        client = asking.create_client(Trigger, "controller/reset")
        with running(module("nodes.controller"), env, log) as controller:
            assert client.wait_for_service(60.0), log.read_text()
            for _ in range(3):
                answer = client.call_async(Trigger.Request())
                rclpy.spin_until_future_complete(asking, answer, timeout_sec=30.0)
                assert answer.done() and controller.poll() is None, log.read_text()
                assert not answer.result().success
                assert answer.result().message == "the controller has not seen a joint state yet"


@pytest.mark.parametrize("node_class", [AdapterNode, ControllerNode, DriverNode, ObserverNode])
def test_a_node_keeps_the_tool_that_it_was_started_with(node_class):
    with ros():
        node = node_class()
        before = node.arm
        (result,) = node.set_parameters([Parameter("tool.mass", value=1.0)])
        assert not result.successful and "read-only" in result.reason
        assert node.arm is before and node.get_parameter("tool.mass").value == 0.0
