"""What a loop thread wakes up for, and in which order it handles what has come."""

import threading
import time
from collections.abc import Iterator

import pytest
import rclpy
from rclpy.node import Node
from stack_helpers import ros, wait_for
from std_msgs.msg import String

from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.inbox import Inbox, qos_profile

HURRIED, UNHURRIED = Topic("hurried", String), Topic("unhurried", String)
HELD, OTHER = Topic("held", String), Topic("other", String)
WAIT_NS = 1_000_000_000


def refused(what: str, error: Exception) -> None:
    raise error


@pytest.fixture
def node() -> Iterator[Node]:
    with ros():
        yield rclpy.create_node("inbox")


def test_what_nobody_hurries_for_does_not_wake_the_loop_and_comes_last(node: Node) -> None:
    handled: list[str] = []
    inbox = Inbox(node, refused)
    for topic, hurried in ((UNHURRIED, False), (HURRIED, True)):
        inbox.add(topic, lambda message: handled.append(message.data), hurried=hurried)
    hurried, unhurried = (
        node.create_publisher(topic.type, topic.name, qos_profile(topic.qos)) for topic in (HURRIED, UNHURRIED)
    )
    wait_for(lambda: hurried.get_subscription_count() and unhurried.get_subscription_count(), 10, "both are heard")

    def wait_for_message() -> float:
        began = time.monotonic_ns()
        inbox.wait(WAIT_NS)
        return (time.monotonic_ns() - began) / WAIT_NS

    hurried.publish(String(data="first"))
    assert wait_for_message() < 0.9
    unhurried.publish(String(data="second"))
    assert wait_for_message() > 0.9
    assert handled == ["first", "second"]
    # Sent the other way round: the one that was there before waits for the one that wakes the loop.
    unhurried.publish(String(data="fourth"))
    hurried.publish(String(data="third"))
    assert wait_for_message() < 0.9
    assert handled[2] == "third"
    wait_for(lambda: inbox.poll() or len(handled) == 4, 10, "the other one is handled, too")
    unhurried.publish(String(data="fifth"))
    wait_for(lambda: inbox.poll() or len(handled) == 5, 10, "whoever does not wait handles it as well")
    assert handled[3:] == ["fourth", "fifth"]


def test_what_is_held_back_comes_after_all_that_was_sent_before_it_may_be_handled(node: Node) -> None:
    """Also after what comes while the others are looked for; calls are carried out meanwhile."""
    handled: list[str] = []
    inbox = Inbox(node, refused)
    others = node.create_publisher(OTHER.type, OTHER.name, qos_profile(OTHER.qos))

    def ready(_: bytes) -> bool:
        if "third" in handled:
            # Unnoticed by whoever only looks at what was there before.
            others.publish(String(data="fourth"))
            wait_for(lambda: others.wait_for_all_acked(), 10, "it has arrived")
            return True
        return False

    inbox.add(HELD, lambda message: handled.append(message.data), ready=ready)
    inbox.add(OTHER, lambda message: handled.append(message.data))
    held = node.create_publisher(HELD.type, HELD.name, qos_profile(HELD.qos))
    wait_for(lambda: held.get_subscription_count() and others.get_subscription_count(), 10, "both are heard")
    held.publish(String(data="fifth"))
    others.publish(String(data="first"))
    inbox.post(lambda: handled.append("second"))
    threading.Timer(0.2, lambda: others.publish(String(data="third"))).start()
    inbox.wait(WAIT_NS)
    assert sorted(handled[:2]) == ["first", "second"] and handled[2:] == ["third", "fourth", "fifth"]


def test_what_a_task_raises_reaches_who_asked_for_it_and_not_the_loop(node: Node) -> None:
    inbox = Inbox(node, refused)
    ended, turns = threading.Event(), []

    def loop() -> None:
        while not ended.is_set():
            inbox.wait(WAIT_NS // 10)
            turns.append(None)

    def refuse() -> None:
        raise InputError("the arm moves")

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        wait_for(lambda: turns, 10, "the loop runs")
        with pytest.raises(InputError, match="the arm moves"):
            inbox.call(refuse)
        assert inbox.call(lambda: 3) == 3
        before = len(turns)
        wait_for(lambda: len(turns) > before, 10, "the loop goes on")
    finally:
        ended.set()
        thread.join()
