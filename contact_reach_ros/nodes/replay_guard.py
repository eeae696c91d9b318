"""What keeps a replay from moving an arm that is really there.

Recorded commands, references and goals look like live ones, and a controller that hears recorded joint states commands
the arm it has for states that it is not in. So a replay first looks who listens, keeps looking, and before each message
asks its publisher whether somebody new would get it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.errors import InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.discovery import wait_until_settled
from contact_reach_ros.nodes.hearing import UNKNOWN_NODE
from contact_reach_ros.nodes.interfaces import ACTING, ALONE, COMMANDING, INTERFACES
from contact_reach_ros.nodes.topics import Topic

_WATCHING = frozenset(INTERFACES) - frozenset(ACTING)
_LEADING = (topics.COMMANDS, topics.REFERENCE_POSE, topics.REFERENCE_POSTURE)
"""Who publishes one of these acts on what it hears."""

_UNNAMED = f"/{UNKNOWN_NODE}"
_UNNAMED_S = 3.0
"""After this time a node without a name is taken for one that acts."""

_LOOK_S = 0.02


class Endpoints(NamedTuple):
    """Full names of the nodes that publish and hear a topic, those of the replay aside."""

    publishers: frozenset[str]
    listeners: frozenset[str]


def objections(replayed: Collection[str], graph: Mapping[str, Endpoints]) -> list[str]:
    """Why these topics must not be replayed here, one line each; empty if nothing speaks against it.

    Parameters
    ----------
    replayed :
        Full names of topics.
    graph :
        Who publishes and hears them, and the topics of the stack in the same namespaces.
    """
    leaders = {
        node
        for name, endpoints in graph.items()
        for node in endpoints.publishers
        if _is_any(name, _LEADING) and _is_stranger(node)
    }
    drivers = {
        node
        for name, endpoints in graph.items()
        for node in endpoints.listeners
        if _is_any(name, [topics.COMMANDS]) and _is_stranger(node)
    }
    found = []
    for name in sorted(replayed):
        publishers, listeners = graph.get(name, Endpoints(frozenset(), frozenset()))
        if _is_any(name, COMMANDING):
            acting = sorted(node for node in listeners if _is_stranger(node))
            reason = "could move an arm by what was recorded"
        else:
            acting = sorted(node for node in listeners if node in leaders | drivers or _basename(node) in ACTING)
            reason = "would command its arm for what was recorded, not for what is"
        if acting:
            found.append(f"{name} is heard by {', '.join(acting)}, which {reason}")
        elif publishers and _is_any(name, ALONE):
            found.append(f"{name} is published by {', '.join(sorted(publishers))}: live and recorded would be mixed")
    return found


class Watch:
    """Looks who publishes and hears the replayed topics; for several threads.

    Asking for one topic keeps the interpreter busy for a tenth of a millisecond, so that a look at all of them would
    make messages late.

    Parameters
    ----------
    node :
        The one that replays.
    replayed :
        Full names of topics.
    """

    def __init__(self, node: Node, replayed: Collection[str]) -> None:
        self._node = node
        self._replayed = frozenset(replayed)
        self._names = sorted({*replayed, *_related(replayed)})
        self._graph: dict[str, Endpoints] = {}
        self._admitted = dict.fromkeys(replayed, 0)
        self._next = 0
        self._complete_at = time.monotonic()
        self._lock = threading.Lock()

    def settle(self, ended: Callable[[], bool]) -> None:
        """Look at all topics until nothing new has been found for a while and every node has a name.

        Parameters
        ----------
        ended :
            Whether to leave it.

        Raises
        ------
        InputError
            If something there would act on what is replayed.
        """

        def look() -> dict[str, Endpoints]:
            self._look_all()
            return dict(self._graph)

        wait_until_settled(
            look, lambda: time.sleep(_LOOK_S), complete=lambda graph: without_unnamed(graph) == graph, ended=ended
        )
        self._judge(self._graph)

    def check_next(self) -> None:
        """Look at one topic, another one each time.

        Raises
        ------
        InputError
            If something there would act on what is replayed.
        """
        with self._lock:
            self._look(self._names[self._next])
            self._next = (self._next + 1) % len(self._names)
            now = time.monotonic()
            named = without_unnamed(self._graph)
            if named == self._graph:
                self._complete_at = now
            self._judge(self._graph if now - self._complete_at > _UNNAMED_S else named)

    def admit(self, name: str, publisher: Publisher) -> None:
        """Before a message: who would get it has to be known, and not act on it.

        A message reaches those alone that the publisher is matched with, which costs little to ask. Where there are
        more of them than before, this waits until they have names.

        Parameters
        ----------
        name :
            Full name of the topic.
        publisher :
            The replay's own.

        Raises
        ------
        InputError
            If one of them would act on it.
        """
        matched = publisher.get_subscription_count()
        if matched > self._admitted[name]:
            deadline = time.monotonic() + _UNNAMED_S
            self._look_all()
            while time.monotonic() < deadline and not self._is_known(name):
                time.sleep(_LOOK_S)
                self._look_all()
            self._judge(self._graph)
        self._admitted[name] = matched

    def _is_known(self, name: str) -> bool:
        """Whether there is somebody who hears a topic, and everybody has a name."""
        return bool(self._graph[name].listeners) and without_unnamed(self._graph) == self._graph

    def _look_all(self) -> None:
        with self._lock:
            for name in self._names:
                self._look(name)

    def _look(self, name: str) -> None:
        own = self._node.get_fully_qualified_name()
        self._graph[name] = Endpoints(
            _full_names(self._node.get_publishers_info_by_topic(name)) - {own},
            _full_names(self._node.get_subscriptions_info_by_topic(name)) - {own},
        )

    def _judge(self, graph: Mapping[str, Endpoints]) -> None:
        found = objections(self._replayed, graph)
        if found:
            raise InputError(
                f"{'; '.join(found)}. End the running stack, replay in another ROS_DOMAIN_ID, leave these topics out "
                "(--topics), or, if all of them shall act on it, say --allow-motion"
            )


def without_unnamed(graph: Mapping[str, Endpoints]) -> dict[str, Endpoints]:
    """Only the nodes whose names are known: endpoints are found before them."""
    return {
        name: Endpoints(*(frozenset(node for node in nodes if not node.endswith(_UNNAMED)) for nodes in endpoints))
        for name, endpoints in graph.items()
    }


def _related(replayed: Iterable[str]) -> set[str]:
    """The topics that tell who acts, in the namespaces of the replayed ones and in the root."""
    spaces = {""}
    for name in replayed:
        spaces |= {name.removesuffix(f"/{topic.name}") for topic in topics.ALL if _is(name, topic)}
    return {f"{space}/{topic.name}" for space in spaces for topic in _LEADING}


def _is(name: str, topic: Topic) -> bool:
    return name.endswith(f"/{topic.name}")


def _is_any(name: str, wanted: Iterable[Topic]) -> bool:
    return any(_is(name, topic) for topic in wanted)


def _is_stranger(node: str) -> bool:
    """Whether a node is none of those that only watch."""
    return _basename(node) not in _WATCHING


def _basename(node: str) -> str:
    return node.rpartition("/")[2]


def _full_names(endpoints: Iterable[TopicEndpointInfo]) -> frozenset[str]:
    return frozenset(f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}" for endpoint in endpoints)
