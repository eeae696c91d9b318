"""Whether the joint states of an arm are what the stack expects: names, rate, clock, and torques that fit the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.doctor.findings import Finding, failed, passed, warned
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

RATE = 1000.0
"""Of joint states, Hz."""

_TICK_NS = NANOSECONDS / RATE
_GOOD_SHARE, _BAD_SHARE = 0.01, 0.1
_LONG_GAP_NS = 20e6
"""Silence at which the driver's watchdog holds the arm, ns."""
_GOOD_SKEW_MS, _BAD_SKEW_MS = 10.0, 100.0
_REST_SPEED = 0.01
_REST_TRAVEL = 0.002
_GOOD_RESIDUAL = 2.0
_BAD_SHARE_OF_THRESHOLD = 0.5
_SMALL_TORQUE = 1.0

_MISSING = "remap the driver's topic to joint_states, or start the driver"


@dataclass(frozen=True)
class JointRecord:
    """Joint states that were heard for a while, in the order of their arrival.

    Attributes
    ----------
    names
        The different lists of joint names that came.
    stamps_ns, received_ns
        (n,) header.stamp, and arrival on the clock of this machine.
    position, velocity, effort
        (n, 7) in the arm's order, rad, rad/s and N m; NaN where a message had none.
    """

    names: Sequence[tuple[str, ...]]
    stamps_ns: Stamps
    received_ns: Stamps
    position: Array
    velocity: Array
    effort: Array


def joint_names(record: JointRecord, command_order: Sequence[str] | None = None) -> Finding:
    """Names and order of the joints.

    Parameters
    ----------
    record
        What was heard.
    command_order
        Parameter `joints` of a controller of ros2_control that takes the commands; None if there is no such thing.
    """
    name, wanted = "joint names and order", iiwa14.JOINT_NAMES
    ordered = f"[{', '.join(wanted)}]"
    fix_order = (
        f"set the driver's joint order (parameter joints of effort_controller in ros2_control) to {ordered}: commands "
        "carry no names, a torque in another order goes to another joint"
    )
    if command_order is not None and tuple(command_order) != wanted:
        return failed(name, f"effort_controller takes commands in the order {', '.join(command_order)}", fix_order)
    for names in record.names:
        missing = [joint for joint in wanted if joint not in names]
        if missing:
            fix = f"let the driver publish all of {ordered}, by its joint-name or prefix parameter"
            return failed(name, f"joint_states lacks {', '.join(missing)}; it has {', '.join(names) or 'none'}", fix)
    strange = [names for names in record.names if tuple(joint for joint in names if joint in wanted) != wanted]
    if strange and command_order is None:
        return failed(name, f"joint_states come in the order {', '.join(strange[0])}", fix_order)
    others = sorted({joint for names in record.names for joint in names} - set(wanted))
    found = ", ".join(wanted) + (f", and {', '.join(others)}, which are ignored" if others else "")
    return passed(name, found if not strange else f"{found}; states in another order are read by name")


def driver_rate(record: JointRecord, simulated_time: bool) -> Finding:
    """Rate of the joint states, and how regular their stamps are."""
    name, count = "driver rate", len(record.stamps_ns)
    if count < 2:
        fix = f"{_MISSING}; see the driver's log and its lifecycle state"
        return failed(name, f"{count} joint states in the time that was listened", fix)
    span_ns = float(record.received_ns[-1] - record.received_ns[0])
    rate = (count - 1) * NANOSECONDS / span_ns if span_ns > 0 else float("inf")
    steps = np.diff(record.stamps_ns).astype(float)
    jitter_us, gap_us = float(steps.std()) / 1000, float(steps.max()) / 1000
    values = {"rate_hz": rate, "stamp_jitter_us": jitter_us, "longest_gap_us": gap_us}
    backwards = int((steps < 0).sum())
    if backwards:
        fix = "end the second publisher of joint_states, or let the driver stamp with one clock that never goes back"
        return failed(name, f"{backwards} of {count} stamps are older than the one before", fix, **values)
    if simulated_time:
        found = (
            f"lockstep: a state every {np.median(steps) / 1e6:g} ms of simulated time, {rate:.0f} a second of real time"
        )
        if np.median(steps) == _TICK_NS:
            return passed(name, found, **values)
        return failed(name, found, f"let the simulation publish every {_TICK_NS / 1e6:g} ms", **values)
    found = f"{rate:.0f} Hz, stamps vary by {jitter_us:.0f} us, longest gap {gap_us / 1000:.1f} ms"
    off = abs(rate - RATE) / RATE
    fix = f"set the driver to {RATE:.0f} Hz; if it is, permit real-time priority and end what else computes"
    if off > _BAD_SHARE:
        return failed(name, found, fix, **values)
    if off > _GOOD_SHARE or steps.max() > _LONG_GAP_NS:
        return warned(name, found, fix, **values)
    return passed(name, found, **values)


