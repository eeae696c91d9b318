"""The fault matrix: what goes wrong, and what has to become of it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from arm_simulation import ARM

from benchmarks.fault_checks import TRANSIENT_FORCE, End, bounds_used, end_of, violations
from contact_reach_ros.simulation.fault_schedules import parse_faults

REACHED, STILL = "goal reached", "arm still"
ENDS = {REACHED: {End.REACHED}, STILL: {End.STOPPED, End.HELD}}


@dataclass(frozen=True)
class Case:
    """One line of the matrix.

    Attributes
    ----------
    fault
        A schedule; its times count from the goal, which is given at the very start if the case is `from_start`.
    end
        One of `ENDS`.
    named
        Who has to say the reason, and a pattern for it: 'observer: external torque'. Empty: nobody stops the arm.
    scene
        'table', that is `free` with a table under the goal, or the name of a scene; seed 0.
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

    fault: str
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
    def happening(self) -> str:
        return f"from the start: {self.fault}" if self.from_start else self.fault

    @property
    def name(self) -> str:
        return f"{self.scene}, {self.planner}, {self.rate} Hz: {self.happening}"

    @property
    def requirement(self) -> str:
        return f"{self.end}; {self.named}" if self.named else self.end


def shortcomings(case: Case, result, limits) -> list[str]:
    """What the outcome of a case lacks."""
    found = violations(bounds_used(result, limits, ARM, parse_faults(case.fault, ARM)))
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
_TORQUE = "observer: (sudden )?external torque"
_NO_PLAN = "controller: no valid plan"
_NO_OBSERVER = "controller: observer silent"

_TOO_FAST = r"(controller|drive): lbr_A\d moves with"
_SLIPS = "observer: position and velocity of {} differ"
_BLIND = "controller: blind: "
_FROZEN = "the position of {} has not changed"
_STUCK_TORQUE = "observer: the torque of {} has been"
_IN_THE_WAY = 'obstacle position="0.512 -0.075 0.125" radius=0.05 at=0.2'

