"""The 1 kHz side of a node: real-time priority, and waiting for messages without an executor.

A node's loop thread owns an `Inbox` and does nothing but the loop; services, timers and parameters of the same node are
served by an executor in another thread.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, wait
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.nodes.topics import Topic
from contact_reach_ros.recording.intake import CODES, IntakeLog

_T = TypeVar("_T")

_PATIENCE_S = 2.0
_HOLD_S = 0.0002

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
"""Flags of mlockall(2)."""

_M_ARENA_MAX, _M_MMAP_THRESHOLD = -8, -3
"""Parameters of mallopt(3)."""
_LARGE_BLOCK = 128 * 1024
"""Bytes, glibc's own first choice."""

_SERVICES_PRIORITY = 50
_MIDDLEWARE_PRIORITY = 30
_BACKGROUND_PRIORITY = 20
_COMPUTING_NICENESS = -5
_FEW_CPUS = 3


class Role(Enum):
    """What a process is for, which decides who may interrupt it, and where it runs."""

    LOOP = "loop"
    """Part of the control loop: all its threads have SCHED_FIFO priority."""
    MONITOR = "monitor"
    """Keeps pace with the loop, which does not wait for it: SCHED_FIFO priority, too."""
    COMPUTING = "computing"
    """Computes for long; its middleware's threads have priority below all loops, to pass messages on meanwhile."""
    BACKGROUND = "background"
    """Nobody waits for it, but it must not miss what comes: SCHED_FIFO priority below everything else."""
    ONLOOKER = "onlooker"
    """Nobody waits for it, and it may miss what comes: it has no priority."""


def choose_cpus(
    wanted: str, role: Role, permitted: Collection[int], isolated: Collection[int] = frozenset()
) -> set[int]:
    """CPUs for the threads of a process.

    On two or three CPUs the control loop has the last one, so that its messages find their receivers without waking
    another CPU. All else but onlookers has the others: what the loop needs stays in its CPU's caches, and the threads
    of whoever computes are not stuck behind the loop while another CPU is free. Where the kernel keeps CPUs free of all
    else, the control loop has the last one of these.

    Parameters
    ----------
    wanted
        'auto' for the above, 'all', or numbers separated by commas.
    role
        Of the process.
    permitted
        CPUs that the process may use.
    isolated
        CPUs that the kernel keeps free of all that does not ask for them.

    Raises
    ------
    SettingsError
        If it is none of these, or names a CPU that may not be used.
    """
    if wanted == "auto" and role is Role.LOOP and isolated:
        return {max(isolated)}
    if wanted == "auto" and 2 <= len(permitted) <= _FEW_CPUS:
        last = max(permitted)
        return {Role.LOOP: {last}, Role.ONLOOKER: set(permitted)}.get(role, set(permitted) - {last})
    if wanted in ("auto", "all"):
        return set(permitted)
    try:
        chosen = {int(number) for number in wanted.split(",")}
    except ValueError:
        chosen = set()
    possible = {*permitted, *isolated}
    if not chosen or not chosen <= possible:
        raise SettingsError(f"parameter cpus: '{wanted}'; expected auto, all, or numbers out of {sorted(possible)}")
    return chosen


def use_cpus(cpus: Collection[int]) -> None:
    """Let all threads of this process, and those started later, run on these CPUs only."""
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), cpus)


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


def prioritise_background() -> str:
    """Give all threads of this process, and those started later, SCHED_FIFO priority below all others of the stack.

    What is not part of the stack cannot keep it from its work then. It has to sleep most of the time.

    Returns
    -------
    str
        Empty when granted, else a warning for the log.
    """
    return _prioritise(os.listdir("/proc/self/task"), _BACKGROUND_PRIORITY)


def share_heap() -> None:
    """Have all threads of this process allocate from one heap; to be called before there are any.

    glibc gives each thread its own, and what one has freed the others cannot use: they grow for minutes beside tens of
    megabytes that compiling has left. Where there is no glibc this does nothing.
    """
    _mallopt(_M_ARENA_MAX, 1)


