"""What has to be refused does not end a node: it is counted, or answered with the reason, and the node goes on."""

import pytest
import rclpy
from rclpy.parameter import Parameter
from stack_helpers import environment, module, ros, running
from std_srvs.srv import Trigger

from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode


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
