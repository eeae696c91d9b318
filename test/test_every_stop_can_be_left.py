"""From every state of controller, observer, adapter and drive, a reset leads back to an arm that is held.

A walk through all states × events: `Stack.reset` and `contact-reach reset` go through the same `RESET_ORDER`.
"""

from __future__ import annotations

import contextlib
import copy
import gc
import itertools
from collections.abc import Callable

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from plans import StayingCore

from contact_reach_ros.arm import BLIND_AFTER, JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.settings import ControllerSettings, SupervisionSettings
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.drives.command_guard import CommandGuard, Phase
from contact_reach_ros.drives.settings import AdapterSettings
from contact_reach_ros.errors import InputError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.scene import Scene

PERIOD = 0.008
DEPTH = 2
"""Events from the arm that is held to the situations that are left; 3 takes a quarter of an hour."""
BUDGET = ContactBudget().resolve(ARM)
LINK = "lbr_link_7"
CONTROLLER, OBSERVER, ADAPTER, DRIVER = "controller", "observer", "adapter", "driver"


class Robot(SimulatedRobot):
    """Its joint states may be changed on their way; `change` returns None for one that is lost."""

    change: Callable[[JointState], JointState | None] = staticmethod(lambda state: state)

    def read(self) -> list[JointState]:
        return [state for state in map(self.change, super().read()) if state is not None]


class Rig(Stack):
    """A stack with an adapter, if wanted, whose nodes may stand still."""

    def __init__(self, has_brakes: bool, has_adapter: bool) -> None:
        watchdog = WatchdogSettings() if has_brakes else WatchdogSettings(enabled=False, speed_share=0.0)
        robot = Robot(Scene("walk", ARM, 0, HOME, np.zeros(3)), watchdog=watchdog, period=PERIOD)
        supervision = SupervisionSettings(adapter=has_adapter, drive_brakes=has_brakes)
        self.standing: set[str] = set()
        self.guard: CommandGuard | None = None
        super().__init__(
            robot.scene,
            planner=StayingCore(),
            controller=ControllerSettings(supervision=supervision),
            robot=robot,
            period=PERIOD,
        )
        if has_adapter:
            self.start_adapter()

    def start_adapter(self) -> None:
        self.guard = CommandGuard(ARM, AdapterSettings(), PERIOD, BUDGET.handover_thresholds)

    def start_controller(self) -> None:
        hold = BUDGET.handover_thresholds
        self.controller = Controller(ARM, self.controller.settings, PERIOD, hold=hold)
        watcher = Observer(ARM, ObserverSettings(), BUDGET, PERIOD, locates=False, blind_after=BLIND_AFTER)
        self.controller.watch_with(watcher)

    def start_observer(self) -> None:
        self.observer = Observer(ARM, ObserverSettings(), BUDGET, PERIOD)

    def twin(self) -> Rig:
        """A copy that goes its own way. Robot models are shared: they are updated before each use."""
        models = [part for part in gc.get_objects() if isinstance(part, RobotModel)]
        return copy.deepcopy(self, {id(model): model for model in models})

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.step()

    def resets(self) -> str:
        """Try a reset as `contact-reach reset` does, for 5 s; returns why it is refused, empty when it is not."""
        why = ""
        for _ in range(6):
            try:
                self.reset()
                why = ""
            except InputError as error:
                why = str(error)
            self.run(1.0)
            if not self.stopped_by:
                return ""
        return f"{why}; stopped: {self.stopped_by}"

    @property
    def stopped_by(self) -> dict[str, str]:
        """What stopped the arm, by node."""
        reasons = {
            CONTROLLER: self.controller.stop_reason,
            OBSERVER: self.observer.monitor.stop_reason,
            ADAPTER: self.guard.stop_reason if self.guard is not None else "",
            DRIVER: self.robot.stop_reason,
        }
        return {name: reason for name, reason in reasons.items() if reason}

    @property
    def situation(self) -> tuple:
        """The state that counts: two rigs in the same one behave alike."""
        controller, observer, guard, drive = self.controller, self.observer, self.guard, self.robot
        watcher = controller._watcher
        return (
            controller.mode,
            controller.started,
            bool(watcher.monitor.stop_reason),
            bool(observer.monitor.stop_reason),
            observer.momentum.known_for > 0.0,
            None if guard is None else (guard.phase, bool(guard.stop_reason)),
            bool(drive.stop_reason),
            drive.is_open,
        )

    # Between the nodes

    def _reset(self, name: str) -> None:
        super()._reset(name)
        if name == ADAPTER and self.guard is not None:
            self.guard.reset(self._clock_ns)

    def _control(self) -> np.ndarray | None:
        guard, clock_ns = self.guard, self._clock_ns
        if guard is not None:
            self.controller.in_force = not guard.stop_reason and guard.phase is not Phase.WAITING
            for state in self._arrived if ADAPTER not in self.standing else ():
                guard.see(state, clock_ns)
        torque = None if CONTROLLER in self.standing else super()._control()
        if guard is not None and ADAPTER not in self.standing:
            harmless = guard.watch(clock_ns)
            if harmless is not None:
                self.robot.command(harmless, clock_ns)
        return torque

    def _send(self, torque: np.ndarray) -> None:
        if self.guard is None:
            super()._send(torque)
        elif ADAPTER not in self.standing:
            passed = self.guard.command(torque, self._clock_ns)
            if passed is not None:
                super()._send(passed)

    def _observe(self):
        return None if OBSERVER in self.standing else super()._observe()

    def _plan(self) -> None:
        """There is never a goal."""

    def _refuse(self, what: str, error: InputError) -> None:
        self.refused[what] = self.refused.get(what, 0) + 1