def return_large_blocks() -> None:
    """Have this process give memory back as soon as it needs it no more; not where there is no glibc.

    Once a block of a size has been freed, glibc keeps the next ones of that size, in a heap that never gets smaller:
    buffers whose size changes, like those of a recorder, leave ever larger holes in it. It is slower, for page faults.
    """
    _mallopt(_M_MMAP_THRESHOLD, _LARGE_BLOCK)


def _mallopt(parameter: int, value: int) -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(parameter, value)


def come_first() -> None:
    """Take more of the time that real-time threads leave than other programs do, where that is permitted.

    A browser or a compiler on the same machine would otherwise keep the planner from its plans until the arm stops.
    """
    with contextlib.suppress(OSError):
        for thread in os.listdir("/proc/self/task"):
            os.setpriority(os.PRIO_PROCESS, int(thread), _COMPUTING_NICENESS)
        if os.getsid(0) == os.getpid():
            # Where Linux divides its time by sessions, niceness counts only within one.
            Path("/proc/self/autogroup").write_text(str(_COMPUTING_NICENESS))


def give_way() -> None:
    """Lower the calling thread's SCHED_FIFO priority, if it has any, below that of every loop of the stack.

    For what a process does beside its loop: on the same CPU each loop, not only its own, would wait until diagnostics
    are written or the graph is looked at. Linux lets threads of one priority finish, too.
    """
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        priority = min(os.sched_getparam(0).sched_priority - 1, _SERVICES_PRIORITY)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


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


class _Listened(NamedTuple):
    subscription: Subscription
    type: Any
    serialized: bool
    handle: Callable[[Any], None]
    single: bool
    """Whether there is never more than one message to take."""
    code: int
    """What the intake log calls it, 0 for what is not noted."""
    ready: Callable[[], bool] | None
    """Whether the next message may be handled; None where it always may."""


