"""Errors that the package raises, and reasons for which the arm is stopped.

Each message of an error says what was wrong, what was expected and what to do. A reason has a code for programs and a
text for people.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class ContactReachError(Exception):
    """Base of every error that this package raises on purpose."""


class SettingsError(ContactReachError):
    """A settings file, parameter or command-line value is unknown, of the wrong type or out of range."""


class InputError(ContactReachError):
    """A message or argument is refused: non-finite, of the wrong size, in an unknown frame, out of reach, ..."""


class FrameError(InputError):
    """A message is in another frame than the arm's base frame."""


class PlanningError(ContactReachError):
    """There is no plan: for example, a collision-free path does not exist or was not found in time."""


class UnreachableError(PlanningError):
    """The arm does not get from where it is to its goal, however long it tries."""


class SceneError(ContactReachError):
    """A scene cannot be loaded or built."""


class BagError(ContactReachError):
    """A bag cannot be written or read."""


class StopCode(Enum):
    """Causes of a stop. The values are an interface: bags and `safety_state` carry them."""

    REQUEST = "request"
    """A service call, or the library's `stop`."""
    RIVAL = "rival"
    """A second publisher on a topic that permits only one."""
    OBSERVER_SILENT = "observer silent"
    DISAGREEMENT = "disagreement"
    """The controller watches itself with other settings than the observer."""
    POSITION_LIMIT = "position limit"
    SPEED_LIMIT = "speed limit"
    NO_PLAN = "no plan"
    """No valid plan for too long after the last one."""
    EXTERNAL_TORQUE = "external torque"
    """External torque above the contact budget."""
    SUDDEN_TORQUE = "sudden torque"
    """Sudden external torque above its thresholds in the contact budget."""
    CONTACT = "contact"
    """A contact within the thresholds that did not end although the arm gave way."""
    BLIND = "blind"
    """The external torque cannot be known, because of what the joint states carry."""
    MISSED_STATES = "missed states"
    """The external torque cannot be known, because joint states came too far apart: they were late, or who reads them
    was."""
    MODEL = "model"
    """At hand-over, the arm's weight differs from the model's."""
    ENCODER = "encoder"
    """Positions and velocities contradict each other, or a position is stuck."""
    TORQUE_SENSOR = "torque sensor"
    """A measured torque is stuck."""
    NO_COMMAND = "no command"
    """The drive, or the adapter before it, has received no command for too long."""
    DRIVE = "drive"
    """The drive takes no commands any more, as it reports itself."""
    INTERNAL = "internal error"
    """A fault of the node's own program, in handling a message or a request."""


class StopReason(str):
    """Text that explains why the arm is stopped, with the code of the cause."""

    code: StopCode

    def __new__(cls, code: StopCode, text: str) -> StopReason:
        """Make a reason; `text` says what was found, with numbers and units."""
        reason = super().__new__(cls, text)
        reason.code = code
        return reason

    def __reduce__(self) -> tuple[type[StopReason], tuple[StopCode, str]]:
        return StopReason, (self.code, str(self))


class Verdict(NamedTuple):
    """What the observer lets the controller do: nothing stands against it by default."""

    reason: str = ""
    """Why the arm has to be stopped; empty while it has not."""
    distrust: str = ""
    """What is wrong with the joint states or the model, on which a compliant stop relies; empty while nothing is."""
    doubt: str = ""
    """Why the arm must not be started; empty when it may."""
    torque_known: bool = True
    """Whether the torque that acts on the arm is known. Behind closed brakes it is not, and no plan is followed."""
    contact: str = ""
    """Force and link of a contact that counts; empty without one."""
    excess: bool = False
    """Whether that contact has exceeded the permitted force for too long."""


def requested(text: str = "stop requested") -> StopReason:
    """The reason for a stop by service or library call."""
    return StopReason(StopCode.REQUEST, text)


def internal(what: str, error: Exception) -> StopReason:
    """A stop because of a fault of the program in handling `what`."""
    return StopReason(StopCode.INTERNAL, f"internal error in handling {what}: {type(error).__name__}; see the log")


def with_sequel(reason: str, sequel: str) -> str:
    """The reason, extended by what has happened since; the code stays the same."""
    text = f"{reason}; {sequel}" if sequel else reason
    return StopReason(reason.code, text) if isinstance(reason, StopReason) else text


def code_of(reason: str) -> str:
    """Value of the reason's code; empty for a text without a code."""
    return reason.code.value if isinstance(reason, StopReason) else ""