# What happens: the cause is gone at the end, its consequence is not.


def stands_still(name: str, seconds: float) -> Callable[[Rig], None]:
    def happens(rig: Rig) -> None:
        rig.standing = {name}
        rig.run(seconds)
        rig.standing = set()

    return happens


def shows(change: Callable[[JointState], JointState | None], seconds: float) -> Callable[[Rig], None]:
    """Joint states are changed for a while."""

    def happens(rig: Rig) -> None:
        rig.robot.change = change
        rig.run(seconds)
        del rig.robot.change

    return happens


def frozen(rig: Rig) -> None:
    """The stamps do not advance."""
    stamp_ns = rig.state.stamp_ns
    shows(lambda state: state._replace(stamp_ns=stamp_ns), 0.3)(rig)


def pushed(newtons: float, seconds: float) -> Callable[[Rig], None]:
    def happens(rig: Rig) -> None:
        push(rig, newtons)
        rig.run(seconds)
        push(rig, 0.0)

    return happens


def push(rig: Rig, newtons: float) -> None:
    """Push the last link upwards from now on."""
    rig.robot.plant.set_pushes([(LINK, np.array([0.0, 0.0, newtons]), np.zeros(3))])


def once(act: Callable[[Rig], object], seconds: float = PERIOD) -> Callable[[Rig], None]:
    def happens(rig: Rig) -> None:
        with contextlib.suppress(InputError):
            act(rig)
        rig.run(seconds)

    return happens


def with_adapter(act: Callable[[Rig], object]) -> Callable[[Rig], object]:
    return lambda rig: act(rig) if rig.guard is not None else None


UNKNOWN = np.full(ARM.n, np.nan)
EVENTS: dict[str, Callable[[Rig], None]] = {
    "controller/stop": once(lambda rig: rig.controller.stop("requested")),
    "observer/stop": once(lambda rig: rig.observer.stop("requested")),
    "driver/stop": once(lambda rig: rig.robot.stop("requested")),
    "adapter/stop": once(with_adapter(lambda rig: rig.guard.stop("requested"))),
    "controller/reset": once(lambda rig: rig._reset(CONTROLLER)),
    "observer/reset": once(lambda rig: rig._reset(OBSERVER)),
    "driver/reset": once(lambda rig: rig._reset(DRIVER)),
    "adapter/reset": once(with_adapter(lambda rig: rig._reset(ADAPTER))),
    "push": pushed(-80.0, 0.1),
    "push until the brakes close": pushed(45.0, 1.3),
    "a little time": once(lambda rig: None, 0.2),
    "time": once(lambda rig: None, 2.0),
    "controller stands still for 60 ms": stands_still(CONTROLLER, 0.06),
    "controller stands still": stands_still(CONTROLLER, 0.3),
    "observer stands still": stands_still(OBSERVER, 0.4),
    "adapter stands still": stands_still(ADAPTER, 0.3),
    "controller starts again": once(lambda rig: rig.start_controller()),
    "observer starts again": once(lambda rig: rig.start_observer()),
    "adapter starts again": once(with_adapter(lambda rig: rig.start_adapter())),
    "controller is activated": once(lambda rig: rig.controller.activate()),
    "no joint states": shows(lambda state: None, 0.3),
    "no efforts": shows(lambda state: state._replace(torque=None), 0.4),
    "unknown efforts": shows(lambda state: state._replace(torque=UNKNOWN), 0.4),
    "stamps stop": frozen,
    "an encoder jumps": shows(lambda state: state._replace(q=state.q + 0.1), 0.05),
}


