"""Waiting for messages without an executor, for the loop thread of a node.

The loop thread owns an `Inbox` and does nothing but the loop; an executor in another thread serves services, timers
and parameters of the same node.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from typing import Any, NamedTuple, TypeVar

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.intake import CODES, IntakeLog
from contact_reach_ros.messages.serialized import decode
from contact_reach_ros.messages.topics import Qos, Topic

_T = TypeVar("_T")

_PATIENCE_S = 2.0
_HOLD_NS = 100_000_000

LARGEST_SCENE = 1 << 22
"""Bytes of a message with obstacles or other markers, for nodes without a loop that others wait for."""
_LARGEST = 1 << 16
"""Bytes of a message: to take apart one that is larger would take longer than a drive waits for its next command."""


def qos_profile(qos: Qos) -> QoSProfile:
    """Convert a topic's quality of service for rclpy."""
    return QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE,
    )


class LoopGroup(CallbackGroup):
    """Subscriptions that every executor leaves alone: a loop thread takes their messages itself."""

    def can_execute(self, entity: Any) -> bool:
        """Return False: executors skip the entity."""
        return False


class _Listened(NamedTuple):
    topic: Topic
    subscription: Subscription
    serialized: bool
    handle: Callable[[Any], None]
    single: bool
    """Whether there is never more than one message to take."""
    code: int
    """Of the topic in the intake log, 0 for one that is not noted."""
    ready: Callable[[bytes], bool] | None
    """Whether a message may be handled; None where it always may."""
    largest: int
    """Bytes of a message."""


