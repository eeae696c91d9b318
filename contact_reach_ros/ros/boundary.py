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
    """Counts refusals and keeps the last one of each kind for the log. May be used from several threads.

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
            Called with what led to a fault, and the fault, in the thread where it happened.
        """
        self.refused: dict[str, int] = {}
        self.reasons: dict[str, str] = {}
        self._report = report
        self._on_fault = on_fault
        self._last: dict[str, str] = {}
        self._reported: set[tuple[str, type]] = set()

    def refuse(self, what: str, error: Exception) -> None:
        """Count a message or request that led to an exception."""
        if isinstance(error, ContactReachError | TimeoutError):
            self._count(what, str(error))
            return
        self._count(INTERNAL, f"{what}: internal error: {_name(error)}; see its traceback above, and report it")
        if (what, type(error)) not in self._reported:
            self._reported.add((what, type(error)))
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
        """Refuse what the callbacks of a node raise; its inbox has the boundary anyway.

        To be called once, when all services, timers and subscriptions are made. A refused request is answered, with the
        reason where the answer has a text for it.
        """
        contents = {node.resolve_topic_name(topic.name): topic.contents for topic in topics.ALL}
        for service in node.services:
            what = TRANSITIONS if service.srv_type is ChangeState else REQUESTS
            service.callback = self._answering(service.callback, what, service.srv_name)
        for subscription in node.subscriptions:
            if not isinstance(subscription.callback_group, LoopGroup):
                name = subscription.topic_name
                subscription.callback = self._calling(subscription.callback, contents.get(name, name))
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

    def _calling(self, callback: Callable[..., Any], what: str) -> Callable[..., None]:
        def call(*given: Any) -> None:
            try:
                callback(*given)
            except Exception as error:
                self.refuse(what, _of_sender(callback, what, error))

        return call


def _of_sender(callback: Callable[..., Any], name: str, error: Exception) -> Exception:
    """The error, or a refusal where one of rclpy's own callbacks raised it, which fail by what they are sent."""
    if isinstance(error, ContactReachError) or not callback.__module__.startswith("rclpy."):
        return error
    return InputError(
        f"{name}: {_name(error)}; expected what ROS accepts in this state: describe_parameters and "
        "get_available_transitions list it"
    )


def _name(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