class Inbox:
    """Subscriptions whose messages one loop thread waits for and handles.

    The wait set is built of the same few handles each time, which costs a fraction of an executor's turn. Messages that
    are ready together are handled in the order in which their topics were added, those that nobody hurries for last.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = LoopGroup()
        self._subscriptions: list[_Listened] = []
        self._unhurried: list[_Listened] = []
        self._wake = node.create_guard_condition(lambda: None, callback_group=self._group)
        self._wait_set: Any = None
        self._tasks: deque[Callable[[], None]] = deque()
        self._thread = 0
        self.received_ns = 0
        """When the message being handled came in, on the system clock: before this thread woke up for it."""
        self.handled_ns = 0
        """When it began to be handled, on the steady clock."""
        self.intake: IntakeLog | None = None
        """Notes what is handled, where the node makes it so."""

    def add(
        self,
        topic: Topic,
        handle: Callable[[Any], None],
        qos: QoSProfile | None = None,
        serialized: bool = False,
        ready: Callable[[], bool] | None = None,
        hurried: bool = True,
    ) -> None:
        """Subscribe; `handle` is called in the loop thread.

        Parameters
        ----------
        topic
            What to listen to.
        handle
            Gets each message.
        qos
            Instead of the topic's own when given.
        serialized
            Whether `handle` gets the bytes instead of a message object, which takes most of the time to make.
        ready
            Asked before each message, which is held back for up to two seconds until it says so; those of other topics
            are handled meanwhile.
        hurried
            Whether the thread wakes up for a message. Else it waits for one of another topic, or the end of the wait,
            and is handled after it: one that takes long to handle does not delay the others.
        """
        qos = qos or topic.qos
        subscription = self._node.create_subscription(
            topic.type, topic.name, handle, qos, callback_group=self._group, raw=serialized
        )
        code = int(CODES.get(topic.name, 0))
        listened = _Listened(subscription, topic.type, serialized, handle, qos.depth == 1, code, ready)
        (self._subscriptions if hurried else self._unhurried).append(listened)
        self._wait_set = None

    def wait(self, timeout_ns: int) -> None:
        """Sleep until a message arrives, `wake` is called or the time is over; handle all messages that are there."""
        if self._wait_set is None:
            count = len(self._subscriptions)
            context = self._node.context.handle
            self._wait_set = rclpy_implementation.WaitSet(count, 1, 0, 0, 0, 0, context)
        wait_set = self._wait_set
        wait_set.clear_entities()
        for listened in self._subscriptions:
            wait_set.add_subscription(listened.subscription.handle)
        wait_set.add_guard_condition(self._wake.handle)
        wait_set.wait(max(timeout_ns, 0))
        self.run_tasks()
        for index, listened in enumerate(self._subscriptions):
            if wait_set.is_ready("subscription", index):
                self._handle_all(listened)
        self._handle_unhurried()

    def poll(self) -> None:
        """Handle all messages that are there, without a wait: cheaper where the thread sleeps by the clock anyway."""
        for listened in self._subscriptions:
            self._handle_all(listened)
        self._handle_unhurried()

    def post(self, task: Callable[[], None]) -> None:
        """Have the loop thread do something between two messages; may be called from any thread."""
        self._tasks.append(task)
        self.wake()

    def call(self, task: Callable[[], _T]) -> _T:
        """The same, and wait for the result.

        Raises
        ------
        ContactReachError
            If the task refuses: the loop goes on. Anything else that it raises ends the loop, as any fault there.
        TimeoutError
            If the loop thread is busy for long; it will do it all the same.
        """
        if self._thread in (0, threading.get_ident()):
            return task()
        answer: Future[_T] = Future()

        def run() -> None:
            try:
                answer.set_result(task())
            except ContactReachError as error:
                answer.set_exception(error)

        self.post(run)
        if not wait([answer], timeout=_PATIENCE_S).done:
            raise TimeoutError(f"the loop has not answered for {_PATIENCE_S:g} s")
        return answer.result()

    def run_tasks(self) -> None:
        """Do what was posted; for the loop thread while it does not wait."""
        self._thread = threading.get_ident()
        while self._tasks:
            self._tasks.popleft()()

    def note(self, what: int) -> None:
        """Note a call in the intake log, if there is one."""
        self.handled_ns = time.monotonic_ns()
        if self.intake is not None:
            self.intake.add(what, 0, self.handled_ns)

    def wake(self) -> None:
        """End a wait in the loop thread; may be called from any thread."""
        self._wake.trigger()

    def _handle_unhurried(self) -> None:
        """What can wait until everything else is done."""
        for listened in self._unhurried:
            self._handle_all(listened)
        if self.intake is not None:
            self.intake.publish_full()

    def _handle_all(self, listened: _Listened) -> None:
        """Take all messages, then handle them: those that come meanwhile have to wait, or a slow handler never ends."""
        take, intake = listened.subscription.handle.take_message, self.intake
        taken = []
        while (pair := take(listened.type, listened.serialized)) is not None:
            taken.append(pair)
            if listened.single:
                break
        for message, information in taken:
            if listened.ready is not None:
                self._hold_back(listened.ready)
            self.received_ns = information["received_timestamp"]
            self.handled_ns = time.monotonic_ns()
            if intake is not None and listened.code:
                intake.add(listened.code, information["source_timestamp"], self.handled_ns)
            listened.handle(message)

    def _hold_back(self, ready: Callable[[], bool]) -> None:
        """Handle what else comes until the next message may be handled."""
        others = [other for other in self._subscriptions if other.ready is None]
        deadline = time.monotonic() + _PATIENCE_S
        while not ready() and time.monotonic() < deadline:
            time.sleep(_HOLD_S)
            for other in others:
                self._handle_all(other)
