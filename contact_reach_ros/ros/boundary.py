"""The boundary of a node: messages and requests of others lead to a refusal at worst, and never end the node.

Readers refuse what is malformed with a `ContactReachError`; it is counted and logged. Any other exception that reaches
the boundary is an internal error, a fault of this program. The message or request that led to it is dropped and counted
as well; its traceback is logged once, and the node decides what follows: controller and observer stop the arm.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node

from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.ros.inbox import LoopGroup

INTERNAL = "internal errors"
"""What faults of this program are counted as."""
REQUESTS = "requests"
TRANSITIONS = "transitions"
"""What refused requests of services are counted as; transitions are those of the lifecycle."""

_LONGEST = 500
"""Characters of a refusal in the log: it may quote what was sent."""


class Boundary:
    """Counts refusals and keeps the last one of each kind for the log. May be used from several threads.

    Attributes
    ----------
    refused
        Number of refusals by what was refused, such as 'joint states'.
    reasons
        Text of the last refusal, likewise.
    """

    def __init__(self, report: Callable[[str], None], on_fault: Callable[[str, Exception], None]) -> None:
        """`report` gets the traceback of each new fault; `on_fault` what led to it, in the thread where it happened."""
        self.refused: dict[str, int] = {}
        self.reasons: dict[str, str] = {}
        self._report = report
        self._on_fault = on_fault
        self._unlogged: set[str] = set()
        self._reported: set[tuple[str, type]] = set()

    def refuse(self, what: str, error: Exception) -> None:
        """Count a message or request that led to an exception."""
        is_fault = not isinstance(error, ContactReachError | TimeoutError)
        kind, text = what, str(error)
        if is_fault:
            kind, text = INTERNAL, f"{what}: internal error: {_name(error)}; see its traceback above, and report it"
        self.refused[kind] = self.refused.get(kind, 0) + 1
        self.reasons[kind] = text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."
        self._unlogged.add(kind)
        if is_fault:
            if (what, type(error)) not in self._reported:
                self._reported.add((what, type(error)))
                lines = "".join(traceback.format_exception(error))
                self._report(f"internal error in handling {what}, which are dropped; please report it:\n{lines}")
            self._on_fault(what, error)

    def last_refusals(self) -> list[str]:
        """One line for the last refusal of each kind since the last call."""
        kinds, self._unlogged = self._unlogged, set()
        return [self.reasons[kind] for kind in kinds]

    def protect(self, node: Node) -> None:
        """Refuse what the callbacks of a node raise; its inbox has the boundary anyway.

        To be called once, when all services, timers and subscriptions are made. A refused request is answered, with the
        reason where the answer has a text for it.
        """
        for service in node.services:
            what = TRANSITIONS if service.srv_type is ChangeState else REQUESTS
            service.callback = self._guarded(service.callback, what, service.srv_name)
        for subscription in node.subscriptions:
            if not isinstance(subscription.callback_group, LoopGroup):
                name = subscription.topic_name
                subscription.callback = self._guarded(subscription.callback, name.removeprefix("/"), name)
        for timer in node.timers:
            timer.callback = self._guarded(timer.callback, "a timer", "a timer")

    def _guarded(self, callback: Callable[..., Any], what: str, name: str) -> Callable[..., Any]:
        """The callback of a message, timer or request; what it raises is refused."""

        def call(*given: Any) -> Any:
            try:
                return callback(*given)
            except Exception as error:
                refusal = error
                if callback.__module__.startswith("rclpy.") and not isinstance(error, ContactReachError):
                    # rclpy's own callbacks fail by what they are sent.
                    refusal = InputError(
                        f"{name}: {_name(error)}; expected what ROS accepts in this state: describe_parameters and "
                        "get_available_transitions list it"
                    )
                self.refuse(what, refusal)
                if len(given) < 2:
                    return None
                answer = type(given[-1])()
                if hasattr(answer, "message"):
                    answer.message = str(refusal)
                return answer

        return call


def _name(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