def clock_skew(record: JointRecord, clock_ns: Stamps | None) -> Finding:
    """How far the driver's clock is from this machine's, or from /clock.

    Parameters
    ----------
    record
        What was heard.
    clock_ns
        (n,) value of /clock at the arrival of each state; None in real time.
    """
    name = "clocks"
    if not len(record.stamps_ns):
        return failed(name, "no joint states to read a clock from", _MISSING)
    now = record.received_ns if clock_ns is None else clock_ns
    # Messages are late, clocks are not: the least delay is the best guess.
    late_ms = (now - record.stamps_ns) / 1e6
    skew = float(late_ms.min() if late_ms.min() > 0 else np.median(late_ms))
    of = "this machine's clock" if clock_ns is None else "/clock"
    found = f"joint states are stamped {abs(skew):.1f} ms {'before' if skew >= 0 else 'after'} {of}"
    fix = (
        "synchronise the computers' clocks (chrony, or PTP for a robot), or stamp with the system clock in the driver; "
        "the simulated driver falls behind for good when it is held up for more than 20 ms: start it again"
        if clock_ns is None
        else "let the simulation stamp joint states with the time that it publishes on /clock"
    )
    if abs(skew) > _BAD_SKEW_MS:
        return failed(name, found, fix, skew_ms=skew)
    if abs(skew) > _GOOD_SKEW_MS:
        return warned(name, found, fix, skew_ms=skew)
    return passed(name, found, skew_ms=skew)


def gravity(record: JointRecord, model: RobotModel, budget: ContactBudget) -> Finding:
    """Measured torque of the arm at rest against the model's g(q), joint by joint.

    What is left over counts against the contact budget before anything is touched.
    """
    name = "gravity against torque"
    again = "run doctor again when the brakes are open and the arm is at rest (no goal)"
    known: NDArray[np.bool_] = np.isfinite(record.effort.sum(axis=1))
    if not len(known) or not known[-1]:
        found = "the effort of joint_states is NaN or missing: the brakes are closed, or the driver measures no torque"
        fix = f"{again}; if the driver measures none, set the observer's torque_source: commanded"
        return warned(name, f"not compared: {found}", fix)
    q, v, effort = record.position[known], record.velocity[known], record.effort[known]
    if np.abs(v.mean(axis=0)).max() > _REST_SPEED or np.ptp(q, axis=0).max() > _REST_TRAVEL:
        return warned(name, "not compared: the arm moves", again)
    measured, expected = effort.mean(axis=0), model.gravity_at(q.mean(axis=0))
    residual = measured - expected
    worst = int(np.abs(residual).argmax())
    found = (
        f"measured minus model: {', '.join(f'{value:+.2f}' for value in residual)} Nm, A1 to A7; "
        f"largest at {iiwa14.JOINT_NAMES[worst]}"
    )
    values = {"residual_nm": residual.tolist(), "measured_nm": measured.tolist(), "model_nm": expected.tolist()}
    fix = "give the model the payload and tool that the arm carries, calibrate the torque sensors, and look for contact"
    if np.abs(measured).max() < _SMALL_TORQUE < np.abs(expected).max():
        found = "measured torques are about zero where gravity is not: the driver takes gravity out of them"
        fix = "let the driver report torques with gravity, and see supervision.gravity_compensation of the controller"
        return failed(name, found, fix, **values)
    if (np.abs(residual) > _BAD_SHARE_OF_THRESHOLD * np.array(budget.torque_thresholds)).any():
        return failed(name, f"{found}: more than half of the contact budget is gone", fix, **values)
    if np.abs(residual).max() > _GOOD_RESIDUAL:
        return warned(name, found, fix, **values)
    return passed(name, found, **values)