class Inbox:
    """Subscriptions whose messages one loop thread waits for and handles.

    The wait set consists of the same few handles each time, which costs a fraction of an executor's turn. Messages that
    are ready together are handled in the order in which their topics were added, unhurried ones last.

    Attributes
    ----------
    received_ns
        When the message being handled arrived, on the system clock: before this thread woke up for it.
    sent_ns
        When it was sent, ns since the epoch.
    handled_ns
        When its handling began, on the steady clock.
    intake
        Notes what is handled; None unless the node sets it.
    """

    def __init__(self, node: Node, refuse: Callable[[str, Exception], None]) -> None:
        """Listen as `node`; `refuse` takes what handling a message or a task raises, and what was being handled."""
        self._node = node
        self._refuse = refuse
        self._group = LoopGroup()
        self._subscriptions: list[_Listened] = []
        self._unhurried: list[_Listened] = []
        self._wake = node.create_guard_condition(lambda: None, callback_group=self._group)
        self._wait_sets: dict[int, Any] = {}
        """By the number of subscriptions."""
        self._last: dict[str, tuple[int, bytes]] = {}
        """When the last message of a topic from anybody was sent, ns, and its bytes."""
        self._tasks: deque[Callable[[], None]] = deque()
        self._thread = 0
        self.received_ns = 0
        self.sent_ns = 0
        self.handled_ns = 0
        self.intake: IntakeLog | None = None

    def add(
        self,
        topic: Topic,
        handle: Callable[[Any], None],
        qos: Qos | None = None,
        serialized: bool = False,
        ready: Callable[[bytes], bool] | None = None,
        hurried: bool = True,
        largest: int = _LARGEST,
    ) -> None:
        """Subscribe; `handle` is called in the loop thread.

        Parameters
        ----------
        topic
            To subscribe to.
        handle
            Called with each message.
        qos
            Requested instead of the topic's own.
        serialized
            Whether `handle` receives the bytes instead of a message object, whose construction takes most of the time.
        ready
            Called with each message, which is held back until it returns True. Messages of other topics are handled
            meanwhile, and all that have come when it does.
        hurried
            Whether a message wakes the thread up. An unhurried one is handled after the next message of another topic,
            or at the end of the wait, so that one that takes long does not delay the others.
        largest
            Bytes of a message; larger ones are refused.
        """
        qos, code = qos or topic.qos, int(CODES.get(topic.name, 0))
        # Who requests kept messages hears no publisher that keeps none.
        for each in (qos, qos._replace(latched=False)) if topic.from_anybody and qos.latched else (qos,):
            subscription = self._node.create_subscription(
                topic.type, topic.name, handle, qos_profile(each), callback_group=self._group, raw=True
            )
            listened = _Listened(topic, subscription, serialized, handle, qos.depth == 1, code, ready, largest)
            (self._subscriptions if hurried else self._unhurried).append(listened)

    @property
    def subscriptions(self) -> list[Subscription]:
        """All subscriptions."""
        return [listened.subscription for listened in (*self._subscriptions, *self._unhurried)]

    def wait(self, timeout_ns: int) -> None:
        """Sleep until a message arrives, `wake` is called or the timeout is over; handle what has arrived."""
        wait_set = self._sleep(self._subscriptions, timeout_ns)
        self.run_tasks()
        for index, listened in enumerate(self._subscriptions):
            if wait_set.is_ready("subscription", index):
                self._handle_all(listened)
        self._handle_unhurried()

    def poll(self) -> None:
        """Handle what has arrived without waiting: cheaper where the thread sleeps by the clock anyway."""
        for listened in self._subscriptions:
            self._handle_all(listened)
        self._handle_unhurried()

    def post(self, task: Callable[[], None]) -> None:
        """Let the loop thread run a task between two messages; may be called from any thread."""
        self._tasks.append(task)
        self.wake()

    def call(self, task: Callable[[], _T]) -> _T:
        """Let the loop thread run a task, and return its result; may be called from any thread.

        Raises
        ------
        Exception
            What the task raises; the loop continues.
        TimeoutError
            If the loop thread is busy for more than 2 s; it will run the task nevertheless.
        """
        if self._thread in (0, threading.get_ident()):
            return task()
        answer: Future[_T] = Future()

        def run() -> None:
            try:
                answer.set_result(task())
            except Exception as error:
                answer.set_exception(error)

        self.post(run)
        if not wait([answer], timeout=_PATIENCE_S).done:
            raise TimeoutError(f"the loop has not answered for {_PATIENCE_S:g} s")
        return answer.result()

    def run_tasks(self) -> None:
        """Run the posted tasks; for the loop thread while it does not wait."""
        self._thread = threading.get_ident()
        # Not those that are posted meanwhile, as for a task that fails.
        for _ in range(len(self._tasks)):
            task = self._tasks.popleft()
            try:
                task()
            except Exception as error:
                self._refuse("a call", error)

    def note(self, what: int) -> None:
        """Note a call in the intake log, if any."""
        self.handled_ns = time.monotonic_ns()
        if self.intake is not None:
            self.intake.add(what, 0, self.handled_ns)

    def wake(self) -> None:
        """End a wait in the loop thread; may be called from any thread."""
        self._wake.trigger()

    def _sleep(self, subscriptions: Sequence[_Listened], timeout_ns: int) -> Any:
        """Sleep until one has a message, `wake` is called or the timeout is over; returns the wait set."""
        count = len(subscriptions)
        if count not in self._wait_sets:
            context = self._node.context.handle
            self._wait_sets[count] = rclpy_implementation.WaitSet(count, 1, 0, 0, 0, 0, context)
        wait_set = self._wait_sets[count]
        wait_set.clear_entities()
        for listened in subscriptions:
            wait_set.add_subscription(listened.subscription.handle)
        wait_set.add_guard_condition(self._wake.handle)
        wait_set.wait(max(timeout_ns, 0))
        return wait_set

    def _handle_unhurried(self) -> None:
        for listened in self._unhurried:
            self._handle_all(listened)
        if self.intake is not None:
            self.intake.publish_full()

    def _handle_all(self, listened: _Listened) -> None:
        """Take all messages, then handle them: a slow handler would never finish with those that arrive meanwhile."""
        take = listened.subscription.handle.take_message
        taken = []
        while (pair := take(listened.topic.type, True)) is not None:
            taken.append(pair)
            if listened.single:
                break
        for data, information in taken:
            if listened.ready is not None:
                self._hold_back(listened.ready, data)
            self.received_ns = information["received_timestamp"]
            self._handle(listened, data, information["source_timestamp"])

    def _handle(self, listened: _Listened, data: bytes, sent_ns: int) -> None:
        """Handle one message; whatever that raises is refused here."""
        topic = listened.topic
        if topic.from_anybody:
            if self._last.get(topic.name) == (sent_ns, data):
                # From the other subscription to a publisher that keeps messages.
                return
            self._last[topic.name] = sent_ns, data
        self.sent_ns, self.handled_ns = sent_ns, time.monotonic_ns()
        try:
            if len(data) > listened.largest:
                raise InputError(
                    f"{topic.name}: a message of {len(data)} bytes; expected at most {listened.largest}: send less"
                )
            message = data if listened.serialized else decode(data, topic.type, topic.name)
            if self.intake is not None and listened.code:
                self.intake.add(listened.code, sent_ns, self.handled_ns)
            listened.handle(message)
        except Exception as error:
            self._refuse(topic.contents, error)

    def _hold_back(self, ready: Callable[[bytes], bool], data: bytes) -> None:
        """Handle messages of other topics, and tasks, until a message of this topic may be handled."""
        others = [other for other in (*self._subscriptions, *self._unhurried) if other.ready is None]
        while not ready(data):
            self._sleep(others, _HOLD_NS)
            self.run_tasks()
            for other in others:
                self._handle_all(other)
        # What makes this one ready may have come after others that were not there yet when they were looked for.
        for other in others:
            self._handle_all(other)
