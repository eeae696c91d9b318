"""Keeps a replay from moving a running arm: nothing is replayed where any part of a stack runs.

Recorded commands, references and goals look like live ones, and a controller that hears recorded joint states commands
its arm for states that it is not in.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import NamedTuple

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.discovery import wait_until_settled
from contact_reach_ros.ros.graph import UNKNOWN_NODE, node_of
from contact_reach_ros.ros.interfaces import ACTING, ALONE, COMMANDING, INTERFACES

_WATCHING = frozenset(INTERFACES) - frozenset(ACTING)
_STACK_TOPICS = frozenset({*ALONE, *COMMANDING})
"""Topics by which a stack is recognised, whatever its nodes are called."""

_NAMED_S = 3.0
"""After this time a node that still has no name counts as a stranger."""
_LOOK_S = 0.02


class Endpoints(NamedTuple):
    """Full names of the nodes that publish and hear a topic, the replay's own aside."""

    publishers: frozenset[str]
    listeners: frozenset[str]


def signs_of_a_stack(graph: Mapping[str, Endpoints]) -> list[str]:
    """What shows that a part of a stack runs, one line for each topic.

    Parameters
    ----------
    graph
        Who publishes and hears the replayed topics, and those that command an arm.
    """
    signs = []
    for name, (publishers, listeners) in sorted(graph.items()):
        acting = {node for node in listeners if _basename(node) in ACTING}
        if topics.find(name, COMMANDING):
            acting |= {node for node in listeners if _basename(node) not in _WATCHING}
        if acting:
            signs.append(f"{name} is heard by {', '.join(sorted(acting))}")
        elif publishers and topics.find(name, ALONE):
            signs.append(f"{name} is published by {', '.join(sorted(publishers))}")
    return signs


class Guard:
    """Refuses to replay where any part of a stack runs.

    Parameters
    ----------
    node
        The one that replays.
    replayed
        Full names of topics.
    """

    def __init__(self, node: Node, replayed: Collection[str]) -> None:
        self._node = node
        self._replayed = frozenset(replayed)
        self._admitted = dict.fromkeys(replayed, 0)
        self._to_look_at: list[str] = []

    def settle(self, ended: Callable[[], bool]) -> None:
        """Look at all topics until nothing new has been found for a while, or until `ended` returns True.

        Raises `InputError` if any part of a stack runs.
        """
        wait_until_settled(self._look_at_all, lambda: time.sleep(_LOOK_S), complete=_are_named, ended=ended)
        _refuse(self._look_at_all())

    def check_next(self) -> None:
        """Look at one topic, another one each time: a look at all of them would make messages late.

        Raises `InputError` if any part of a stack runs.
        """
        self._to_look_at = self._to_look_at or self._names()
        name = self._to_look_at.pop()
        # Nodes without a name are judged before they receive a message.
        _refuse({name: Endpoints(*map(_named, self._look_at(name)))})

    def admit(self, name: str, publisher: Publisher) -> None:
        """Judge new subscribers of a topic before a message goes to them, once they have names.

        Raises `InputError` if any part of a stack runs.
        """
        # A message reaches only subscribers that the publisher is matched with, and to count those is cheap.
        matched = publisher.get_subscription_count()
        if matched > self._admitted[name]:
            deadline = time.monotonic() + _NAMED_S
            graph = self._look_at_all()
            while not (graph[name].listeners and _are_named(graph)) and time.monotonic() < deadline:
                time.sleep(_LOOK_S)
                graph = self._look_at_all()
            _refuse(graph)
        self._admitted[name] = matched

    def _names(self) -> list[str]:
        present = (name for name, _ in self._node.get_topic_names_and_types())
        return sorted(self._replayed.union(name for name in present if topics.find(name, _STACK_TOPICS)))

    def _look_at_all(self) -> dict[str, Endpoints]:
        return {name: self._look_at(name) for name in self._names()}

    def _look_at(self, name: str) -> Endpoints:
        return Endpoints(
            self._full_names(self._node.get_publishers_info_by_topic(name)),
            self._full_names(self._node.get_subscriptions_info_by_topic(name)),
        )

    def _full_names(self, endpoints: Iterable[TopicEndpointInfo]) -> frozenset[str]:
        return frozenset(map(node_of, endpoints)) - {self._node.get_fully_qualified_name()}


def _refuse(graph: Mapping[str, Endpoints]) -> None:
    signs = signs_of_a_stack(graph)
    if signs:
        raise InputError(
            f"an arm could move by what was recorded: {'; '.join(signs)}. End the running stack, replay in another "
            "ROS_DOMAIN_ID, or, if the arm may move, pass --allow-motion"
        )


def _basename(node: str) -> str:
    return node.rpartition("/")[2]


def _named(nodes: frozenset[str]) -> frozenset[str]:
    """Nodes whose names are known: endpoints are discovered before them."""
    return frozenset(node for node in nodes if _basename(node) != UNKNOWN_NODE)


def _are_named(graph: Mapping[str, Endpoints]) -> bool:
    return all(nodes == _named(nodes) for found in graph.values() for nodes in found)
