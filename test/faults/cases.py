"""The fault matrix: what goes wrong, and what has to become of it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from contact_reach_ros.experiments.fault_checks import (
    SPEED_SHARE,
    TRANSIENT_FORCE,
    End,
    end_of,
    force_violations,
    speed_share,
    torque_violations,
)

REACHED, STILL = "goal reached", "arm still"
EITHER = f"{REACHED} or {STILL}"
ENDS = {
    REACHED: {End.REACHED},
    STILL: {End.STOPPED, End.HELD},
    EITHER: {End.REACHED, End.STOPPED, End.HELD},
}


@dataclass(frozen=True)
class Case:
    """One line of the matrix.

    Attributes
    ----------
    fault
        A schedule; its times count from the goal.
    end
        One of `ENDS`.
    named
        Who has to say the reason, and a pattern for it: 'observer: external torque'. Empty: nobody stops the arm.
    scene
        Its name; seed 0.
    planner
        'scripted', or 'small': the real one with a small budget.
    force
        Bound on the contact force at any time, N.
    refused
        What has to be counted as refused.
    is_pushed
        Whether something from outside moves the arm, so that its speed says nothing.
    timeout
        Time to reach the goal, s; that of the scene if 0.
    """

    fault: str
    end: str
    named: str = ""
    scene: str = "free"
    planner: str = "scripted"
    force: float = TRANSIENT_FORCE
    refused: str = ""
    is_pushed: bool = False
    timeout: float = 0.0

    @property
    def name(self) -> str:
        return f"{self.scene}, {self.planner}: {self.fault}"

    @property
    def requirement(self) -> str:
        return f"{self.end}; {self.named}" if self.named else self.end


def shortcomings(case: Case, result, limits) -> list[str]:
    """What the outcome of a case lacks."""
    found = torque_violations(result, limits) + force_violations(result)
    if end_of(result) not in ENDS[case.end]:
        found.append(f"the end is '{end_of(result).value}' at {result.end_speed:.2f} rad/s, required: {case.end}")
    if not case.is_pushed and speed_share(result) > SPEED_SHARE:
        found.append(f"a joint moved with {speed_share(result):.1f} times its limit")
    if len(result.contact_forces) and result.contact_forces.max() > case.force:
        found.append(f"the contact force is {result.contact_forces.max():.0f} N, at most {case.force:g} N")
    said = "; ".join(f"{who}: {reason}" for who, reason in result.reasons.items())
    if case.named and end_of(result) is not End.REACHED and not re.search(case.named, said):
        found.append(f"the reason is '{said}', required: {case.named}")
    if case.refused and not result.refused.get(case.refused):
        found.append(f"no {case.refused} were refused")
    return found


_WATCHDOG = "drive: no command for"
_TORQUE = "observer: (sudden )?external torque"
_NO_PLAN = "controller: no valid plan"
_NO_OBSERVER = "controller: observer silent"

_TOO_FAST = r"(controller|drive): lbr_A\d moves with"
_SLIPS = "observer: position and velocity of {} differ"
_FROZEN = "the position of {} has not changed"
_IN_THE_WAY = 'obstacle position="0.512 -0.075 0.125" radius=0.05 at=0.2'

CASES = (
    # Commands
    Case("drop_commands share=0.3 at=0.3 for=1", REACHED),
    Case("drop_commands share=0.7 at=0.3 for=1", REACHED),
    Case("drop_commands at=0.3 for=0.015", REACHED),
    Case("drop_commands at=0.3 for=0.06", REACHED),
    Case("drop_commands at=0.8 for=0.2", STILL, _WATCHDOG),
    Case("drop_commands at=0.3", STILL, _WATCHDOG),
    Case("drop_commands at=2.5", STILL, _WATCHDOG, scene="wall", force=30.0),
    Case("delay_commands delay=0.003", REACHED),
    Case("delay_commands delay=0.005 at=0.5", REACHED),
    Case("delay_commands delay=0.005", REACHED, scene="wall", force=30.0),
    Case("delay_commands delay=0.01 at=0.5", REACHED),
    Case("delay_commands delay=0.02 at=0.5", STILL, _TOO_FAST),
    Case("delay_commands delay=0.05 at=0.5", STILL, _TOO_FAST),
    Case("duplicate_commands share=0.5 after=0.01", REACHED),
    Case("duplicate_commands after=0.1", REACHED),
    Case("nan_commands share=0.5", REACHED, refused="commands"),
    Case("nan_commands at=0.5 for=0.05", REACHED, refused="commands"),
    Case("nan_commands joint=lbr_A3 at=0.5", STILL, _WATCHDOG, refused="commands"),
    # Joint states
    Case("drop_states share=0.3", REACHED),
    Case("drop_states share=0.9 at=0.5", REACHED),
    Case("drop_states at=0.5 for=0.03", REACHED),
    Case("drop_states at=0.5", STILL, _WATCHDOG),
    Case("delay_states delay=0.005", REACHED),
    Case("delay_states delay=0.01 at=0.5", REACHED),
    Case("delay_states delay=0.02 at=0.5", STILL, _TOO_FAST),
    Case("delay_states delay=0.05 at=0.5", STILL, _TOO_FAST),
    Case("duplicate_states share=0.5", REACHED, refused="old joint states"),
    Case("duplicate_states share=0.5 after=0.02 at=0.5", REACHED, refused="old joint states"),
    Case("nan_states share=0.3", REACHED, refused="joint states"),
    Case("nan_states at=0.5", STILL, _WATCHDOG, refused="joint states"),
    Case("nan_states field=velocity joint=lbr_A1 at=1", STILL, _WATCHDOG, refused="joint states"),
    Case("nan_states field=effort at=0.5", EITHER),
    Case("nan_states share=0.3 at=0.5", REACHED, scene="ball", planner="small", refused="joint states"),
    # Sensors
    Case("velocity_noise deviation=0.02", REACHED),
    Case("velocity_noise deviation=0.1", EITHER, _TORQUE),
    Case("velocity_noise deviation=0.5 at=0.5", STILL, _TORQUE),
    Case("velocity_noise deviation=2 at=0.5", STILL, _TORQUE),
    Case("stuck_encoder joint=lbr_A1 at=0.5", STILL, _FROZEN.format("lbr_A1")),
    Case("stuck_encoder joint=lbr_A2 at=0.5", STILL, _FROZEN.format("lbr_A2")),
    Case("stuck_encoder joint=lbr_A2 velocity=true at=0.5", STILL, _SLIPS.format("lbr_A2")),
    Case("stuck_encoder joint=lbr_A4 at=0.5", STILL, _FROZEN.format("lbr_A4")),
    Case("stuck_encoder joint=lbr_A4 at=1", STILL, _FROZEN.format("lbr_A4"), scene="wall"),
    Case("stuck_encoder joint=lbr_A7 at=0.5", STILL, _TOO_FAST),
    Case("stuck_encoder joint=lbr_A7 velocity=true at=0.5", STILL, f"{_SLIPS.format('lbr_A7')}|{_TOO_FAST}"),
    Case("torque_sensor gain=-1 at=0.5", STILL, _TORQUE),
    Case("torque_sensor gain=-1 joint=lbr_A2 at=2", STILL, _TORQUE, scene="wall", force=30.0),
    Case("torque_sensor gain=0 at=0.5", STILL, _TORQUE),
    Case("torque_sensor bias=3 at=0.5", REACHED),
    Case("torque_sensor bias=5 at=0.5", STILL, "observer: sudden external torque on lbr_A7"),
    Case("torque_sensor bias=40 joint=lbr_A3 at=0.5", STILL, f"{_TORQUE} on lbr_A3"),
    # Robot and surroundings
    Case("payload mass=0.5 at=0.5", REACHED),
    Case("payload mass=2 at=0.5", REACHED),
    Case("payload mass=2 at=0.5", EITHER, scene="ball", planner="small", force=40.0),
    Case("payload mass=10 at=0.5", STILL, _TORQUE),
    Case("friction factor=3 at=0.5", REACHED),
    Case("friction factor=14 at=0.5", REACHED),
    Case("friction factor=20 at=0.5", REACHED, timeout=20.0),
    Case("friction factor=50 at=0.5", STILL, "observer: sudden external torque"),
    Case("foam factor=2", REACHED, scene="ball", force=20.0),
    Case("foam factor=5", REACHED, scene="ball", planner="small", force=60.0),
    Case("foam factor=3 at=1", REACHED, scene="wall", force=60.0),
    Case("foam factor=5 at=1", EITHER, _TORQUE, scene="wall", force=140.0),
    Case(f"{_IN_THE_WAY} stiffness=1000", STILL, _TORQUE, force=140.0),
    Case(f"{_IN_THE_WAY} stiffness=5000", STILL, _TORQUE, force=140.0),
    Case(f"{_IN_THE_WAY} stiffness=50000", STILL, _TORQUE),
    Case(f"{_IN_THE_WAY} stiffness=5000", EITHER, _TORQUE, scene="ball", planner="small", force=140.0),
    Case('push link=lbr_link_4 force="0 50 0" at=0.5 for=0.1', EITHER, _TORQUE, is_pushed=True),
    Case('push link=lbr_link_4 force="0 200 0" at=0.5 for=0.1', STILL, _TORQUE, is_pushed=True),
    Case('push link=lbr_link_7 force="0 0 -30" at=0.5 for=0.5', EITHER, _TORQUE, is_pushed=True),
    Case('push link=lbr_link_7 force="0 100 0" at=0.5 for=0.5', STILL, _TORQUE, is_pushed=True),
    Case('push link=lbr_link_5 force="0 0 80" at=2 for=0.2', STILL, _TORQUE, scene="wall", is_pushed=True),
    # Clock
    Case("clock_jump step=-0.01 at=0.5", REACHED),
    Case("clock_jump step=1 at=0.5", REACHED),
    Case("clock_jump step=-1 at=0.5", EITHER, _NO_PLAN),
    Case("clock_jump step=10 at=0.5 for=0.5", EITHER, _NO_PLAN),
    Case("clock_jump step=-1 at=2", EITHER, _NO_PLAN, scene="wall", force=30.0),
    Case("clock_jump step=1 at=0.5", REACHED, scene="ball", planner="small"),
    # Other nodes
    Case("planner_silent at=0.5", STILL, _NO_PLAN),
    Case("planner_silent at=2.5", STILL, _NO_PLAN, scene="wall", force=30.0),
    Case("planner_silent at=0.5 for=0.2", REACHED),
    Case("planner_silent at=0.5 for=0.6", REACHED),
    Case("observer_silent at=0.5", STILL, _NO_OBSERVER),
    Case("observer_silent at=0.5 for=0.03", REACHED),
    Case("observer_silent at=2.5", STILL, _NO_OBSERVER, scene="wall", force=30.0),
    Case("controller_silent at=0.5", STILL, _WATCHDOG),
    Case("controller_silent at=0.5 for=0.015", REACHED),
    Case("controller_silent at=0.5 for=0.06", REACHED),
    Case("controller_silent at=0.5 for=0.3", STILL, _WATCHDOG),
    Case("late_plans delay=0.05", REACHED),
    Case("late_plans delay=0.2 at=0.5", REACHED),
    Case("late_plans delay=0.5 at=0.5", STILL, _NO_PLAN, refused="plans"),
    Case("late_plans delay=0.1 at=0.5", REACHED, scene="ball", planner="small", timeout=8.0),
    # Together
    Case(f"{_IN_THE_WAY}; observer_silent at=0.9", STILL, f"{_NO_OBSERVER}|{_TORQUE}"),
    Case(f"{_IN_THE_WAY}; drop_states share=0.3", STILL, _TORQUE),
)
