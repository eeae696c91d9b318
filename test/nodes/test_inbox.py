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

FIRST, SECOND = (Topic(name, "std_msgs/msg/String") for name in ("first", "second"))
WAIT_NS = 1_000_000_000


def refused(what: str, error: Exception) -> None:
    raise error


@pytest.fixture
def node() -> Iterator[Node]:
    with ros():
        yield rclpy.create_node("inbox")


def publishers(node: Node):
    """Of both topics, which the inbox hears."""
    made = [node.create_publisher(topic.type, topic.name, qos_profile(topic.qos)) for topic in (FIRST, SECOND)]
    wait_for(lambda: all(each.get_subscription_count() for each in made), 10, "both are heard")
    return made


def test_what_nobody_hurries_for_does_not_wake_the_loop_and_comes_last(node: Node) -> None:
    handled: list[str] = []
    inbox = Inbox(node, refused)
    inbox.add(FIRST, lambda message: handled.append(message.data))
    inbox.add(SECOND, lambda message: handled.append(message.data), hurried=False)
    hurried, unhurried = publishers(node)

    def wakes() -> bool:
        began = time.monotonic_ns()
        inbox.wait(WAIT_NS)
        return time.monotonic_ns() - began < 0.9 * WAIT_NS

    hurried.publish(String(data="first"))
    assert wakes()
    unhurried.publish(String(data="second"))
    assert not wakes()
    # Sent the other way round: the one that was there before waits for the one that wakes the loop.
    unhurried.publish(String(data="fourth"))
    hurried.publish(String(data="third"))
    assert wakes() and handled[:3] == ["first", "second", "third"]
    wait_for(lambda: inbox.poll() or len(handled) == 4, 10, "a loop that does not wait handles the other one as well")


def test_what_is_held_back_comes_after_all_that_was_sent_before_it_may_be_handled(node: Node) -> None:
    """Also after what comes while the others are looked for; calls are carried out meanwhile."""
    handled: list[str] = []
    inbox = Inbox(node, refused)

    def ready(_: bytes) -> bool:
        if "third" in handled:
            # Unnoticed by a look at what was there before.
            others.publish(String(data="fourth"))
            wait_for(lambda: others.wait_for_all_acked(), 10, "it has arrived")
            return True
        return False

    inbox.add(FIRST, lambda message: handled.append(message.data), ready=ready)
    inbox.add(SECOND, lambda message: handled.append(message.data))
    held, others = publishers(node)
    held.publish(String(data="fifth"))
    others.publish(String(data="first"))
    inbox.post(lambda: handled.append("second"))
    threading.Timer(0.2, lambda: others.publish(String(data="third"))).start()
    inbox.wait(WAIT_NS)
    assert sorted(handled[:2]) == ["first", "second"] and handled[2:] == ["third", "fourth", "fifth"]


def test_what_a_task_raises_reaches_who_asked_for_it_and_not_the_loop(node: Node) -> None:
    inbox, ended = Inbox(node, refused), threading.Event()

    def loop() -> None:
        while not ended.is_set():
            inbox.wait(WAIT_NS // 10)

    def refuse() -> None:
        raise InputError("the arm moves")

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        with pytest.raises(InputError, match="the arm moves"):
            inbox.call(refuse)
        assert inbox.call(lambda: 3) == 3
    finally:
        ended.set()
        thread.join()
