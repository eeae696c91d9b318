"""Nodes that stop the arm: asked by a service, beside rivals, and after internal errors."""

from __future__ import annotations

from abc import abstractmethod

from contact_reach_ros.errors import InputError, StopCode, StopReason, internal, requested
from contact_reach_ros.ros.managed_node import ManagedNode


class StoppableNode(ManagedNode):
    """A node of the control loop with the services ~/stop and ~/reset.

    Both act in the loop's thread, which may be in the middle of a tick; a stop does not wait until it has.
    """

    STOPPED = "stopped"
    """Answer to a stop."""
    RELEASED = ""
    """Answer to a reset."""

    def __init__(self) -> None:
        super().__init__()
        self.offer("~/stop", self._answer_stop)
        self.offer("~/reset", self._answer_reset)

    @property
    @abstractmethod
    def stop_reason(self) -> str:
        """Why the arm is stopped; empty if it is not."""

    @property
    @abstractmethod
    def is_engaged(self) -> bool:
        """Whether the arm may follow from what this node does, so that there is something to stop."""

    @abstractmethod
    def stop_for(self, reason: str) -> None:
        """Stop the arm; in the loop's thread."""

    @abstractmethod
    def reset(self) -> None:
        """Release a stop; in the loop's thread. Raises `InputError` if the arm may not be released yet."""

    def on_fault(self, what: str, error: Exception) -> None:
        """Stop the arm: after an internal error the node's state is unknown."""
        self.stop_once(internal(what, error))

    def on_rivals(self) -> None:
        """Stop the arm, which would get the commands of both in turn."""
        if self.is_engaged:
            self.stop_once(StopReason(StopCode.RIVAL, self.rivals))

    def stop_once(self, reason: str) -> None:
        """Let the loop stop the arm, unless it is stopped already; may be called from any thread."""
        if not self.stop_reason:
            self.inbox.post(lambda: self.stop_for(reason))

    def _answer_stop(self) -> str:
        # The loop may be slow to answer, but it will stop.
        self.inbox.post(lambda: self.stop_for(requested("stop service called")))
        return self.STOPPED

    def _answer_reset(self) -> str:
        if self.rivals:
            raise InputError(f"{self.rivals}: end the others first")
        self.inbox.call(self.reset)
        return self.RELEASED