def walk(has_brakes: bool, has_adapter: bool) -> dict[tuple, list[str]]:
    """All situations within `DEPTH` events of an arm that is held, with a way to each."""
    start = Rig(has_brakes, has_adapter)
    start.run(1.5)
    assert start.controller.mode is Mode.HOLDING and start.robot.is_open
    found: dict[tuple, list[str]] = {start.situation: []}
    edge = [start]
    for _ in range(DEPTH):
        reached = []
        for rig in edge:
            way = found[rig.situation]
            for name, happens in EVENTS.items():
                if name == "adapter starts again" and not has_brakes:
                    # While there is none, such a drive holds the last torque: the arm may not come to rest.
                    continue
                after = rig.twin()
                happens(after)
                if after.situation not in found:
                    found[after.situation] = [*way, name]
                    check(after.twin(), found[after.situation])
                    reached.append(after)
        edge = reached
    return found


def check(rig: Rig, way: list[str]) -> None:
    """Once the cause is gone, a reset leads back to the arm that is held."""
    why = rig.resets()
    assert not why, (way, why)
    # After the cause of a doubt a controller that was started again waits for a second or two.
    rig.run(2.0)
    assert rig.controller.mode is Mode.HOLDING and rig.robot.is_open, (way, rig.situation)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("has_brakes", "has_adapter"),
    [(True, False), (True, True), (False, True)],
    ids=["brakes", "brakes and adapter", "adapter"],
)
def test_every_stop_can_be_left(has_brakes, has_adapter):
    """A drive without brakes needs the adapter: otherwise the last torque stays when commands end."""
    found = walk(has_brakes, has_adapter)
    assert len(found) > 25
    modes = {situation[0] for situation in found}
    assert modes >= {Mode.WAITING, Mode.HOLDING, Mode.STOPPED} and (Mode.SILENT in modes or not has_brakes)


STALE: dict[str, Callable[[JointState], JointState | None]] = {
    "no joint states": lambda state: None,
    "no efforts": lambda state: state._replace(torque=None),
    "one effort unknown": lambda state: state._replace(torque=np.where(np.arange(ARM.n) == 3, np.nan, 0.0)),
}


CAUSES = ("controller/stop", "observer/stop", "driver/stop", "push", "no efforts", "an encoder jumps")


@pytest.mark.parametrize(
    ("has_brakes", "has_adapter", "causes"),
    [
        pytest.param(True, False, CAUSES[3:5], id="brakes, quick"),
        pytest.param(False, True, CAUSES[::5], id="adapter, quick", marks=pytest.mark.slow),
        *(pytest.param(*drive, CAUSES, marks=pytest.mark.slow) for drive in itertools.product((True, False), repeat=2)),
    ],
)
def test_no_reset_is_accepted_on_stale_evidence(has_brakes, has_adapter, causes):
    """Neither by all nodes in their order nor by the controller alone, whatever stopped the arm, pushed or not."""
    held = Rig(has_brakes, has_adapter)
    held.run(1.5)
    for event in causes:
        for seconds in (0.05, 1.5):
            stopped = held.twin()
            EVENTS[event](stopped)
            stopped.run(seconds)
            for newtons, change in ((newtons, change) for newtons in (0.0, -60.0) for change in STALE.values()):
                rig = stopped.twin()
                rig.robot.change = change
                push(rig, newtons)
                rig.run(BLIND_AFTER + 2.0 * PERIOD)
                before = rig.controller.mode
                for reset in (rig.reset, lambda rig=rig: rig._reset(CONTROLLER)):
                    with pytest.raises(InputError):
                        reset()
                    assert rig.controller.mode is before


def test_behind_brakes_the_hand_over_decides():
    """What pushes the arm cannot be seen there, whatever was seen before."""
    rig = Rig(has_brakes=True, has_adapter=False)
    rig.run(1.5)
    EVENTS["push until the brakes close"](rig)
    assert rig.robot.stop_reason and rig.controller.mode is Mode.SILENT
    push(rig, -60.0)
    rig.run(0.5)
    before = rig.robot.plant.tip_position
    rig.reset()
    assert not rig.stopped_by
    rig.run(1.0)
    assert "at hand-over the external torque on lbr_A" in rig.controller.stop_reason
    assert rig.robot.stop_reason and np.linalg.norm(rig.robot.plant.tip_position - before) < 0.05
    push(rig, 0.0)
    assert not rig.resets() and rig.controller.mode is Mode.HOLDING


def test_a_refused_reset_says_who_refuses():
    rig = Rig(has_brakes=False, has_adapter=False)
    rig.run(1.5)
    rig.stop()
    rig.run(1.0)
    push(rig, 25.0)
    rig.run(0.1)
    with pytest.raises(InputError, match=r"^observer: "):
        rig.reset()
    push(rig, 0.0)
    rig.run(0.2)
    rig.reset()
    assert rig.controller.mode is Mode.HOLDING
