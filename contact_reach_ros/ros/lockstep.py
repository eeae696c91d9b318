"""Lockstep: simulated time that advances only when every node is done with the last joint state.

The driver publishes a state, and the nodes handle it in turns: observer, then planner, then controller. Each
is done when all its messages that follow from the state are out. Observer and planner promise that, with a
`lockstep/horizon` message: the node's name, and the time up to which it holds. The controller answers, with or without
a command. So each node has everything that others made of a state, and nothing of the next one: a run depends neither
on how busy the machine is nor on which of two messages is faster.

Other nodes may take part, such as the demo, which sends its goal at a certain state, or the recorder, which must not
fall behind: the driver's parameter `waits_for` names those whose promises it waits for as well, and the nodes wait for
everybody who has ever promised.

Each node has one object for this; in real time it publishes nothing and waits for nobody.

An adapter between controller and driver passes each command on, or answers for the controller where there is none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence

from std_msgs.msg import Header

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import set_time
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.timing import NANOSECONDS, StampOrder

CONTROLLER = "controller"
BEHIND_ADAPTER = "controller behind adapter"
"""Whose answers the adapter receives, and the driver does not count."""
PROMISING = ("observer", "planner")
"""Nodes whose promises the driver waits for, in the order of their turns."""
_TURNS = (*PROMISING, CONTROLLER, BEHIND_ADAPTER)
FOREVER_NS = (2**31 - 1) * NANOSECONDS
"""What a node promises that has nothing to say any more."""

_REPEAT_NS = 20_000_000
_REPETITIONS = 100
_PATIENCE_NS = 30 * NANOSECONDS


class Lockstep:
    """The side of every node but the driver.

    Parameters
    ----------
    name
        Of the node.
    tick_ns
        Time from one joint state to the next, ns.
    publish
        Publishes on `lockstep/horizon`; None in real time.

    Attributes
    ----------
    active
        Whether time is in lockstep.
    qos
        What to request for joint states and commands: every one, or in real time the newest.
    """

    def __init__(self, name: str, tick_ns: int, publish: Callable[[Header], None] | None) -> None:
        self.active = publish is not None
        self.qos = topics.EVERY if self.active else topics.NEWEST
        self._name = name
        self._tick_ns = tick_ns
        self._publish_header = publish
        # The observer decides when the arm starts; a planner makes no difference before it has ever promised.
        first, *_ = PROMISING
        self._horizons = {} if name == first else {first: 0} if name in _TURNS else dict.fromkeys(PROMISING, 0)
        self._first_ns: int | None = None
        self._repeated = 0

    def done(self, stamp_ns: int) -> None:
        """Promise that all messages that follow from a state are out; repeated for a state that comes again."""
        self.promise(stamp_ns + self._tick_ns)

    def promise(self, until_ns: int) -> None:
        """Promise that all messages that take effect up to a time are out."""
        self._publish(until_ns)

    def answer(self, stamp_ns: int) -> None:
        """Answer a state without a command."""
        self._publish(stamp_ns)

    def time_stands(self, stamp_ns: int) -> bool:
        """Return whether a state is the first one, which the driver repeats; for so long that all should be there."""
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        self._repeated += stamp_ns == self._first_ns
        return stamp_ns == self._first_ns and self._repeated <= _REPETITIONS

    def hear(self, message: Header) -> None:
        """Take the promise of another node."""
        name = message.frame_id
        if name not in (self._name, CONTROLLER, BEHIND_ADAPTER):
            # A promise holds when a later message names an earlier time, as after the driver's clock was set back.
            self._horizons[name] = max(nanoseconds(message.stamp), self._horizons.get(name, 0))

    def may_handle(self, stamp_ns: int) -> bool:
        """Return whether it is this node's turn with a state.

        Those whose turn is earlier must be done with it, and others that take part with the one before.
        """
        return not self.active or all(
            horizon_ns > stamp_ns or (horizon_ns == stamp_ns and name not in PROMISING)
            for name, horizon_ns in self._horizons.items()
        )

    def _publish(self, horizon_ns: int) -> None:
        if self._publish_header is not None:
            header = Header(frame_id=self._name)
            set_time(header.stamp, horizon_ns)
            self._publish_header(header)


class LockstepDriver:
    """The driver's side.

    Parameters
    ----------
    active
        Whether time is in lockstep. In real time only the answers are counted.
    tick_ns
        Time from one joint state to the next, ns.
    waits_for
        Nodes that take part besides observer, planner and controller.
    clock
        Steady time, ns.

    Attributes
    ----------
    active
        As given.
    qos
        What to request for commands: every one, or in real time the newest.
    unanswered
        States that were published last and that the controller has not answered.
    """

    def __init__(
        self, active: bool, tick_ns: int, waits_for: Sequence[str] = (), clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.active = active
        self.qos = topics.EVERY if active else topics.NEWEST
        self.unanswered = 1
        self._tick_ns = tick_ns
        self._clock = clock
        self._order = StampOrder()
        self._horizons = dict.fromkeys((*PROMISING, *waits_for), 0)
        self._due_ns = 0

    def expect(self, stamps_ns: Iterable[int]) -> None:
        """Wait for answers to states with these stamps, which are about to be published, instead of earlier ones.

        A state that is lost, or that everybody refuses, must not be among them: nobody would answer it.
        """
        self.unanswered = self._due_ns = 0
        for stamp_ns in stamps_ns:
            # The controller answers only new states, by the same rule; promises are repeated for the others.
            self.unanswered += self._order.is_new(stamp_ns)
            self._due_ns = stamp_ns + self._tick_ns

    def answered(self) -> bool:
        """Count an answer of the controller; False if there was nothing to answer."""
        expected = self.unanswered > 0
        self.unanswered -= expected
        return expected

    def hear(self, message: Header) -> None:
        """Take a promise, or the controller's answer without a command."""
        if message.frame_id == CONTROLLER:
            self.answered()
        elif message.frame_id in self._horizons:
            self._horizons[message.frame_id] = nanoseconds(message.stamp)

    @property
    def silent(self) -> list[str]:
        """Names of the nodes that are not done with the last state."""
        names = [name for name, horizon_ns in self._horizons.items() if horizon_ns < self._due_ns]
        return [*names, CONTROLLER] if self.unanswered > 0 else names

    def wait(
        self, handle: Callable[[int], None], ended: Callable[[], bool], repeat: Callable[[], None] | None = None
    ) -> bool:
        """Wait until every node is done with the last state.

        Raises `ContactReachError` if a node is silent for 30 s; it is named.

        Parameters
        ----------
        handle
            Handles messages until one has come or for so many ns, as `Inbox.wait`.
        ended
            Whether to give up.
        repeat
            Publishes the state again, called every 20 ms; for the first state, which nodes that are still starting have
            not received, and which is waited for without limit.

        Returns
        -------
        bool
            False if it gave up.
        """
        began_ns = repeated_ns = self._clock()
        while self.silent:
            handle(_REPEAT_NS)
            if ended():
                return False
            now_ns = self._clock()
            if repeat is None:
                if now_ns - began_ns > _PATIENCE_NS:
                    raise ContactReachError(
                        f"lockstep: no answer from {', '.join(self.silent)} for {_PATIENCE_NS // NANOSECONDS} s; "
                        "see the node's log"
                    )
            elif now_ns - repeated_ns > _REPEAT_NS:
                repeated_ns, unanswered = now_ns, self.unanswered
                repeat()
                # A controller that has answered the state does not answer it again.
                self.unanswered = unanswered
        return True
