"""Lockstep: simulated time that advances only when every node is done with the last joint state.

The driver publishes a state, and the nodes handle it in turns: observer, planner, controller, adapter. Each promises
with a `lockstep/horizon` message, the node's name and the time up to which it holds, that all its messages that follow
from the state are out. So each node has everything that others made of a state, and nothing of the next one: a run
depends neither on how busy the machine is nor on which of two messages is faster.

Other nodes may take part, such as the recorder, which must not fall behind. Time begins when everybody who publishes on
`lockstep/horizon` has promised, and driver and nodes wait for all who have ever promised.

In real time nobody promises or waits.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from std_msgs.msg import Header

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages.conversions import to_time
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.timing import NANOSECONDS

_TURNS = ("observer", "planner", "controller", "adapter")
"""Nodes in the order in which they handle a state; all others may send what takes effect with the next one."""
_ALWAYS = _TURNS[:3]
"""Nodes that every stack has: the driver waits for them."""
_FIRST = {"observer": (), "planner": ("observer",), "controller": ("observer",), "adapter": ()}
"""Nodes that one waits for before they have ever promised: the observer decides when the arm starts."""
FOREVER_NS = (2**31 - 1) * NANOSECONDS
"""What a node promises that has nothing to say any more."""

_REPEAT_NS = 20_000_000
_REPETITIONS = 100
"""Repetitions of the first state, once all are done with it, after which time begins without a command."""
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
    after
        Nodes whose first promise this one waits for, besides those that it always waits for.
    """

    def __init__(
        self, name: str, tick_ns: int, publish: Callable[[Header], None] | None, after: Sequence[str] = ()
    ) -> None:
        self._name = name
        self._tick_ns = tick_ns
        self._publish = publish
        self._horizons = dict.fromkeys((*_FIRST.get(name, _ALWAYS), *after), 0)
        self._earlier = _TURNS[: _TURNS.index(name)] if name in _TURNS else _TURNS

    def done(self, stamp_ns: int) -> None:
        """Promise that all messages that follow from a state are out; repeated for a state that comes again."""
        self.promise(stamp_ns + self._tick_ns)

    def promise(self, until_ns: int) -> None:
        """Promise that all messages that take effect up to a time are out."""
        if self._publish is not None:
            self._publish(Header(stamp=to_time(until_ns), frame_id=self._name))

    def hear(self, message: Header) -> None:
        """Take the promise of another node."""
        name = message.frame_id
        if name != self._name:
            # A promise holds when a later message names an earlier time, as after the driver's clock was set back.
            self._horizons[name] = max(nanoseconds(message.stamp), self._horizons.get(name, 0))

    def may_handle(self, stamp_ns: int) -> bool:
        """Return whether it is this node's turn with a state.

        Those whose turn is earlier must be done with it, and others that take part with the one before.
        """
        return all(
            horizon_ns > stamp_ns or (horizon_ns == stamp_ns and name not in self._earlier)
            for name, horizon_ns in self._horizons.items()
        )


class LockstepDriver:
    """The driver's side.

    Parameters
    ----------
    tick_ns
        Time from one joint state to the next, ns.
    participants
        How many nodes publish on `lockstep/horizon`.
    handle
        Handles messages until one has come or for so many ns, as `Inbox.wait`.
    ended
        Whether to give up.
    clock
        Steady time, ns.
    """

    def __init__(
        self,
        tick_ns: int,
        participants: Callable[[], int],
        handle: Callable[[int], None],
        ended: Callable[[], bool],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._tick_ns = tick_ns
        self._handle = handle
        self._ended = ended
        self._clock = clock
        self._participants = participants
        self._horizons = dict.fromkeys(_ALWAYS, 0)
        self._due_ns = 0

    def expect(self, stamp_ns: int) -> None:
        """Wait for promises about the state with this stamp, which is about to be published."""
        self._due_ns = stamp_ns + self._tick_ns

    def hear(self, message: Header) -> None:
        """Take a promise."""
        self._horizons[message.frame_id] = nanoseconds(message.stamp)

    @property
    def silent(self) -> list[str]:
        """Names of the nodes that are not done with the last state."""
        return [name for name, horizon_ns in self._horizons.items() if horizon_ns < self._due_ns]

    def wait(self) -> None:
        """Wait until every node is done with the last state.

        Raises `ContactReachError` if a node is silent for 30 s; it is named.
        """
        began_ns = self._clock()
        while self.silent and not self._ended():
            self._handle(_REPEAT_NS)
            if self._clock() - began_ns > _PATIENCE_NS:
                raise ContactReachError(
                    f"lockstep: no answer from {', '.join(self.silent)} for {_PATIENCE_NS // NANOSECONDS} s; "
                    "see the node's log"
                )

    def begin(self, moves: Callable[[], bool], repeat: Callable[[], None]) -> None:
        """Wait until every node is done with the first state and commands come.

        Nodes that are still starting are waited for without limit. How often the state is repeated until the observer
        confirms the states depends on the machine, so time stands still until then, for about 2 s at most.

        Parameters
        ----------
        moves
            Whether a command has come.
        repeat
            Publishes the state again, called every 20 ms: nodes that start late have not received it.
        """
        repeated_ns, left = self._clock(), _REPETITIONS
        while not self._ended():
            are_all_done = not self.silent and len(self._horizons) >= self._participants()
            if are_all_done and (left == 0 or moves()):
                return
            self._handle(_REPEAT_NS)
            if self._clock() - repeated_ns > _REPEAT_NS:
                repeated_ns = self._clock()
                left -= are_all_done
                repeat()

    def stand_still(self, is_wanted: Callable[[], bool]) -> None:
        """Handle messages while something is awaited for as long as it takes."""
        while is_wanted() and not self._ended():
            self._handle(_REPEAT_NS)
