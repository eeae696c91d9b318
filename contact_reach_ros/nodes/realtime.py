"""The 1 kHz side of a node: real-time priority, and waiting for messages without an executor.

A node's loop thread owns an `Inbox` and does nothing but the loop; services, timers and parameters of the same node are
served by an executor in another thread.
"""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from contact_reach_ros.nodes.topics import Topic

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
"""Flags of mlockall(2)."""

_MIDDLEWARE_PRIORITY = 30


def request_realtime(priority: int) -> str:
    """Give all threads of this process, and those started later, SCHED_FIFO priority; collect no garbage from now on.

    To be called when the process is ready for its loop: what it does before would keep others from running.

    Returns
    -------
    str
        Empty when granted, else a warning for the log that says how to permit it.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    # Pages in use stay in memory. Where that is not permitted the loop still works, with a late tick now and then.
    ctypes.CDLL(None).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    # The middleware's own threads count too: they bring the messages.
    return _prioritise(os.listdir("/proc/self/task"), priority)


def prioritise_middleware() -> str:
    """Give the middleware's threads of a process without a loop of its own SCHED_FIFO priority, below all loops.

    They only pass messages on; behind a process that computes, messages would wait for it.

    Returns
    -------
    str
        Empty when granted, else a warning for the log.
    """
    tasks = Path("/proc/self/task")
    threads = [task.name for task in tasks.iterdir() if (task / "comm").read_text().startswith("dds.")]
    return _prioritise(threads, _MIDDLEWARE_PRIORITY)


def _prioritise(threads: Sequence[str], priority: int) -> str:
    try:
        for thread in threads:
            os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return (
            "no real-time priority: ticks will be missed when the machine is busy. Permit it with "
            "'rtprio 90' for your user in /etc/security/limits.d/, then log in again"
        )
    return ""


class LoopGroup(CallbackGroup):
    """Subscriptions of this group are left alone by every executor: a loop thread takes their messages itself."""

    def can_execute(self, entity: Any) -> bool:
        """Never: executors skip the entity."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Never called, since nothing may be executed."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Never called, since nothing may be executed."""


class Inbox:
    """Subscriptions whose messages one loop thread waits for and handles.

    The wait set is built of the same few handles each time, which costs a fraction of an executor's turn. Messages that
    are ready together are handled in the order in which their topics were added.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = LoopGroup()
        self._subscriptions: list[tuple[Subscription, Callable[[Any], None]]] = []
        self._wake = node.create_guard_condition(lambda: None, callback_group=self._group)
        self._wait_set: Any = None
        self.received_ns = 0
        """When the message being handled came in, on the system clock: before this thread woke up for it."""

    def add(
        self, topic: Topic, handle: Callable[[Any], None], qos: QoSProfile | None = None, raw: bool = False
    ) -> None:
        """Subscribe; `handle` is called in the loop thread, with `qos` instead of the topic's own when given.

        With `raw` it gets the serialised message.
        """
        subscription = self._node.create_subscription(
            topic.type, topic.name, handle, qos or topic.qos, callback_group=self._group, raw=raw
        )
        self._subscriptions.append((subscription, handle))
        self._wait_set = None

    def wait(self, timeout_ns: int) -> None:
        """Sleep until a message arrives, `wake` is called or the time is over; handle all messages that are there."""
        if self._wait_set is None:
            count = len(self._subscriptions)
            context = self._node.context.handle
            self._wait_set = rclpy_implementation.WaitSet(count, 1, 0, 0, 0, 0, context)
        wait_set = self._wait_set
        wait_set.clear_entities()
        for subscription, _ in self._subscriptions:
            wait_set.add_subscription(subscription.handle)
        wait_set.add_guard_condition(self._wake.handle)
        wait_set.wait(max(timeout_ns, 0))
        for index, (subscription, handle) in enumerate(self._subscriptions):
            if wait_set.is_ready("subscription", index):
                self._handle_all(subscription, handle)

    def poll(self) -> None:
        """Handle all messages that are there, without a wait: cheaper where the thread sleeps by the clock anyway."""
        for subscription, handle in self._subscriptions:
            self._handle_all(subscription, handle)

    def wake(self) -> None:
        """End a wait in the loop thread; may be called from any thread."""
        self._wake.trigger()

    def _handle_all(self, subscription: Subscription, handle: Callable[[Any], None]) -> None:
        """Take all messages, then handle them: those that come meanwhile have to wait, or a slow handler never ends."""
        taken = []
        while (pair := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is not None:
            taken.append(pair)
        for message, information in taken:
            self.received_ns = information["received_timestamp"]
            handle(message)
