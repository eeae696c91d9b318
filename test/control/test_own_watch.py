"""The controller watches itself: an observer that is late leaves nothing unwatched, and either one's stop counts."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS

from contact_reach_ros.arm import BLIND_AFTER, JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.settings import ControllerSettings, SupervisionSettings
from contact_reach_ros.control.supervisor import OBSERVER_TIMEOUT, Mode
from contact_reach_ros.errors import InputError, StopCode, StopReason, Verdict
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.world.scene import Scene

PAUSE_AT = 1000
"""Tick from which the observer is silent."""


def make_controller(watcher=None) -> Controller:
    """A controller with this watcher, which is shown every state; or one without a watch of its own."""
    supervision = SupervisionSettings(watch_itself=watcher is not None)
    controller = Controller(ARM, ControllerSettings(supervision=supervision))
    controller.watch_with(watcher)
    return controller


def noticed_after(controller: Controller, silent_ms: int) -> tuple[int, str]:
    """Ticks from the beginning of a pause of the observer's reports until a push 50 ms later stops the arm; and why."""
    robot = SimulatedRobot(Scene("watch", ARM, 0, HOME, np.zeros(3)))
    observer = Observer(ARM, ObserverSettings(), ContactBudget())
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
    watcher = Observer(ARM, ObserverSettings(), ContactBudget(), locates=False)
    heard, expected = noticed_after(make_controller(), 0)
    after, reason = noticed_after(make_controller(watcher), 200)
    assert after <= heard + 1 and heard < 100
    push = "sudden external torque on lbr_A1"
    assert expected.startswith(push) and reason.startswith(push)


class Watcher:
    """Reports what the test wants, and latches a reason as an observer does; keeps the states that it is shown."""

    due = True

    def __init__(self) -> None:
        self.verdict = Verdict()
        self.is_pushed = False
        self.states: list[JointState] = []

    def update(self, state):
        self.states.append(state)
        return self

    def report(self):
        return self

    def reset(self, silence):
        if self.is_pushed:
            raise InputError("free the arm")
        self.verdict = self.verdict._replace(reason="")


MISSED = StopReason(StopCode.MISSED_STATES, "blind: joint states are up to 90 ms apart")
BLIND = StopReason(StopCode.BLIND, "blind: joint_states carry no effort")
LONGEST = round(1000 * OBSERVER_TIMEOUT)


@pytest.fixture
def watcher() -> Watcher:
    return Watcher()


@pytest.fixture
def controller(watcher) -> Controller:
    """Started; has answered the state of tick 2, and heard the observer before."""
    made = make_controller(watcher)
    made.hear(Verdict(), TICK_NS)
    for tick in (1, 2):
        update(made, tick)
    return made


def update(controller: Controller, tick: int, is_shown: bool = True) -> np.ndarray | None:
    """The verdict of the watcher, which may be shown the state, counts from the next tick on."""
    state = JointState(tick * TICK_NS, HOME, REST, np.full(ARM.n, tick))
    torque = controller.update(state, state.stamp_ns)
    if is_shown:
        controller.watch(state, state.stamp_ns)
    return torque


def stopped_at(controller: Controller, heard: Verdict | None = None, is_shown: bool = True) -> int:
    """The tick from 3 on in which the controller stops; it hears a verdict of the observer in each, if one is given."""
    for tick in range(3, 4 * LONGEST):
        if heard is not None:
            controller.hear(heard, tick * TICK_NS)
        update(controller, tick, is_shown)
        if controller.stop_reason:
            return tick
    raise AssertionError("it does not stop")


@pytest.mark.parametrize("is_watched", [True, False])
def test_the_observer_may_be_silent_for_a_quarter_of_a_second(controller, is_watched):
    if not is_watched:
        controller = make_controller()
        controller.hear(Verdict(), TICK_NS)
    assert stopped_at(controller) == LONGEST + 2
    assert controller.stop_reason.startswith("observer silent for 251 ms")


@pytest.mark.parametrize("why", [MISSED, BLIND])
@pytest.mark.parametrize("is_own", [True, False])
def test_either_ones_stop_counts(controller, watcher, why, is_own):
    blind = Verdict(why, doubt=why)
    watcher.verdict = blind if is_own else Verdict()
    assert stopped_at(controller, Verdict() if is_own else blind) == 3
    assert controller.stop_reason == why


@pytest.mark.parametrize(("gap", "is_stopped"), [(20, False), (60, False), (90, True)])
def test_a_pause_of_the_controller_is_blindness_from_75_ms_on(gap, is_stopped):
    watcher = Observer(ARM, ObserverSettings(), ContactBudget(), locates=False, blind_after=BLIND_AFTER)
    controller = make_controller(watcher)
    weight = RobotModel(ARM).gravity_at(HOME)
    for tick in (*range(1, 600), *range(600 + gap, 640 + gap)):
        controller.hear(Verdict(), tick * TICK_NS)
        state = JointState(tick * TICK_NS, HOME + 1e-5 * (tick % 2), REST, weight)
        controller.update(state, tick * TICK_NS)
        controller.watch(state, tick * TICK_NS)
    assert controller.started and bool(controller.stop_reason) == is_stopped
    assert not is_stopped or controller.stop_reason.code is StopCode.MISSED_STATES


def test_its_doubt_keeps_the_arm_from_being_started(watcher):
    watcher.verdict = Verdict(doubt="no torque")
    controller = make_controller(watcher)
    controller.hear(Verdict(), TICK_NS)
    assert update(controller, 1) is None and "own watch has seen nothing" in controller.not_vouched
    assert update(controller, 2) is None and "no torque" in controller.not_vouched
    watcher.verdict = Verdict()
    update(controller, 3)
    assert update(controller, 4) is not None


def test_its_distrust_ends_all_commands(controller, watcher):
    watcher.verdict = Verdict("encoder stuck", "encoder stuck")
    update(controller, 3)
    assert controller.mode is Mode.SILENT
    assert update(controller, 4) is None


def test_a_reset_releases_it_unless_the_arm_is_pushed(controller, watcher):
    watcher.verdict, watcher.is_pushed = Verdict("too much torque"), True
    update(controller, 3)
    with pytest.raises(InputError, match="free the arm"):
        controller.reset(3 * TICK_NS)
    assert controller.stop_reason == "too much torque"
    watcher.is_pushed = False
    controller.reset(3 * TICK_NS)
    assert controller.mode is Mode.HOLDING and not controller.stop_reason
