"""The content of `safety_state`, read from any object with the fields of the message."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from contact_reach_ros.arm import Arm
from contact_reach_ros.errors import InputError, StopCode, StopReason, Verdict, code_of
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.observer.observer import SafetyReport, describe_contact

MONITORING = "monitoring"
"""Message while nothing stops the arm and nothing touches it."""

STOP_CODE = "stop code"
"""Key of the code of what stopped the arm, see `StopCode`."""

STOPS_CALLED = "stops called"
"""Key of how often a node's `~/stop` was called: also a stop of an arm that is stopped already is news."""

OK, WARN, ERROR = 0, 1, 2
"""Levels of a diagnostic_msgs/msg/DiagnosticStatus."""

DISTRUST = "distrust"
"""Key of what is wrong with the joint states or the model, on which a compliant stop relies."""

DOUBT = "doubt"
"""Key of why the arm must not be started."""

TORQUE = "acting torque"
"""Key of whether the acting torque is known."""

_ADAPTER, _STATE, _PASSING = "adapter", "state", "passing"

_KNOWN, _UNKNOWN = "known", "unknown"


_LINK, _FORCE, _POSITION = "contact link", "contact force xyz N", "contact position xyz m"
_SUDDEN, _EXCESS = "sudden torque Nm", "contact above permitted force"


class SafetyState(NamedTuple):
    """Safety state of one node, as it published it."""

    time: float
    """When it was received, s."""
    level: int
    """Of the DiagnosticStatus: OK, WARN for a contact, from ERROR on a stop."""
    name: str
    """Of the node."""
    message: str
    contact: Contact | None = None
    """The one that the observer has located, if any."""

    @property
    def is_stop(self) -> bool:
        """Whether it reports a stop."""
        return self.level >= ERROR


def read_state(message: Any, arm: Arm, time: float = 0.0) -> SafetyState:
    """The state in a message that was received at a time, s; leaves out a malformed contact."""
    try:
        contact = read_contact(message, arm)
    except InputError:
        contact = None
    return SafetyState(time, read_level(message), message.name, message.message, contact)


def findings(report: SafetyReport) -> dict[str, str]:
    """The values of a report; link and force of a contact are known from its first heartbeat on."""
    verdict, contact = report.verdict, report.contact
    said = {STOP_CODE: code_of(verdict.reason), DISTRUST: verdict.distrust, DOUBT: verdict.doubt}
    values = {
        "level": report.level.value,
        "external torque max Nm": f"{np.abs(report.residual).max():.3f}",
        **{key: text for key, text in said.items() if text},
        "residual age ms": f"{1000.0 * report.age:.1f}",
        TORQUE: _KNOWN if verdict.torque_known else _UNKNOWN,
    }
    if contact is not None:
        values[_LINK] = contact.link
        values["contact force N"] = f"{contact.strength:.1f}"
        values[_FORCE] = " ".join(f"{value:.1f}" for value in contact.force.tolist())
        values[_POSITION] = " ".join(f"{value:.3f}" for value in contact.position.tolist())
        values[_SUDDEN] = " ".join(f"{value:.2f}" for value in contact.torque.tolist())
        if contact.is_excessive:
            values[_EXCESS] = "true"
    return values


def read_level(message: Any) -> int:
    """Level of a DiagnosticStatus; rclpy has it as a byte string, a bag's reader as a number."""
    level = message.level
    return level[0] if isinstance(level, bytes) else int(level)


def is_stopped(message: Any) -> bool:
    """Whether a safety state of any node reports a stop."""
    return read_level(message) >= ERROR


def is_requested(message: Any) -> bool:
    """Whether the stop in a safety state was called for."""
    return any((item.key, item.value) == (STOP_CODE, StopCode.REQUEST.value) for item in message.values)


def stops_called(message: Any) -> str:
    """How often the stop of the node that sent this safety state was called; empty if it does not report it."""
    return next((item.value for item in message.values if item.key == STOPS_CALLED), "")


def read_verdict(message: Any, arm: Arm) -> Verdict:
    """The verdict in the observer's safety state.

    Raises `InputError` as `read_contact`.
    """
    values = {item.key: item.value for item in message.values}
    reason = read_reason(message)
    known = values.get(TORQUE) != _UNKNOWN
    contact = describe_contact(read_contact(message, arm))
    return Verdict(reason, values.get(DISTRUST, ""), values.get(DOUBT, ""), known, contact, _EXCESS in values)


def read_in_force(message: Any, before: bool) -> bool:
    """Whether commands act on the arm, by the adapter's safety state; as before, by that of another node."""
    if message.name != _ADAPTER:
        return before
    return any((item.key, item.value) == (_STATE, _PASSING) for item in message.values)


def read_reason(message: Any) -> str:
    """Why a node is in error, with its code where the message has one; empty if it is not."""
    if read_level(message) < ERROR:
        return ""
    code = next((item.value for item in message.values if item.key == STOP_CODE), "")
    try:
        return StopReason(StopCode(code), message.message)
    except ValueError:
        return str(message.message)


def read_contact(message: Any, arm: Arm) -> Contact | None:
    """The contact in the observer's safety state; None if there is none in it.

    Raises `InputError` if link, position or force are malformed.
    """
    values = {item.key: item.value for item in message.values}
    if _LINK not in values:
        return None
    try:
        position, force = (np.array(values[key].split(), float).reshape(3) for key in (_POSITION, _FORCE))
        # Bags of version 0.2.0 lack it.
        torque = np.array(values.get(_SUDDEN, arm.n * "nan ").split(), float).reshape(arm.n)
    except (KeyError, ValueError) as error:
        raise InputError(
            f"safety_state: {_POSITION} and {_FORCE} must be three numbers each, {_SUDDEN} {arm.n} ({error})"
        ) from error
    if values[_LINK] not in arm.contact_links or not np.isfinite([position, force]).all():
        raise InputError(
            f"safety_state: {_LINK} = {values[_LINK]} at {position} with {force}: expected finite numbers and one of "
            f"{', '.join(arm.contact_links)}"
        )
    return Contact(values[_LINK], position, force, torque, _EXCESS in values)
