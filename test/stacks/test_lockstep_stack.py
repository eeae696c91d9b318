"""One recorded stack in lockstep: the doctor, goals and stops, a recorder that stands still, and Ctrl-C."""

import os
import signal
import time

import numpy as np
import pytest
import rclpy
from rclpy.duration import Duration
from sensor_msgs.msg import JointState
from stack_helpers import (
    SMALL_PLANNER,
    command_lines,
    environment,
    module,
    parameter_file,
    processes_of_domain,
    ready,
    ros,
    running,
    speeds_until,
    wait_for,
)
from test_doctor import examine

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.nodes.recorder import AHEAD_NS, RecorderNode
from contact_reach_ros.ros.inbox import qos_profile

REST = 0.1
"""Joint speed that counts as rest, sensor noise included, rad/s."""


class Stack:
    """A running stack: its process, its environment, and the bag that it records."""

    def __init__(self, process, env, bag):
        self.process, self.env, self.bag = process, env, bag

    @property
    def processes(self):
        """Ids by the name of the node."""
        return processes_of_domain(self.env["ROS_DOMAIN_ID"])


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stack")
    env, output, bag = environment(), folder / "bringup.txt", folder / "bag"
    parameters = parameter_file(folder / "small.yaml", planner=SMALL_PLANNER)
    command = [*module("cli"), "up", "--parameters", str(parameters), "--scene", "ball", "--lockstep"]
    with running([*command, "--bag", str(bag)], env, output) as process:
        ready(process, output)
        yield Stack(process, env, bag)


def test_nobody_keeps_others_from_running(stack):
    for name in ("driver", "controller", "observer", "planner"):
        threads = [int(thread) for thread in os.listdir(f"/proc/{stack.processes[name]}/task")]
        assert {os.sched_getscheduler(thread) for thread in threads} == {os.SCHED_OTHER}, name


@pytest.mark.slow
def test_the_doctor_passes_it(stack, tmp_path):
    result, found = examine(stack.env, tmp_path)
    expected = ["nodes", "safety state", "without commands", "discovery", "parameters", "joint names and order"]
    expected += ["gravity against torque", *(topic.name for topic in topics.ALL)]
    assert {name: found[name] for name in expected if found[name]["verdict"] != "pass"} == {}
    publisher, _, subscribers = found["effort_controller/commands"]["found"].partition(" → ")
    assert publisher == "controller" and sorted(subscribers.split(", ")) == ["driver", "recorder"]
    assert "controller: holding" in found["safety state"]["found"]
    assert all(name in result.stdout for name in expected)


def test_goals_stops_and_resets(stack):
    turned, settled, refused, faster, late, stopped, kept, released, again = command_lines(
        stack.env,
        "goto 0.51 0.025 0.145 --rpy 0 3.14 0",
        "goto 0.51 0.025 0.145 --wait",
        "goto 2.0 0.0 0.3",
        "speed 2",
        "home --wait --timeout 0.1",
        "stop",
        "goto 0.5 0.1 0.3",
        "reset",
        "reset",
    )
    assert refused[0] == 1 and "refused: goal: position" in refused[1]
    assert turned[0] == 2 and "goal_orientation = hold" in turned[1]
    assert settled[0] == 0 and settled[1].startswith("settled: ")
    assert faster[0] == 1 and "speed_scale" in faster[1]
    assert late[0] == 1 and late[1].startswith("not settled; ")
    # By the controller, unless another was discovered a second before it.
    stops = {"controller": "compliant stop", "observer": "stopped", "driver": "brakes closed"}
    by, _, how = stopped[1].partition(": ")
    assert stopped[0] == 0 and how == stops[by]
    assert kept[0] == 1 and "stop service called" in kept[1] and "contact-reach reset" in kept[1]
    # The controller follows a stop of the observer, and does not know of one of the driver, whose brakes may follow.
    expected = "driver: released" if by == "driver" else "controller: holding"
    assert released[0] == 0 and expected in released[1], released
    assert again == (0, "nothing is stopped")


@pytest.mark.slow
def test_time_waits_for_a_recorder_that_stands_still(stack):
    with ros(domain=stack.env["ROS_DOMAIN_ID"]):
        look, stamps = rclpy.create_node("look"), []
        topic, qos = topics.JOINT_STATES, qos_profile(topics.NEWEST)
        look.create_subscription(
            topic.type, topic.name, lambda state: stamps.append(nanoseconds(state.header.stamp)), qos
        )

        def passed(seconds):
            """How much time passes meanwhile, ns."""
            end, before_ns = time.monotonic() + seconds, stamps[-1] if stamps else 0
            while time.monotonic() < end:
                rclpy.spin_once(look, timeout_sec=0.1)
            return stamps[-1] - before_ns if stamps else 0

        wait_for(lambda: passed(0.1), 20, "time passes")
        recorder, began_ns = stack.processes["recorder"], stamps[-1]
        os.kill(recorder, signal.SIGSTOP)
        try:
            wait_for(lambda: passed(0.5) == 0, 30, "time stands still")
        finally:
            os.kill(recorder, signal.SIGCONT)
        assert stamps[-1] - began_ns < 2 * AHEAD_NS
        wait_for(lambda: passed(0.1) and stamps[-1] - began_ns > 3 * AHEAD_NS, 60, "time passes again")


def test_ctrl_c_ends_everything_with_the_arm_at_rest_and_the_bag_complete(stack):
    ((code, said),) = command_lines(stack.env, "goto 0.45 -0.45 0.35")
    assert code == 0, said
    assert speeds_until(stack.env["ROS_DOMAIN_ID"], lambda speeds: speeds[-1] > 2 * REST)
    stack.process.send_signal(signal.SIGINT)
    assert stack.process.wait(120) == 0
    wait_for(lambda: not stack.processes, 20, "all processes of the stack have ended")
    bag = BagReader(stack.bag)
    assert (stack.bag / "metadata.yaml").is_file() and bag.notes == ()
    # Also of the time in which the recorder stood still; of obstacles only the newest scene waits to be read.
    lost = {key for key in bag.custom_data if key.startswith("messages_lost/")}
    assert "messages_lost" in bag.custom_data and lost <= {"messages_lost/obstacles"}
    last = [*bag.raw_messages(["/joint_states"])][-2000:]
    speeds = [np.abs(bag.decode(raw).velocity).max() for raw in last]
    # Time ends a few states after the stop has brought the arm to rest.
    assert max(speeds) > 2 * REST and speeds[-1] < REST


def test_a_recorder_that_comes_late_has_seconds_of_ticks(tmp_path):
    """On a busy machine it takes that long until a recorder finds a topic."""
    topic, kept, bag = topics.JOINT_STATES, topics.KEPT_STREAM, tmp_path / "bag"
    with ros(f"bag:={bag}"):
        publisher = rclpy.create_node("look").create_publisher(topic.type, topic.name, qos_profile(kept))
        for _ in range(kept.depth):
            publisher.publish(JointState())
        recorder = RecorderNode()
        recorder.trigger_configure()
        recorder.trigger_activate()
        wait_for(lambda: recorder.turn() or publisher.get_subscription_count(), 60, "the recorder subscribes")
        assert publisher.wait_for_all_acked(Duration(seconds=60.0))
        recorder.deactivate()
    read = BagReader(bag)
    assert read.topics["/joint_states"].message_count == kept.depth and read.custom_data["messages_lost"] == "0"
