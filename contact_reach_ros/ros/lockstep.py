"""Lockstep: simulated time that advances only when every node is done with the last joint state.

A `lockstep/horizon` message is a promise: the node's name, and the time up to which all its messages are out. The
driver publishes a state when all have promised up to it, and the nodes handle it in turns: observer, planner,
controller, adapter. So each node has everything that others made of a state, and nothing of the next one: a run depends
neither on how busy the machine is nor on which of two messages is faster.

Other nodes may take part, such as the recorder, which must not fall behind: driver and nodes wait for all who have ever
promised.

Time begins when everybody hears everybody. Each node makes publisher and subscription of promises last, and they are
discovered in that order: who hears a promise receives all that its sender sends from then on. An active node promises
up to zero. When the driver has heard that of all, it publishes the first state, once, as it is kept for those who come
late. A node promises up to this state when it has heard all others, and handles it when all have promised up to it.
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
"""Nodes that every stack has: everybody waits for them."""
FOREVER_NS = (2**31 - 1) * NANOSECONDS
"""What a node promises that has nothing to say any more."""
_UNHEARD_NS = -1

_LOOK_NS = 20_000_000
_START_NS = 300 * NANOSECONDS
"""Longest time for nodes to start: the first time the planner compiles its program."""
_PATIENCE_NS = 30 * NANOSECONDS


def promise(name: str, until_ns: int) -> Header:
    """The message by which a node promises that all its messages that take effect up to a time are out."""
    return Header(stamp=to_time(until_ns), frame_id=name)


class Lockstep:
    """The side of a node that follows the joint states.

    Parameters
    ----------
    name
        Of the node.
    tick_ns
        Time from one joint state to the next, ns.
    publish
        Publishes on `lockstep/horizon`.
    others
        Nodes that this one waits for, besides those that every stack has.
    """

    def __init__(self, name: str, tick_ns: int, publish: Callable[[Header], None], others: Sequence[str] = ()) -> None:
        self._name = name
        self._tick_ns = tick_ns
        self._publish = publish
        self._promised_ns = _UNHEARD_NS
        self._horizons = {other: _UNHEARD_NS for other in (*_ALWAYS, *others) if other != name}
        self._earlier = _TURNS[: _TURNS.index(name)] if name in _TURNS else _TURNS

    def promise(self, until_ns: int) -> None:
        """Promise that all messages that take effect up to a time are out."""
        self._promised_ns = until_ns
        self._publish(promise(self._name, until_ns))

    def join(self) -> None:
        """Promise what was promised last, as a node that has become active; at first up to zero, to be heard."""
        self.promise(max(self._promised_ns, 0))

    def done(self, stamp_ns: int) -> None:
        """Promise that all messages that follow from a state are out."""
        self.promise(stamp_ns + self._tick_ns)

    def hear(self, message: Header) -> None:
        """Take the promise of another node."""
        name = message.frame_id
        if name != self._name:
            # A promise holds when a later message names an earlier time, as after the driver's clock was set back.
            self._horizons[name] = max(nanoseconds(message.stamp), self._horizons.get(name, _UNHEARD_NS))

    def may_handle(self, stamp_ns: int) -> bool:
        """Return whether it is this node's turn with a state that has come.

        Those whose turn is earlier must be done with it, and others that take part with the one before.
        """
        if self._promised_ns < stamp_ns and _UNHEARD_NS not in self._horizons.values():
            self.promise(stamp_ns)
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
        self._horizons = dict.fromkeys(_ALWAYS, _UNHEARD_NS)

    def hear(self, message: Header) -> None:
        """Take a promise."""
        self._horizons[message.frame_id] = nanoseconds(message.stamp)

    def begin(self) -> None:
        """Wait, before the first state, until everybody who takes part has promised something.

        Raises `ContactReachError` if a node does not within 300 s; it is named.
        """

        def missing() -> list[str]:
            unknown = self._participants() - len(self._horizons)
            return self._silent(0) or [f"{unknown} more that publish on lockstep/horizon"] * (unknown > 0)

        self._wait(missing, _START_NS, "start it with use_sim_time: true, or see its log")

    def wait(self, stamp_ns: int) -> None:
        """Wait until every node is done with the state that has this stamp.

        Raises `ContactReachError` if a node is silent for 30 s; it is named.
        """
        self._wait(lambda: self._silent(stamp_ns + self._tick_ns), _PATIENCE_NS, "see the node's log")

    def stand_still(self, is_wanted: Callable[[], bool]) -> None:
        """Handle messages while something is awaited for as long as it takes."""
        while is_wanted() and not self._ended():
            self._handle(_LOOK_NS)

    def _silent(self, until_ns: int) -> list[str]:
        """Names of the nodes that have not promised up to a time."""
        return [name for name, horizon_ns in self._horizons.items() if horizon_ns < until_ns]

    def _wait(self, missing: Callable[[], list[str]], patience_ns: int, remedy: str) -> None:
        began_ns = self._clock()
        while (silent := missing()) and not self._ended():
            if self._clock() - began_ns > patience_ns:
                seconds = patience_ns // NANOSECONDS
                raise ContactReachError(f"lockstep: no answer from {', '.join(silent)} for {seconds} s; {remedy}")
            self._handle(_LOOK_NS)
