"""Messages of diagnostics and of `safety_state`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.errors import code_of
from contact_reach_ros.messages.safety_state import ERROR, MONITORING, OK, STOP_CODE, WARN, findings
from contact_reach_ros.observer.observer import SafetyReport
from contact_reach_ros.observer.safety import SafetyLevel

_LEVELS = {SafetyLevel.FREE: OK, SafetyLevel.CONTACT: WARN, SafetyLevel.BLIND: ERROR, SafetyLevel.COLLISION: ERROR}


def to_status(
    name: str, message: str, values: Mapping[str, Any], level: int = OK, hardware_id: str = ""
) -> DiagnosticStatus:
    """A DiagnosticStatus, its values as text."""
    return DiagnosticStatus(
        level=bytes([level]),
        name=name,
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )


def to_safety_state(report: SafetyReport, name: str, arm: Arm) -> DiagnosticStatus:
    """The message of a report, published by the node `name`."""
    # Numbers are among the values only, so that the message changes when the state does.
    message = report.reason or (MONITORING if report.level is SafetyLevel.FREE else report.level.value)
    return to_status(name, message, findings(report), _LEVELS[report.level], arm.name)


def to_stop_state(name: str, arm: Arm, reason: str, otherwise: str, values: Mapping[str, str]) -> DiagnosticStatus:
    """The safety state of the node `name`: why it stopped the arm, or if `reason` is empty its state `otherwise`."""
    return to_status(
        name, reason or otherwise, {**values, STOP_CODE: code_of(reason)}, ERROR if reason else OK, arm.name
    )
