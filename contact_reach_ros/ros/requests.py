"""Requests to services of other nodes that are repeated until they are answered."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.client import Client
from rclpy.task import Future

_PATIENCE_S = 2.0
"""An answer that is lost, as before the server has discovered who asks, is not waited for any longer."""


class RepeatedRequest:
    """A request that is sent when the service is there, and again while no answer comes."""

    def __init__(self, client: Client, on_answer: Callable[[Any], None]) -> None:
        """`on_answer` is called with each answer, in the executor's thread."""
        self._client = client
        self._on_answer = on_answer
        self._future: Future | None = None
        self._sent = 0.0

    def send(self, request: Any) -> None:
        """Send it, unless the service is not there, or an answer may still come; to be called again and again."""
        if not self._client.service_is_ready():
            return
        if self._future is not None and not self._future.done():
            if time.monotonic() - self._sent < _PATIENCE_S:
                return
            self._client.remove_pending_request(self._future)
        self._sent = time.monotonic()
        self._future = self._client.call_async(request)
        self._future.add_done_callback(self._take)

    def _take(self, future: Future) -> None:
        answer = future.result()
        if answer is not None:
            self._on_answer(answer)
