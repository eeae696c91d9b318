"""Checks of the joint states of an arm: names, rate, clock, and torques that fit the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.mount import in_words
from contact_reach_ros.doctor.findings import Finding, Verdict, failed, graded
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.timing import NANOSECONDS

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
        (n, joints) in the arm's order, rad, rad/s and N m; NaN where a message had none.
    """

    names: Sequence[tuple[str, ...]]
    stamps_ns: NDArray[np.int64]
    received_ns: NDArray[np.int64]
    position: Array
    velocity: Array
    effort: Array


def joint_names(record: JointRecord, arm: Arm, command_order: Sequence[str] | None = None) -> Finding:
    """Check names and order of the joints.

    Parameters
    ----------
    record
        What was heard.
    arm
        Whose joints are expected.
    command_order
        Parameter `joints` of a controller of ros2_control that takes the commands; None if there is none.
    """
    if not len(record.stamps_ns):
        return failed("no joint states to read names from", _MISSING)
    wanted = arm.joint_names
    ordered = f"[{', '.join(wanted)}]"
    fix_order = (
        f"set the driver's joint order (parameter joints of effort_controller in ros2_control) to {ordered}: commands "
        "carry no names, a torque in another order goes to another joint"
    )
    if command_order is not None and tuple(command_order) != wanted:
        return failed(f"effort_controller takes commands in the order {', '.join(command_order)}", fix_order)
    for names in record.names:
        missing = [joint for joint in wanted if joint not in names]
        if missing:
            fix = f"let the driver publish all of {ordered}, by its joint-name or prefix parameter"
            return failed(f"joint_states lacks {', '.join(missing)}; it has {', '.join(names) or 'none'}", fix)
        order = tuple(joint for joint in names if joint in wanted)
        # States are read by name, so that their order only counts as a hint at the order of the commands.
        if order != wanted and command_order is None:
            return failed(f"joint_states come in the order {', '.join(names)}", fix_order)
    for field, values in (("position", record.position), ("velocity", record.velocity)):
        lacking = [joint for joint, column in zip(wanted, values.T, strict=True) if not np.isfinite(column).all()]
        if lacking:
            found = f"joint_states have no {field} of {', '.join(lacking)}, or not always"
            return failed(found, f"let the driver fill {field} with finite numbers: nothing is started before")
    others = sorted({joint for names in record.names for joint in names} - set(wanted))
    ignored = f"; {', '.join(others)} are ignored" if others else ""
    return Finding(Verdict.PASS, ", ".join(wanted) + ignored)


def driver_rate(record: JointRecord, nominal: float) -> Finding:
    """Check the rate of the joint states against the nominal one, Hz, and how regular their stamps are."""
    count = len(record.stamps_ns)
    if count < 2:
        return failed(f"{count} joint states while listening", f"{_MISSING}; see its log and its lifecycle state")
    steps = np.diff(record.stamps_ns).astype(float)
    backwards = int((steps < 0).sum())
    if backwards:
        fix = "end the second publisher of joint_states, or let the driver stamp with one clock that never goes back"
        return failed(f"{backwards} of {count} stamps are older than the one before", fix)
    rate = (count - 1) * NANOSECONDS / max(float(record.received_ns[-1] - record.received_ns[0]), 1.0)
    off = abs(rate - nominal) / nominal
    found = f"{rate:.0f} Hz, stamps vary by {steps.std() / 1e3:.0f} us, longest gap {steps.max() / 1e6:.1f} ms"
    if off > _BAD_SHARE:
        found += f"; the nodes count on {nominal:.0f} Hz (state_rate): they refuse to start the arm, or stop it falsely"
    return graded(
        found,
        f"set the driver to {nominal:.0f} Hz, or state_rate of every node to the driver's rate; if both are, permit "
        "real-time priority and end other busy programs",
        fail=off > _BAD_SHARE,
        warn=bool(off > _GOOD_SHARE or steps.max() > _LONG_GAP_NS),
    )


def clock_skew(record: JointRecord) -> Finding:
    """Check how far the driver's clock is from this machine's."""
    if not len(record.stamps_ns):
        return failed("no joint states to read a clock from", _MISSING)
    # Messages are late, clocks are not: the least delay is the best guess.
    late_ms = (record.received_ns - record.stamps_ns) / 1e6
    skew = float(late_ms.min() if late_ms.min() > 0 else np.median(late_ms))
    fix = "synchronise the computers' clocks (chrony, or PTP), or stamp joint states with the system clock"
    found = f"joint states are stamped {abs(skew):.1f} ms {'before' if skew >= 0 else 'after'} this machine's clock"
    return graded(found, fix, fail=abs(skew) > _BAD_SKEW_MS, warn=abs(skew) > _GOOD_SKEW_MS)


def gravity(record: JointRecord, model: RobotModel, budget: ContactBudget) -> Finding:
    """Compare the measured torque of the arm at rest with the model's g(q), joint by joint.

    The difference counts against the contact budget before anything is touched.
    """
    again = "run doctor again when the brakes are open and the arm is at rest (no goal)"
    known: NDArray[np.bool_] = np.isfinite(record.effort.sum(axis=1))
    if not len(known) or not known[-1]:
        why = "no effort in joint_states, as with closed brakes" if len(known) else "no joint states"
        return graded(f"not compared: {why}", again, warn=True)
    q, v, effort = record.position[known], record.velocity[known], record.effort[known]
    if np.abs(v.mean(axis=0)).max() > _REST_SPEED or np.ptp(q, axis=0).max() > _REST_TRAVEL:
        return graded("not compared: the arm moves", again, warn=True)
    measured, expected = effort.mean(axis=0), model.gravity_at(q.mean(axis=0))
    residual, joints = measured - expected, model.arm.joint_names
    found = (
        f"measured minus model: {', '.join(f'{value:+.2f}' for value in residual)} Nm, {joints[0]} to {joints[-1]}; "
        f"largest at {joints[int(np.abs(residual).argmax())]}"
    )
    fix = (
        "give the model the payload and tool that the arm carries, and the arm's mount; calibrate the torque sensors, "
        "and look for contact"
    )
    without = np.abs(measured).max() < _SMALL_TORQUE < np.abs(expected).max()
    spent = (np.abs(residual) > _BAD_SHARE_OF_THRESHOLD * np.array(budget.torque_thresholds)).any()
    if without:
        found = "measured torques are about zero where gravity is not: the driver takes gravity out of them"
        fix = "let the driver report torques with gravity, and see supervision.gravity_compensation of the controller"
    elif spent:
        found += ": more than half of the contact budget is gone"
    found += f"; assumed: {in_words(model.arm)}"
    return graded(found, fix, fail=bool(without or spent), warn=bool(np.abs(residual).max() > _GOOD_RESIDUAL))
