"""What ended a node's process once: each is refused and counted now, and the process goes on."""

import subprocess
import threading
import time
from contextlib import contextmanager

import pytest
import rclpy
from arm_simulation import HOME, REST
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import SingleThreadedExecutor
from stack_helpers import UNWATCHED, environment, module, running, wait_for
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.arms import iiwa14
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import JointStateWriter
from contact_reach_ros.ros.qos import qos_profile

_PERIOD_S = 0.005
LONG_NAME = "a" * 300


class Robot:
    """Publishes the joint states of an arm at rest, and counts what the controller answers and refuses."""

    def __init__(self):
        self.node = rclpy.create_node("robot")
        self.commands = 0
        self.refused = {}
        self.node.create_subscription(Float64MultiArray, topics.COMMANDS.name, self._on_command, 10)
        self.node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS.name, self._on_diagnostics, 10)
        self._states = self.publisher(topics.JOINT_STATES)
        self._writer = JointStateWriter(iiwa14.ARM.joint_names, iiwa14.ARM.base_frame, ["position", "velocity"])
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def publisher(self, topic):
        return self.node.create_publisher(topic.type, topic.name, qos_profile(topic.qos))

    def call(self, kind, service, request):
        """The answer of a service."""
        client = self.node.create_client(kind, service)
        assert client.wait_for_service(30.0)
        answer = client.call_async(request)
        wait_for(answer.done, 30.0, f"{service} answers")
        return answer.result()

    def end(self):
        self._ended.set()
        self._thread.join()

    def _work(self):
        while not self._ended.is_set():
            self._states.publish(self._writer.write(time.time_ns(), HOME, REST))
            until = time.monotonic() + _PERIOD_S
            while time.monotonic() < until:
                self._executor.spin_once(0.001)

    def _on_command(self, _):
        self.commands += 1

    def _on_diagnostics(self, message):
        for status in message.status:
            if status.name == "controller":
                self.refused = {entry.key: entry.value for entry in status.values if entry.key.startswith("refused")}


@pytest.fixture
def commanding(tmp_path):
    """A controller's process that commands an arm, and the robot that it commands."""
    env, log = environment(), tmp_path / "controller.log"
    rclpy.init(domain_id=int(env["ROS_DOMAIN_ID"]))
    robot = Robot()

    @contextmanager
    def unharmed(refused):
        """Whatever happens is counted under a name; the process goes on, active, and commands the arm."""
        wait_for(lambda: robot.commands > 10, 60.0, f"the arm is commanded; {log.read_text()}")
        yield
        wait_for(lambda: f"refused {refused}" in robot.refused, 10.0, f"the refusal is counted; {log.read_text()}")
        before = robot.commands
        wait_for(lambda: robot.commands > before + 10, 10.0, "the arm is still commanded")
        state = robot.call(GetState, "controller/get_state", GetState.Request()).current_state
        assert state.id == State.PRIMARY_STATE_ACTIVE
        assert controller.poll() is None, log.read_text()
        assert "Traceback" not in log.read_text()

    try:
        with running([*module("nodes.controller"), *UNWATCHED], env, log) as controller:
            yield robot, unharmed
    finally:
        robot.end()
        rclpy.shutdown()


@pytest.mark.parametrize("topic", [topics.REFERENCE_POSE, topics.REFERENCE_POSTURE])
def test_an_empty_trajectory_is_refused(commanding, topic):
    robot, unharmed = commanding
    publisher = robot.publisher(topic)
    with unharmed("references"):
        wait_for(publisher.get_subscription_count, 10.0, "the controller hears")
        publisher.publish(topic.type())


@pytest.mark.parametrize(
    "transition",
    [
        Transition(id=Transition.TRANSITION_CONFIGURE),
        Transition(id=200),
        Transition(label="no such transition"),
    ],
    ids=["configure", "unknown id", "unknown label"],
)
def test_a_transition_that_is_not_permitted_is_refused(commanding, transition):
    robot, unharmed = commanding
    with unharmed("transitions"):
        request = ChangeState.Request(transition=transition)
        assert not robot.call(ChangeState, "controller/change_state", request).success


@pytest.mark.parametrize(
    "command",
    [
        [*module("nodes.driver"), "--ros-args", "-p", f"scene:={LONG_NAME}"],
        [*module("nodes.observer"), "--ros-args", "-p", f"contact_budget:={LONG_NAME}.yaml"],
        [*module("nodes.recorder"), "--ros-args", "-p", f"bag:={LONG_NAME}"],
        [*module("bringup.bringup"), "--ros-args", "-p", f"scene:={LONG_NAME}"],
        [*module("bringup.bringup"), "--ros-args", "-p", f"parameters:={LONG_NAME}"],
        [*module("cli"), "bench", "--scene", LONG_NAME],
    ],
    ids=["scene", "budget", "bag", "bringup's scene", "bringup's parameters", "command line"],
)
def test_a_name_that_no_file_can_have_is_refused(command):
    result = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60)
    assert result.returncode not in (0, -9)
    assert LONG_NAME[:20] in result.stderr
    assert "Traceback" not in result.stderr
