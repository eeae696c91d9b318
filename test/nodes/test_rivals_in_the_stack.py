"""The running stack knows its own nodes, also after a restart, and notices another publisher of joint states."""

import re
import time

import pytest
import rclpy
from arm_simulation import ARM
from stack_helpers import SMALL_PLANNER, environment, module, parameter_file, running, wait_for
from std_srvs.srv import Trigger

from contact_reach_ros.messages import topics
from contact_reach_ros.ros.qos import qos_profile


@pytest.mark.slow
def test_a_restart_is_no_rival_and_a_second_publisher_of_joint_states_is_one(tmp_path):
    env, output = environment(), tmp_path / "output.txt"
    parameters = parameter_file(tmp_path / "small.yaml", planner=SMALL_PLANNER)
    command = [*module("bringup.bringup"), "--ros-args", "-p", f"parameters:={parameters}", "-p", "scene:=free"]
    rclpy.init(domain_id=int(env["ROS_DOMAIN_ID"]))
    try:
        node = rclpy.create_node("operator")
        restart = node.create_client(Trigger, "bringup/restart")
        with running(command, env, output):
            wait_for(lambda: "send a goal" in output.read_text(), 240, "the stack is up")
            assert restart.wait_for_service(20)
            restart.call_async(Trigger.Request())
            wait_for(lambda: "all nodes are active again" in output.read_text(), 240, "the stack is up again")
            # Longer than participants take to find each other.
            rclpy.spin_once(node, timeout_sec=4.0)
            assert "publishers on" not in output.read_text()
            states = topics.JOINT_STATES
            rival = node.create_publisher(states.type, states.name, qos_profile(states.qos))
            end = time.monotonic() + 3.0
            while time.monotonic() < end:
                rival.publish(states.type(name=list(ARM.joint_names), position=[float("nan")] * ARM.n))
                time.sleep(0.01)
            text = output.read_text()
            who = r"(/driver, /operator|/driver, a node whose name is not known yet)"
            said = rf"\[observer\]: stop: 2 publishers on /joint_states \({who}\), expected the driver alone"
            assert re.search(said, text)
            # It may have been stopped already, by a busy machine.
            assert re.search(r"\[controller\]: compliant stop: (2 publishers on /joint_states|observer)", text)
    finally:
        rclpy.shutdown()