CASES = (
    # Commands
    Case("drop_commands share=0.3 at=0.3 for=1", REACHED),
    Case("drop_commands share=0.7 at=0.3 for=1", REACHED),
    Case("drop_commands at=0.3 for=0.015", REACHED),
    Case("drop_commands at=0.3 for=0.06", REACHED),
    Case("drop_commands at=0.8 for=0.2", STILL, _WATCHDOG, planner="small"),
    Case("drop_commands at=0.3", STILL, _WATCHDOG, planner="small"),
    Case("drop_commands at=0.5", STILL, _WATCHDOG, planner="small", rate=200),
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
    Case("nan_commands joint=lbr_A3 at=0.5", STILL, _WATCHDOG, planner="small", refused="commands"),
    # Joint states
    Case("drop_states share=0.3", REACHED),
    Case("drop_states share=0.1", REACHED, scene="ball", planner="small", rate=500),
    Case("drop_states share=0.1", REACHED, planner="small", rate=200),
    Case("drop_states share=0.9 at=0.5", STILL, _BLIND, planner="small"),
    Case("drop_states at=0.5 for=0.03", REACHED),
    Case("drop_states at=0.5", STILL, _WATCHDOG, planner="small"),
    Case("drop_states at=0.5 for=0.2", STILL, _WATCHDOG, planner="small"),
    Case("delay_states delay=0.005", REACHED),
    Case("delay_states delay=0.004", REACHED, planner="small", rate=500),
    Case("delay_states delay=0.01 at=0.5", REACHED),
    Case("delay_states delay=0.02 at=0.5", STILL, _TOO_FAST),
    Case("delay_states delay=0.05 at=0.5", STILL, _TOO_FAST),
    Case("duplicate_states share=0.5", REACHED, refused="old joint states"),
    Case("duplicate_states share=0.5 after=0.02 at=0.5", REACHED, refused="old joint states"),
    Case("nan_states share=0.3", REACHED, refused="joint states"),
    Case("nan_states at=0.5", STILL, _WATCHDOG, planner="small", refused="joint states"),
    Case("nan_states field=velocity joint=lbr_A1 at=1", STILL, _WATCHDOG, planner="small", refused="joint states"),
    Case("nan_states share=0.3 at=0.5", REACHED, scene="ball", planner="small", refused="joint states"),
    Case("nan_states share=0.1 at=0.5", REACHED, scene="ball", planner="small", refused="joint states", rate=200),
    # Efforts
    Case("nan_states field=effort at=0.5", STILL, _BLIND, planner="small"),
    Case("nan_states field=effort at=0.5 for=0.05", REACHED, planner="small", rate=500),
    Case("nan_states field=effort joint=lbr_A3 at=0.5", STILL, _BLIND, planner="small"),
    Case("nan_states field=effort joint=lbr_A3", STILL, _BLIND, planner="small", from_start=True, timeout=2.0),
    Case("no_effort at=0.5", STILL, _BLIND, planner="small"),
    Case("no_effort at=0.5", STILL, _BLIND, planner="small", rate=200),
    Case("no_effort share=0.05", REACHED, planner="small", rate=500),
    Case("no_effort", STILL, _BLIND, planner="small", from_start=True, timeout=2.0),
    # Pauses
    Case("pause at=0.8 for=0.2", REACHED, planner="small", timeout=8.0),
    Case("pause at=0.8 for=1", REACHED, planner="small", timeout=8.0),
    Case("pause at=0.8 for=1", REACHED, scene="ball", planner="small", timeout=8.0, rate=200),
    Case("pause at=0.8 for=2.5", STILL, planner="small", timeout=5.0),
    # Sensors
    Case("velocity_noise deviation=0.02", REACHED),
    Case("velocity_noise deviation=0.15", STILL, _TORQUE, planner="small"),
    Case("velocity_noise deviation=0.5 at=0.5", STILL, _TORQUE, planner="small"),
    Case("velocity_noise deviation=2 at=0.5", STILL, _TORQUE, planner="small"),
    Case("stuck_encoder joint=lbr_A1 at=0.5", STILL, _FROZEN.format("lbr_A1")),
    Case("stuck_encoder joint=lbr_A2 at=0.5", STILL, _FROZEN.format("lbr_A2"), planner="small"),
    Case("stuck_encoder joint=lbr_A2 at=0.5", STILL, _FROZEN.format("lbr_A2"), planner="small", rate=200),
    Case("stuck_encoder joint=lbr_A2 velocity=true at=0.5", STILL, _SLIPS.format("lbr_A2"), planner="small"),
    Case("stuck_encoder joint=lbr_A4 at=0.5", STILL, _FROZEN.format("lbr_A4"), planner="small"),
    Case("stuck_encoder joint=lbr_A4 at=1", STILL, _FROZEN.format("lbr_A4"), scene="wall"),
    Case("stuck_encoder joint=lbr_A7 at=0.5", STILL, _TOO_FAST),
    Case(
        "stuck_encoder joint=lbr_A7 velocity=true at=0.5",
        STILL,
        f"{_SLIPS.format('lbr_A7')}|{_TOO_FAST}",
    ),
    Case("torque_sensor gain=-1 at=0.5", STILL, _TORQUE, planner="small"),
    Case("torque_sensor gain=-1 at=0.5", STILL, _TORQUE, planner="small", rate=200),
    Case("torque_sensor gain=-1 joint=lbr_A2 at=2", STILL, _TORQUE, scene="wall", force=30.0),
    Case("torque_sensor gain=0 at=0.5", STILL, _TORQUE, planner="small"),
    Case("torque_sensor gain=0 joint=lbr_A1 at=0.5", STILL, _STUCK_TORQUE.format("lbr_A1"), planner="small"),
    Case("torque_sensor gain=0 joint=lbr_A1 at=0.5", STILL, _STUCK_TORQUE.format("lbr_A1"), planner="small", rate=200),
    Case("torque_sensor bias=3 at=0.5", REACHED),
    Case("torque_sensor bias=5 at=0.5", STILL, "observer: sudden external torque on lbr_A7", planner="small"),
    Case("torque_sensor bias=40 joint=lbr_A3 at=0.5", STILL, f"{_TORQUE} on lbr_A3", planner="small"),
    # Robot and surroundings
    Case("payload mass=0.5 at=0.5", REACHED),
    Case("payload mass=2 at=0.5", REACHED),
    Case("payload mass=4 at=0.5", STILL, _TORQUE, scene="ball", planner="small", force=40.0),
    Case("payload mass=10 at=0.5", STILL, _TORQUE, planner="small"),
    Case("friction factor=3 at=0.5", REACHED),
    Case("friction factor=14 at=0.5", STILL, planner="small"),
    Case("friction factor=20 at=0.5", STILL, planner="small"),
    Case("friction factor=50 at=0.5", STILL, "observer: sudden external torque"),
    Case("foam factor=2", REACHED, scene="ball", force=20.0),
    Case("foam factor=5", REACHED, scene="ball", planner="small", force=60.0),
    Case("foam factor=3 at=1", REACHED, scene="wall", force=60.0),
    Case("foam factor=5 at=1", REACHED, scene="wall", force=140.0),
    Case(f"{_IN_THE_WAY} stiffness=1000", STILL, _TORQUE, force=140.0),
    Case(f"{_IN_THE_WAY} stiffness=5000", STILL, _TORQUE, force=140.0),
    Case(f"{_IN_THE_WAY} stiffness=5000", STILL, _TORQUE, force=140.0, rate=500),
    Case(f"{_IN_THE_WAY} stiffness=5000", STILL, _TORQUE, force=140.0, rate=200),
    Case(f"{_IN_THE_WAY} stiffness=50000", STILL, _TORQUE),
    Case(f"{_IN_THE_WAY} stiffness=20000", STILL, _TORQUE, scene="ball", planner="small", force=140.0),
    Case('push link=lbr_link_4 force="0 30 0" at=0.5 for=0.1', REACHED),
    Case('push link=lbr_link_4 force="0 80 0" at=0.5 for=0.1', STILL, _TORQUE, planner="small"),
    Case('push link=lbr_link_4 force="0 80 0" at=0.5 for=0.1', STILL, _TORQUE, planner="small", rate=200),
    Case('push link=lbr_link_4 force="0 200 0" at=0.5 for=0.1', STILL, _TORQUE, planner="small"),
    Case('push link=lbr_link_7 force="0 0 -15" at=0.5 for=0.5', REACHED),
    Case('push link=lbr_link_7 force="0 0 -50" at=0.5 for=0.5', STILL, _TORQUE, planner="small"),
    Case('push link=lbr_link_7 force="0 100 0" at=0.5 for=0.5', STILL, _TORQUE, planner="small"),
    Case('push link=lbr_link_5 force="0 0 80" at=2 for=0.2', STILL, _TORQUE, scene="wall"),
    # What is seen of the obstacles
    Case("drop_obstacles share=0.8", REACHED, scene="ball", planner="small"),
    Case("drop_obstacles at=0.5 for=0.4", REACHED, scene="ball", planner="small"),
    Case("drop_obstacles at=0.2 for=0.7", REACHED, scene="ball", planner="small", refused="plans"),
    Case("drop_obstacles at=0.2", STILL, _NO_PLAN, scene="ball", planner="small", refused="plans", timeout=9.0),
    Case("drop_obstacles at=0.2", STILL, _NO_PLAN, scene="ball", refused="plans", timeout=9.0, rate=200),
    Case("drop_obstacles at=1.5", STILL, _NO_PLAN, scene="wall", force=30.0, refused="plans", timeout=9.0),
    Case("drop_obstacles at=0.2", STILL, _NO_PLAN, refused="plans", timeout=9.0),
    Case(
        "clock_jump step=1 at=0.5; drop_obstacles at=0.6", STILL, _NO_PLAN, scene="ball", refused="plans", timeout=9.0
    ),
    # Clock
    Case("clock_jump step=-0.01 at=0.5", REACHED),
    Case("clock_jump step=1 at=0.5", REACHED, planner="small"),
    Case("clock_jump step=-1 at=0.5", REACHED),
    Case("clock_jump step=10 at=0.5 for=0.5", STILL, _NO_PLAN, timeout=9.0),
    Case("clock_jump step=-1 at=2", REACHED, scene="wall", force=30.0, timeout=9.0),
    Case("clock_jump step=1 at=0.5", REACHED, scene="ball", planner="small"),
    Case("frozen_clock at=0.5", STILL, f"{_BLIND}the stamps", planner="small"),
    Case("frozen_clock at=0.5 for=0.01", REACHED, planner="small", rate=500),
    # Other nodes
    Case("planner_silent at=0.5", STILL, _NO_PLAN, planner="small", timeout=9.0),
    Case("planner_silent at=2.5", STILL, _NO_PLAN, timeout=9.0, scene="wall", force=30.0),
    Case("planner_silent at=0.5 for=0.2", REACHED),
    Case("planner_silent at=0.5 for=0.6", REACHED, planner="small", timeout=8.0),
    Case("observer_silent at=0.5", STILL, _NO_OBSERVER, planner="small"),
    Case("observer_silent at=0.5", STILL, _NO_OBSERVER, planner="small", rate=200),
    Case(
        "observer_silent",
        STILL,
        "controller: nothing heard from the observer",
        planner="small",
        from_start=True,
        timeout=2.0,
    ),
    Case("observer_silent at=0.5 for=0.03", REACHED),
    Case("observer_silent at=2.5", STILL, _NO_OBSERVER, scene="wall", force=30.0),
    Case("observer_silent at=1.5", STILL, _NO_OBSERVER, scene="table", planner="small"),
    Case("controller_silent at=0.5", STILL, _WATCHDOG, planner="small"),
    Case("controller_silent at=0.5 for=0.015", REACHED),
    Case("controller_silent at=0.5 for=0.06", REACHED),
    Case("controller_silent at=0.5 for=0.3", STILL, _WATCHDOG, planner="small"),
    Case("late_plans delay=0.05", REACHED),
    Case("late_plans delay=0.2 at=0.5", REACHED),
    Case("late_plans delay=0.5 at=0.5", STILL, _NO_PLAN, refused="plans", timeout=9.0),
    Case("late_plans delay=0.1 at=0.5", REACHED, scene="ball", planner="small", timeout=8.0),
    Case("late_plans delay=0.1 at=0.5", REACHED, scene="table", planner="small", timeout=8.0, rate=500),
    Case('false_plans offset="0 0 0.2" at=0.5', STILL, _NO_PLAN, planner="small", timeout=9.0, rate=200),
    Case('false_plans offset="0 0 -0.04" at=0.5', STILL, _NO_PLAN, scene="table", timeout=9.0, rate=200),
    Case("false_plans stretch=20 at=0.5", STILL, _NO_PLAN, planner="small", refused="plans", timeout=9.0, rate=200),
    Case("other_gains at=0.5", STILL, _NO_PLAN, planner="small", refused="plans", timeout=9.0, rate=200),
    # Second publishers
    Case("foreign_commands at=0.5", STILL, planner="small"),
    Case("foreign_commands torque=30 at=0.5", STILL, planner="small", rate=500),
    Case("foreign_commands at=0.5 for=0.005", REACHED, planner="small", rate=500),
    Case("foreign_states at=0.5", STILL, "observer: position and velocity of", planner="small"),
    Case("foreign_states offset=0.05 at=0.5", STILL, "observer: position and velocity of", planner="small", rate=200),
    # Together
    Case(f"{_IN_THE_WAY}; observer_silent at=0.9", STILL, f"{_NO_OBSERVER}|{_TORQUE}"),
    Case(f"{_IN_THE_WAY}; drop_states share=0.3", STILL, _TORQUE),
)
