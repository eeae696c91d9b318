"""The controller watches itself: an observer that is late leaves nothing unwatched, and stops nothing by that."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.control.controller import WATCH_RATE, Controller, ControllerSettings
from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.control.supervisor import OBSERVER_PATIENCE, OBSERVER_TIMEOUT, Mode
from contact_reach_ros.errors import InputError, StopCode, StopReason, Verdict
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.world.scene import Scene

PAUSE_AT = 1000
"""Tick from which the observer is silent."""


def make_observer(**options) -> Observer:
    return Observer(ARM, ObserverSettings(), ContactBudget(), **options)


def make_controller(watch_itself: bool = True, watch_rate: float = 1000.0) -> Controller:
    settings = ControllerSettings(supervision=SupervisionSettings(watch_itself=watch_itself))
    return Controller(ARM, settings, watch_rate=watch_rate)


def watched_by(watcher) -> Controller:
    """A controller with this watcher, which is shown every state."""
    controller = make_controller()
    controller.watch_with(watcher)
    return controller


def noticed_after(controller: Controller, silent_ms: int) -> tuple[int, str]:
    """Ticks from the beginning of a pause of the observer's reports until a push 50 ms later stops the arm; and why."""
    robot, observer = SimulatedRobot(Scene("watch", ARM, 0, HOME, np.zeros(3))), make_observer()
    elbow = robot.plant.model.body("lbr_link_4").id
    for tick in range(1, PAUSE_AT + 200):
        (state,) = robot.read()
        report = observer.update(state)
        if report.due and not PAUSE_AT <= tick < PAUSE_AT + silent_ms:
            controller.hear(report.verdict, tick * TICK_NS)
        if tick == PAUSE_AT + 50:
            robot.plant.data.xfrc_applied[elbow, 1] = 100.0
        torque = controller.update(state, tick * TICK_NS)
        controller.watch(state, tick * TICK_NS)
        if torque is not None:
            robot.command(torque, tick * TICK_NS)
        robot.step(tick * TICK_NS)
        if controller.stop_reason:
            break
    return tick - PAUSE_AT, controller.stop_reason


def test_a_push_during_a_pause_of_the_observer_is_seen_a_state_later_than_by_it():
    controller = make_controller(watch_rate=WATCH_RATE)
    controller.watch_with(make_observer(period=controller.watch_period, locates=False))
    heard, expected = noticed_after(make_controller(watch_itself=False), 0)
    after, reason = noticed_after(controller, 200)
    assert after <= heard + 1000 * controller.watch_period and heard < 100
    push = "sudden external torque on lbr_A1"
    assert expected.startswith(push) and reason.startswith(push)


class Watcher:
    """Reports what the test wants, and latches a reason as an observer does."""

    due = True

    def __init__(self) -> None:
        self.verdict = Verdict()
        self.is_pushed = False
        self.resets = 0

    def update(self, state):
        return self

    def report(self):
        return self

    def reset(self):
        if self.is_pushed:
            raise InputError("free the arm")
        self.resets += 1
        self.verdict = self.verdict._replace(reason="")


