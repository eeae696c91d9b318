"""A controller that commands nothing any more, and what controller and driver do about old joint states and answers."""

import threading
import time

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME, REST, TICK_NS
from stack_helpers import UNWATCHED, ros, wait_for
from std_msgs.msg import Header

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import iiwa14
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_status, to_time
from contact_reach_ros.messages.safety_state import DISTRUST, ERROR, OK
from contact_reach_ros.messages.serialized import CommandWriter, JointStateWriter
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.timing import NANOSECONDS

_HEARD = (topics.JOINT_STATES, topics.SAFETY_STATE, topics.LOCKSTEP_HORIZON)


@pytest.fixture
def lockstep():
    arguments = [*UNWATCHED, "-p", "use_sim_time:=true", "-p", "lockstep:=true"]
    with ros(*arguments):
        yield


class Others:
    """Driver, observer and planner, for a controller whose loop runs when the test lets it."""

    def __init__(self, controller: ControllerNode) -> None:
        node = rclpy.create_node("others")
        self._state, self._safety, self._horizon = (
            node.create_publisher(topic.type, topic.name, qos_profile(topic.qos)) for topic in _HEARD
        )
        self._writer = JointStateWriter(iiwa14.ARM.joint_names, iiwa14.ARM.base_frame, ["position", "velocity"])
        self._node, self._controller = node, controller
        topic = topics.LOCKSTEP_HORIZON
        self._promises = node.create_subscription(topic.type, topic.name, print, qos_profile(topic.qos))
        publishers = (self._state, self._safety, self._horizon)
        wait_for(lambda: all(each.get_subscription_count() for each in publishers), 20, "the controller hears all")

    def show(self, tick: int) -> None:
        """Publish a joint state, and have the controller handle what there is until it has seen it."""
        self._state.publish(self._writer.write(tick * TICK_NS, HOME, REST))
        while (self._controller._controller.stamp_ns or 0) < tick * TICK_NS:
            self._controller.inbox.wait(NANOSECONDS // 10)

    def await_promise(self, tick: int) -> None:
        """Until the controller promises that it is done with a state."""

        def promised() -> bool:
            taken = self._promises.handle.take_message(Header, False)
            return taken and (taken[0].frame_id, nanoseconds(taken[0].stamp)) == ("controller", (tick + 1) * TICK_NS)

        wait_for(promised, 20, f"the controller is done with state {tick}")

    def say(self, done: int, stop: str = "") -> None:
        """The observer has seen the states up to a tick, and perhaps wants a stop."""
        self._safety.publish(to_status("observer", stop, {}, ERROR if stop else OK))
        for name in ("observer", "planner"):
            header = Header(frame_id=name)
            header.stamp = to_time((done + 1) * TICK_NS)
            self._horizon.publish(header)


def test_in_lockstep_a_state_waits_for_what_the_observer_says_of_it(lockstep, monkeypatch):
    node = ControllerNode()
    node.look_around()
    others = Others(node)
    for tick in (1, 2):
        others.say(done=tick)
        others.show(tick)
    assert node._controller.mode is Mode.HOLDING
    threading.Timer(0.5, lambda: others.say(done=3, stop="too much torque")).start()
    others.show(3)
    assert node._controller.stop_reason == "too much torque"
    # One that has nothing to say any more holds it up for a while only.
    monkeypatch.setattr("contact_reach_ros.ros.inbox._LONGEST_HOLD_S", 0.5)
    started = time.monotonic()
    others.show(4)
    assert time.monotonic() - started > 0.4


def test_a_controller_that_commands_nothing_is_done_with_a_state_all_the_same(lockstep):
    node = ControllerNode()
    node.look_around()
    others = Others(node)
    commands: list[bytes] = []
    node._write_commands = commands.append
    for tick in (1, 2):
        others.say(done=tick)
        others.show(tick)
        others.await_promise(tick)
    assert len(commands) == 2
    node._on_safety(to_status("observer", "torque", {DISTRUST: "an encoder is stuck"}, ERROR))
    others.say(done=3, stop="torque; an encoder is stuck")
    others.show(3)
    others.await_promise(3)
    assert len(commands) == 2
    assert "an encoder is stuck; nothing is commanded" in node._controller.stop_reason


class SteadyClock:
    """Instead of the module time: goes on only when the test lets it."""

    now_ns = 1_000_000_000

    def monotonic_ns(self) -> int:
        return self.now_ns

    time_ns = monotonic_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(1e9 * seconds)


@pytest.fixture
def clock(monkeypatch):
    """For a driver in real time."""
    made = SteadyClock()
    monkeypatch.setattr("contact_reach_ros.nodes.driver.time", made)
    with ros():
        yield made


def test_a_late_driver_first_lets_the_controller_answer(clock, monkeypatch):
    driver = DriverNode()
    command = CommandWriter(iiwa14.ARM.n).write(np.arange(7.0))
    taken = []
    monkeypatch.setattr(driver.robot, "command", lambda torque, _: taken.append(torque.tolist()))
    monkeypatch.setattr(driver.inbox, "wait", lambda _: driver._on_command(command))

    def turn(late_ns: int) -> None:
        driver.pace.next_ns = clock.now_ns - late_ns
        driver._realtime_tick()

    turn(-TICK_NS)
    assert driver._waits_for_command and not taken
    turn(2 * TICK_NS)
    assert taken == [list(range(7))]
    driver._waits_for_command = False
    turn(2 * TICK_NS)
    assert len(taken) == 1
    assert driver.diagnosis()[1]["missed ticks"] == 4


def test_contacts_are_published_after_the_answer_where_there_is_time_for_that(clock, monkeypatch):
    driver, done = DriverNode(), []
    monkeypatch.setattr(driver, "publish_state", lambda _: done.append("state"))
    monkeypatch.setattr(driver, "_write_contacts", lambda _: done.append("contacts"))
    monkeypatch.setattr(driver.inbox, "wait", lambda _: done.append("wait"))
    driver.pace.next_ns = clock.now_ns + TICK_NS
    for _ in range(5):
        driver._realtime_tick()
    assert done == [*5 * ["state"], "wait", "contacts"]


def test_who_was_paused_does_not_take_others_for_silent(clock, monkeypatch):
    """As when a virtual machine stands still: neither robot nor controller have done anything meanwhile."""
    driver = DriverNode()
    monkeypatch.setattr(driver.inbox, "wait", lambda _: None)
    model = RobotModel(iiwa14.ARM)
    model.update(HOME, REST)
    command = CommandWriter(iiwa14.ARM.n).write(model.gravity)
    driver.pace.next_ns = clock.now_ns
    for _ in range(1000):
        driver._realtime_tick()
        driver._on_command(command)
    assert driver.diagnosis()[1]["actuation"] == "commanded"
    before_ns = driver.robot.now_ns
    clock.sleep(0.5)
    driver._realtime_tick()
    assert driver.diagnosis()[1]["stop reason"] == ""
    assert driver.diagnosis()[1]["missed ticks"] == 499
    # Stamps go on, and what there was to catch up is bounded.
    assert driver.robot.now_ns - before_ns == 500 * TICK_NS
    for _ in range(100):
        driver._realtime_tick()
    assert driver.diagnosis()[1]["stop reason"].startswith("no command for")
