"""The fault matrix: faults, and how an episode with them has to end."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields

from arm_simulation import ARM

from benchmarks.episode import Silent, WrongPlans
from benchmarks.fault_checks import TRANSIENT_FORCE, End, bounds_used, end_of, violations
from benchmarks.faulty_robot import (
    Fault,
    Friction,
    Late,
    Lost,
    NotFinite,
    Payload,
    Push,
    RivalCommands,
    StuckEncoder,
    TorqueSensor,
    UnknownObstacle,
    VelocityNoise,
    WrongClock,
)

KINDS = (
    *(Lost, Late, NotFinite, VelocityNoise, StuckEncoder, TorqueSensor, WrongClock, RivalCommands),
    *(Payload, Friction, UnknownObstacle, Push, Silent, WrongPlans),
)

REACHED, STILL = "goal reached", "arm still"
ENDS = {REACHED: {End.REACHED}, STILL: {End.STOPPED, End.HELD}}


@dataclass(frozen=True)
class Case:
    """One line of the matrix.

    Attributes
    ----------
    faults
        Their times count from the goal, which is given at the very start if the case is `from_start`.
    end
        One of `ENDS`.
    named
        Who has to say the reason, and a pattern for it: 'observer: external torque'. Empty: nobody stops the arm.
    scene
        'table', that is `free` with a table under the goal, 'stiff ball' or 'stiff wall' with five times the stiffness,
        or the name of a scene; seed 0.
    planner
        'scripted', or 'small': the real one with a small budget.
    force
        Bound on the contact force at any time, N.
    refused
        What has to be counted as refused.
    timeout
        Time to reach the goal, s; that of the scene if 0.
    rate
        Of the joint states, Hz.
    from_start
        Whether there is no time for the arm to be handed over before the faults begin.
    """

    faults: Sequence[Fault]
    end: str
    named: str = ""
    scene: str = "free"
    planner: str = "scripted"
    force: float = TRANSIENT_FORCE
    refused: str = ""
    timeout: float = 0.0
    rate: int = 1000
    from_start: bool = False

    @property
    def name(self) -> str:
        start = "from the start: " if self.from_start else ""
        return f"{self.scene}, {self.planner}, {self.rate} Hz: {start}{'; '.join(map(label, self.faults))}"


def label(fault: Fault) -> str:
    """The fault without the values that have their defaults."""
    words = [type(fault).__name__]
    for each in fields(fault):
        value = getattr(fault, each.name)
        if each.init and (each.default is MISSING or value != each.default):
            words.append(f"{each.name}={value}")
    return " ".join(words)


def shortcomings(case: Case, result, limits) -> list[str]:
    """What the outcome of a case lacks."""
    found = violations(bounds_used(result, limits, ARM, case.faults))
    if end_of(result) not in ENDS[case.end]:
        found.append(f"the end is '{end_of(result).value}' at {result.end_speed:.2f} rad/s, required: {case.end}")
    if len(result.contact_forces) and result.contact_forces.max() > case.force:
        found.append(f"the contact force is {result.contact_forces.max():.0f} N, at most {case.force:g} N")
    said = "; ".join(f"{who}: {reason}" for who, reason in result.reasons.items())
    if case.named and not re.search(case.named, said):
        found.append(f"the reason is '{said}', required: {case.named}")
    if case.refused and not result.refused.get(case.refused):
        found.append(f"no {case.refused} were refused")
    return found


_WATCHDOG = "drive: no command for"
_TORQUE = "observer: (at hand-over )?(sudden )?external torque"
_NO_PLAN = "controller: no valid plan"
_NO_OBSERVER = "controller: observer silent"

_TOO_FAST = r"(controller|drive): lbr_A\d moves with"
_SLIPS = "observer: position and velocity of {} differ"
_BLIND = "controller: blind: "
_FROZEN = "the position of {} has not changed"
_STUCK_TORQUE = "observer: the torque of {} has been"


def _in_the_way(stiffness: float = 5000.0) -> UnknownObstacle:
    """A sphere on the way of the hand."""
    return UnknownObstacle((0.512, -0.075, 0.125), stiffness=stiffness, at=0.2)


CASES = (
    # Commands
    Case([Lost("commands", share=0.3, at=0.3, duration=1.0)], REACHED),
    Case([Lost("commands", at=0.3, duration=0.06)], REACHED),
    Case([Lost("commands", at=0.5)], STILL, _WATCHDOG, planner="small", rate=200),
    Case([Late("commands", 0.005)], REACHED, scene="wall", force=30.0),
    Case([Late("commands", 0.05, at=0.5)], STILL, _TOO_FAST),
    Case([NotFinite("commands", at=0.5, duration=0.05)], REACHED, refused="commands"),
    Case([NotFinite("commands", "effort", "lbr_A3", at=0.5)], STILL, _WATCHDOG, planner="small", refused="commands"),
    # Joint states
    Case([Lost("states", share=0.1)], REACHED, scene="ball", planner="small", rate=500),
    Case([Lost("states", share=0.9, at=0.5)], STILL, _BLIND, planner="small"),
    Case([Lost("states", at=0.5, duration=0.03)], REACHED),
    Case([Lost("states", at=0.5)], STILL, _WATCHDOG, planner="small"),
    Case([Late("states", 0.01, at=0.5)], REACHED),
    Case([Late("states", 0.05, at=0.5)], STILL, _TOO_FAST),
    Case([NotFinite("states", "position", at=0.5)], STILL, _WATCHDOG, planner="small", refused="joint states"),
    Case(
        [NotFinite("states", "position", share=0.3, at=0.5)],
        REACHED,
        scene="ball",
        planner="small",
        refused="joint states",
    ),
    # Efforts
    Case([NotFinite("states", at=0.5)], STILL, _BLIND, planner="small"),
    Case([NotFinite("states", at=0.5, duration=0.05)], REACHED, planner="small", rate=500),
    Case([NotFinite("states", "effort", "lbr_A3")], STILL, _BLIND, planner="small", from_start=True, timeout=2.0),
    Case([Lost("efforts", at=0.5)], STILL, _BLIND, planner="small", rate=200),
    Case([Lost("efforts", share=0.05)], REACHED, planner="small", rate=500),
    # Pauses
    Case([Silent("driver", at=0.8, duration=1.0)], REACHED, scene="ball", planner="small", timeout=8.0, rate=200),
    Case([Silent("driver", at=0.8, duration=2.5)], STILL, planner="small", timeout=5.0),
    # Sensors
    Case([VelocityNoise(deviation=0.02)], REACHED),
    Case([VelocityNoise(deviation=0.15)], STILL, _TORQUE, planner="small"),
    Case([StuckEncoder("lbr_A2", at=0.5)], STILL, _FROZEN.format("lbr_A2"), planner="small", rate=200),
    Case([StuckEncoder("lbr_A2", own_velocity=True, at=0.5)], STILL, _SLIPS.format("lbr_A2"), planner="small"),
    Case([StuckEncoder("lbr_A4", at=1.0)], STILL, _FROZEN.format("lbr_A4"), scene="wall"),
    Case([StuckEncoder("lbr_A7", at=0.5)], STILL, _TOO_FAST),
    Case(
        [StuckEncoder("lbr_A7", own_velocity=True, at=0.5)],
        STILL,
        f"{_SLIPS.format('lbr_A7')}|{_TOO_FAST}",
    ),
    Case([TorqueSensor(gain=-1.0, at=0.5)], STILL, _TORQUE, planner="small", rate=200),
    Case([TorqueSensor(gain=0.0, at=0.5)], STILL, _TORQUE, planner="small"),
    Case([TorqueSensor("lbr_A1", gain=0.0, at=0.5)], STILL, _STUCK_TORQUE.format("lbr_A1"), planner="small", rate=200),
    Case([TorqueSensor(bias=3.0, at=0.5)], REACHED),
    Case([TorqueSensor(bias=5.0, at=0.5)], STILL, "observer: sudden external torque on lbr_A7", planner="small"),
    # Robot and surroundings
    Case([Payload(2.0, at=0.5)], REACHED),
    Case([Payload(4.0, at=0.5)], STILL, _TORQUE, scene="ball", planner="small", force=40.0),
    Case([Friction(3.0, at=0.5)], REACHED),
    Case([Friction(14.0, at=0.5)], STILL, planner="small"),
    Case([Friction(50.0, at=0.5)], STILL, "observer: sudden external torque"),
    Case([_in_the_way()], STILL, force=140.0, rate=500),
    Case([_in_the_way(50000.0)], STILL, _TORQUE),
    Case([Push("lbr_link_4", (0.0, 30.0, 0.0), at=0.5, duration=0.1)], REACHED),
    Case([Push("lbr_link_4", (0.0, 200.0, 0.0), at=0.5, duration=0.1)], STILL, _TORQUE, planner="small"),
    Case([Push("lbr_link_7", (0.0, 0.0, -15.0), at=0.5, duration=0.5)], REACHED),
    Case([Push("lbr_link_5", (0.0, 0.0, 80.0), at=2.0, duration=0.2)], STILL, _TORQUE, scene="wall"),
    Case([], REACHED, scene="stiff ball", planner="small", force=60.0),
    Case([], REACHED, scene="stiff wall", force=140.0),
    # Observations of the obstacles
    Case([Lost("obstacles", share=0.8)], REACHED, scene="ball", planner="small"),
    Case([Lost("obstacles", at=0.2, duration=0.7)], REACHED, scene="ball", planner="small", refused="plans"),
    Case([Lost("obstacles", at=0.2)], STILL, _NO_PLAN, scene="ball", planner="small", refused="plans", timeout=9.0),
    Case(
        [WrongClock(step=-1.0, at=0.5), Lost("obstacles", at=0.6)],
        STILL,
        _NO_PLAN,
        scene="ball",
        refused="plans",
        timeout=9.0,
    ),
    # Clock
    Case([WrongClock(step=-1.0, at=0.5)], REACHED),
    Case([WrongClock(step=10.0, at=0.5, duration=0.5)], STILL, _BLIND),
    Case([WrongClock(step=0.05, at=0.5)], REACHED, scene="ball", planner="small"),
    Case([WrongClock(step=1.0, at=0.5)], STILL, _BLIND, scene="ball", planner="small"),
    Case([WrongClock(at=0.5)], STILL, f"{_BLIND}the stamps", planner="small"),
    Case([WrongClock(at=0.5, duration=0.01)], REACHED, planner="small", rate=500),
    # Other nodes
    Case([Silent("planner", at=0.5)], STILL, _NO_PLAN, planner="small", timeout=9.0),
    Case([Silent("planner", at=0.5, duration=0.6)], REACHED, planner="small", timeout=8.0),
    Case([Silent("observer", at=0.5)], STILL, _NO_OBSERVER, planner="small", rate=200),
    Case(
        [Silent("observer")],
        STILL,
        "controller: nothing heard from the observer",
        planner="small",
        from_start=True,
        timeout=2.0,
    ),
    Case([Silent("observer", at=0.5, duration=0.03)], REACHED),
    Case([Silent("controller", at=0.5)], STILL, _WATCHDOG, planner="small"),
    Case([Silent("controller", at=0.5, duration=0.06)], REACHED),
    Case([WrongPlans(delay=0.5, at=0.5)], STILL, _NO_PLAN, refused="plans", timeout=9.0),
    Case([WrongPlans(delay=0.1, at=0.5)], REACHED, scene="table", planner="small", timeout=8.0, rate=500),
    Case([WrongPlans(offset=(0.0, 0.0, 0.2), at=0.5)], STILL, _NO_PLAN, planner="small", timeout=9.0, rate=200),
    Case([WrongPlans(offset=(0.0, 0.0, -0.04), at=0.5)], STILL, _NO_PLAN, scene="table", timeout=9.0, rate=200),
    Case([WrongPlans(stretch=20.0, at=0.5)], STILL, _NO_PLAN, planner="small", refused="plans", timeout=9.0, rate=200),
    # Second publishers
    Case([RivalCommands(30.0, at=0.5)], STILL, planner="small", rate=500),
    Case([RivalCommands(at=0.5, duration=0.005)], REACHED, planner="small", rate=500),
    # Together
    Case([_in_the_way(), Silent("observer", at=0.9)], STILL, f"{_NO_OBSERVER}|{_TORQUE}"),
    Case([_in_the_way(), Lost("states", share=0.3)], STILL, _TORQUE),
)