class TestVerdicts:
    """The stub's verdict of a state counts from the next tick on."""

    @pytest.fixture
    def watcher(self) -> Watcher:
        return Watcher()

    @pytest.fixture
    def controller(self, watcher) -> Controller:
        """Has seen, and answered, the state of tick 1."""
        made = watched_by(watcher)
        made.hear(Verdict(), TICK_NS)
        self.update(made, 1)
        return made

    def update(self, controller, tick):
        state = JointState(tick * TICK_NS, HOME, REST, None)
        torque = controller.update(state, state.stamp_ns)
        controller.watch(state, state.stamp_ns)
        return torque

    def test_while_it_vouches_the_observer_may_be_silent_for_longer_but_not_for_ever(self, controller):
        assert self.update_all(controller, range(2, 2000)) == round(1000 * OBSERVER_PATIENCE) + 2
        assert controller.stop_reason.startswith("observer silent for 501 ms")
        alone = make_controller(watch_itself=False)
        alone.watch_with(Watcher())
        alone.hear(Verdict(), TICK_NS)
        assert self.update_all(alone, range(1, 2000)) == round(1000 * OBSERVER_TIMEOUT) + 2

    def test_its_doubt_keeps_the_arm_from_being_started(self, watcher):
        watcher.verdict = Verdict(doubt="no torque")
        controller = watched_by(watcher)
        controller.hear(Verdict(), TICK_NS)
        assert self.update(controller, 1) is None and "own watch has seen nothing" in controller.not_vouched
        assert self.update(controller, 2) is None and "no torque" in controller.not_vouched
        watcher.verdict = Verdict()
        self.update(controller, 3)
        assert self.update(controller, 4) is not None

    @pytest.mark.parametrize("shown", [True, False])
    def test_a_watch_that_doubts_or_is_shown_nothing_ends_the_patience(self, controller, watcher, shown):
        watcher.verdict = Verdict(doubt="500 Hz" if shown else "")
        for tick in range(2, 60):
            state = JointState(tick * TICK_NS, HOME, REST, None)
            controller.update(state, state.stamp_ns)
            if shown:
                controller.watch(state, state.stamp_ns)
        assert controller.stop_reason.startswith("observer silent for 5")

    MISSED = StopReason(StopCode.MISSED_STATES, "blind: joint states are up to 9 ms apart")
    BLIND = StopReason(StopCode.BLIND, "blind: joint_states carry no effort")

    def update_all(self, controller, ticks, verdict=None):
        """Takes states, and reports of the observer if a verdict is given; returns the tick of the stop."""
        for tick in ticks:
            if verdict is not None:
                controller.hear(verdict, tick * TICK_NS)
            self.update(controller, tick)
            if controller.stop_reason:
                return tick
        return None

    def test_the_observer_alone_may_miss_states_for_as_long_as_it_may_be_silent(self, controller):
        longest = round(1000 * OBSERVER_PATIENCE)
        missed = Verdict(self.MISSED, doubt=self.MISSED)
        self.update(controller, 2)
        assert self.update_all(controller, range(3, 2 * longest), missed) == 3 + longest + 1
        assert controller.stop_reason == self.MISSED

    @pytest.mark.parametrize("who", ["observer", "own watch"])
    def test_what_the_states_lack_stops_the_arm_whoever_misses_it(self, controller, watcher, who):
        self.update(controller, 2)
        blind = Verdict(self.BLIND, doubt=self.BLIND)
        watcher.verdict = blind if who == "own watch" else Verdict()
        assert self.update_all(controller, range(3, 9), blind if who == "observer" else Verdict()) == 3

    def test_where_it_does_not_vouch_an_observer_that_missed_states_stops_the_arm(self, controller, watcher):
        watcher.verdict = Verdict(doubt="500 Hz")
        self.update(controller, 2)
        assert self.update_all(controller, range(3, 200), Verdict(self.MISSED, doubt=self.MISSED)) == 3

    def test_its_distrust_ends_all_commands(self, controller, watcher):
        watcher.verdict = Verdict("encoder stuck", "encoder stuck")
        self.update(controller, 2)
        assert controller.mode is Mode.SILENT
        assert self.update(controller, 3) is None

    def test_a_reset_releases_it_unless_the_arm_is_pushed(self, controller, watcher):
        self.update(controller, 2)
        watcher.verdict, watcher.is_pushed = Verdict("too much torque"), True
        self.update(controller, 3)
        with pytest.raises(InputError, match="free the arm"):
            controller.reset(3 * TICK_NS)
        assert controller.stop_reason == "too much torque"
        watcher.is_pushed = False
        controller.reset(3 * TICK_NS)
        assert controller.mode is Mode.HOLDING and watcher.resets == 1


class Recorder(Watcher):
    """Keeps what it is shown."""

    def __init__(self) -> None:
        super().__init__()
        self.states = []

    def update(self, state):
        self.states.append(state)
        return self


class TestRate:
    """The watcher takes one state in each of its periods, with the mean of the torques since the last."""

    def test_states_are_those_of_its_period(self):
        watcher, controller = Recorder(), make_controller(watch_rate=250.0)
        controller.watch_with(watcher)
        for tick in range(1, 14):
            controller.watch(JointState(tick * TICK_NS, HOME, REST, np.full(ARM.n, tick)), tick * TICK_NS)
        assert [state.stamp_ns // TICK_NS for state in watcher.states] == [1, 5, 9, 13]
        assert [state.torque[0] for state in watcher.states] == [1.0, 3.5, 7.5, 11.5]

    def test_gaps_are_noticed_as_at_the_full_rate(self):
        """4 ms are the nominal time between the states that the watcher is shown."""
        watcher = Recorder()
        controller = Controller(ARM, ControllerSettings())
        controller.watch_with(watcher)
        for tick in range(1, 10):
            controller.hear(Verdict(), 4 * tick * TICK_NS)
            controller.update(JointState(4 * tick * TICK_NS, HOME, REST, None), 4 * tick * TICK_NS)
            controller.watch(controller.state, 4 * tick * TICK_NS)
        assert controller.supervisor.own_reason.code is StopCode.MISSED_STATES
        with pytest.raises(InputError, match="the controller's own watch is stopped"):
            controller.reset(36 * TICK_NS)
        for tick in range(37, 46):
            controller.watch(JointState(tick * TICK_NS, HOME, REST, None), tick * TICK_NS)
        assert not controller.supervisor.own_reason
