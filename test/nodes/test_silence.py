"""A controller that commands nothing any more, and what controller and driver do about old joint states and answers."""

import threading
import time

import numpy as np
import pytest
import rclpy
from arm_simulation import ARM, HOME, REST, TICK_NS
from diagnostic_msgs.msg import DiagnosticStatus
from stack_helpers import UNWATCHED, AtRest, ros, wait_for
from std_msgs.msg import Header

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_status, to_time
from contact_reach_ros.messages.safety_state import DISTRUST, ERROR, OK, is_stopped, stops_called
from contact_reach_ros.messages.serialized import command_writer, joint_state_writer
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.ros.inbox import Inbox, qos_profile
from contact_reach_ros.ros.lockstep import FOREVER_NS, Lockstep
from contact_reach_ros.timing import NANOSECONDS


@pytest.fixture
def controller():
    """In lockstep, with what it commands."""
    with ros(UNWATCHED, "use_sim_time:=true"):
        node = ControllerNode()
        node.trigger_configure()
        node.trigger_activate()
        node.commands = []
        node._write_commands = node.commands.append
        yield node


def test_in_lockstep_a_state_waits_for_what_the_observer_says_of_it(controller):
    others, states = rclpy.create_node("others"), topics.JOINT_STATES._replace(qos=topics.KEPT_STREAM)
    heard = (states, topics.SAFETY_STATE, topics.LOCKSTEP_HORIZON)
    state, safety, horizon = [
        others.create_publisher(topic.type, topic.name, qos_profile(topic.qos)) for topic in heard
    ]
    writer = joint_state_writer(ARM.joint_names, ARM.base_frame, ["position", "velocity"])

    def show(tick):
        state.publish(writer.write(HOME, REST, stamp_ns=tick * TICK_NS))
        while (controller._controller.stamp_ns or 0) < tick * TICK_NS:
            controller.inbox.wait(NANOSECONDS // 10)

    def say(done, stop=""):
        """The observer has seen the states up to a tick, and perhaps wants a stop."""
        safety.publish(to_status("observer", stop, {}, ERROR if stop else OK))
        for name in ("observer", "planner"):
            horizon.publish(Header(frame_id=name, stamp=to_time((done + 1) * TICK_NS)))

    for tick in (1, 2):
        say(done=tick)
        show(tick)
    assert controller._controller.mode is Mode.HOLDING
    threading.Timer(0.5, say, (3, "too much torque")).start()
    show(3)
    assert controller._controller.stop_reason == "too much torque"


def test_a_state_that_waits_for_others_keeps_no_node_from_ending(controller):
    others, states = rclpy.create_node("others"), topics.JOINT_STATES._replace(qos=topics.KEPT_STREAM)
    publisher = others.create_publisher(states.type, states.name, qos_profile(states.qos))
    publisher.publish(
        joint_state_writer(ARM.joint_names, ARM.base_frame, ["position", "velocity"]).write(
            HOME, REST, stamp_ns=TICK_NS
        )
    )
    loop = threading.Thread(target=controller.loop)
    loop.start()
    wait_for(publisher.get_subscription_count, 20, "the controller has the state")
    # Its stop is answered meanwhile.
    time.sleep(0.5)
    assert controller._answer_stop() == "compliant stop"
    wait_for(lambda: controller.stop_reason, 20, "the stop")
    assert controller.commands == []
    controller.request_stop()
    loop.join(20)
    assert not loop.is_alive()


def test_a_controller_that_commands_nothing_is_done_with_a_state_all_the_same(monkeypatch, controller):
    done = []
    monkeypatch.setattr(Lockstep, "done", lambda _, stamp_ns: done.append(stamp_ns))
    at_rest = AtRest(controller)
    at_rest.give(2)
    assert len(controller.commands) == 2
    controller._on_safety(to_status("observer", "torque", {DISTRUST: "an encoder is stuck"}, ERROR))
    at_rest.give()
    assert len(controller.commands) == 2 and done == [TICK_NS, 2 * TICK_NS, 3 * TICK_NS]
    assert "an encoder is stuck; nothing is commanded" in controller._controller.stop_reason


def test_a_stop_of_a_stopped_controller_is_published_too(controller):
    published, at_rest = [], AtRest(controller)
    controller._safety.publish = published.append
    at_rest.give(2)
    for calls in (1, 2):
        controller._answer_stop()
        at_rest.give(2)
        assert stops_called(published[-1]) == str(calls) and is_stopped(published[-1])


def test_with_open_brakes_time_stands_still_until_the_planner_has_had_a_goal(monkeypatch):
    command, waited = command_writer(ARM.n).write(RobotModel(ARM).gravity_at(np.array(ARM.home))), []
    monkeypatch.setattr(Inbox, "poll", lambda _: driver._on_command(command))

    def wait(*_):
        for name in ("observer", "planner", "controller"):
            driver._lockstep.hear(Header(frame_id=name, stamp=to_time(FOREVER_NS)))
        driver._on_command(command)
        waited.append(driver.robot.plant.steps)
        if len(waited) == 5:
            driver._on_goal_state(DiagnosticStatus())

    monkeypatch.setattr(Inbox, "wait", wait)
    with ros("use_sim_time:=true", "waits_for_goal:=true", "scene:=free"):
        driver = DriverNode()
        driver.running = True
        for _ in range(600):
            driver.turn()
        # Once for the first state, and then at the one with which the brakes are open.
        assert waited[0] == 0 and waited[1] > 400 and waited[1:] == 4 * [waited[1]]
        assert driver.robot.plant.steps == 600


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
    command = command_writer(ARM.n).write(np.arange(7.0))
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
    model = RobotModel(ARM)
    model.update(HOME, REST)
    command = command_writer(ARM.n).write(model.gravity)
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
