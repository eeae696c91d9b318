"""The boundary of a node: whatever others send it leads to a refusal at worst, and never ends the node.

Readers refuse what is malformed with a `ContactReachError`; it is counted and logged. Any other exception that reaches
the boundary is a fault of this program. The message or request that led to it is dropped, too, and counted as an
internal error; its traceback is logged once, and the node decides what follows: controller and observer stop the arm.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node

from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.inbox import LoopGroup

INTERNAL = "internal errors"
"""What faults of this program are counted as."""
REQUESTS = "requests"
TRANSITIONS = "transitions"
"""What refused requests of services are counted as; transitions are those of the lifecycle."""

_LONGEST = 500
"""Characters of a refusal in the log: it may quote what was sent."""


class Boundary:
    """Counts what is refused, and keeps the last refusal of each kind for the log.

    May be used from several threads.

    Attributes
    ----------
    refused
        Number of refusals by what was refused, such as 'joint states'.
    reasons
        Text of the last refusal, likewise.
    """

    def __init__(
        self,
        report: Callable[[str], None] = lambda text: None,
        on_fault: Callable[[str, Exception], None] = lambda what, error: None,
    ) -> None:
        """Start from zero.

        Parameters
        ----------
        report
            Called with the traceback of each fault that is new.
        on_fault
            Called with every fault and what led to it, in the thread where it happened.
        """
        self.refused: dict[str, int] = {}
        self.reasons: dict[str, str] = {}
        self._report = report
        self._on_fault = on_fault
        self._last: dict[str, str] = {}
        self._reported: set[tuple[str, type, int]] = set()

    def refuse(self, what: str, error: Exception) -> None:
        """Take note of a message or request that led to an exception."""
        if isinstance(error, ContactReachError | TimeoutError):
            self._count(what, str(error))
            return
        self._count(INTERNAL, f"{what}: internal error: {_name(error)}; see its traceback above, and report it")
        fault = (what, type(error), _line(error))
        if fault not in self._reported:
            self._reported.add(fault)
            lines = "".join(traceback.format_exception(error))
            self._report(f"internal error in handling {what}, which are dropped; please report it:\n{lines}")
        self._on_fault(what, error)

    def last_refusals(self) -> list[str]:
        """One line for the last refusal of each kind since the last call."""
        lines = []
        while self._last:
            lines.append(self._last.popitem()[1])
        return lines

    def protect(self, node: Node) -> None:
        """Let nothing that the callbacks of a node raise leave them; its inbox has the boundary anyway.

        To be called once, when all services, timers and subscriptions are made. A request is answered all the same:
        with the refusal, where the answer has a text for it.
        """
        contents = {node.resolve_topic_name(topic.name): topic.contents for topic in topics.ALL}
        for service in node.services:
            if service.srv_type is ChangeState:
                change = self._changing(service.callback, service.srv_name)
                service.callback = self._answering(change, TRANSITIONS, service.srv_name)
            else:
                service.callback = self._answering(service.callback, REQUESTS, service.srv_name)
        for subscription in node.subscriptions:
            if not isinstance(subscription.callback_group, LoopGroup):
                name = subscription.topic_name
                subscription.callback = self._hearing(subscription.callback, contents.get(name, name))
        for timer in node.timers:
            timer.callback = self._calling(timer.callback, "a timer")
        for guard in node.guards:
            guard.callback = self._calling(guard.callback, "a call")

    def _count(self, what: str, text: str) -> None:
        self.refused[what] = self.refused.get(what, 0) + 1
        self.reasons[what] = self._last[what] = text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."

    def _answering(self, callback: Callable[[Any, Any], Any], what: str, name: str) -> Callable[[Any, Any], Any]:
        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:
                self.refuse(what, _of_sender(callback, name, error))
                refused = type(response)()
                if hasattr(refused, "message"):
                    refused.message = str(error)
                return refused

        return answer

    def _changing(self, callback: Callable[[Any, Any], Any], name: str) -> Callable[[Any, Any], Any]:
        """Refuse transitions that are not permitted: for some rclpy raises, to others it just answers no."""

        def change(request: Any, response: Any) -> Any:
            before, reason = self.refused.get(TRANSITIONS), ""
            try:
                response = callback(request, response)
            except RuntimeError as error:
                # RCL's: what the node's own transitions raise does not leave rclpy.
                reason = f" ({_name(error)})"
                response.success = False
            if not response.success and self.refused.get(TRANSITIONS) == before:
                asked = f"{name}: transition = {request.transition.id} '{request.transition.label}'"
                expected = "expected one that get_available_transitions lists in this state"
                self.refuse(TRANSITIONS, InputError(f"{asked}; {expected}{reason}"))
            return response

        return change

    def _hearing(self, callback: Callable[[Any], Any], what: str) -> Callable[[Any], None]:
        def hear(message: Any) -> None:
            try:
                callback(message)
            except Exception as error:
                self.refuse(what, _of_sender(callback, what, error))

        return hear

    def _calling(self, callback: Callable[[], Any], what: str) -> Callable[[], None]:
        def call() -> None:
            try:
                callback()
            except Exception as error:
                self.refuse(what, error)

        return call


def _of_sender(callback: Callable[..., Any], name: str, error: Exception) -> Exception:
    """The same error, or a refusal: rclpy's own callbacks know nothing of the arm, and fail by what they are sent."""
    if isinstance(error, ContactReachError) or not callback.__module__.startswith("rclpy."):
        return error
    return InputError(f"{name}: {_name(error)}; expected a message or request that ROS accepts")


def _line(error: Exception) -> int:
    """Line at which it was raised; not by `traceback`, which would look into files each time."""
    place, line = error.__traceback__, 0
    while place is not None:
        line, place = place.tb_lineno, place.tb_next
    return line


def _name(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
