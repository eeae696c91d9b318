"""Who stops and releases the arm when some nodes do not answer, or refuse."""

from types import SimpleNamespace

import pytest

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.ros.stopping import release, release_all, stop_arm


class Stack:
    """Nodes that answer, refuse or are missing; the rest is missing."""

    def __init__(self, **answers):
        self.answers = answers
        self.called = []

    def __call__(self, service):
        name, _, _ = service.partition("/")
        if name not in self.answers:
            raise ContactReachError(f"{service}: there is no such service")
        self.called.append(service)
        return SimpleNamespace(success=self.answers[name], message="done" if self.answers[name] else "not now")


@pytest.mark.parametrize(
    ("stack", "called"),
    [
        (Stack(controller=True, observer=True), ["controller/stop"]),
        (Stack(observer=True), ["observer/stop"]),
        (Stack(controller=False, observer=True), ["controller/stop", "observer/stop"]),
    ],
)
def test_the_first_node_that_stops_the_arm_is_enough(stack, called):
    assert stop_arm(stack).done and stack.called == called


def test_an_arm_that_nobody_stops_is_named_as_such():
    outcome = stop_arm(Stack(observer=False))
    assert not outcome.done and outcome.text.startswith("NOT stopped: ") and "observer: not now" in outcome.text


def test_the_controller_is_released_last_and_only_after_the_others():
    stack = Stack(controller=True, observer=True, driver=True)
    assert release({"controller", "driver", "observer"}, stack).done
    assert stack.called == ["driver/reset", "observer/reset", "controller/reset"]
    for refusing in (Stack(controller=True, observer=False), Stack(controller=True)):
        outcome = release({"controller", "observer"}, refusing)
        assert not outcome.done and "controller/reset" not in refusing.called


def test_nothing_is_released_that_is_not_stopped():
    stack = Stack(controller=True)
    assert release((), stack) == (True, "nothing is stopped") and not stack.called


def test_brakes_that_close_while_the_controller_is_released_are_opened_too():
    stack = Stack(controller=True, driver=True)
    looks = iter([{"controller"}, {"driver"}, ()])
    outcome = release_all(lambda: next(looks), stack, lambda: False)
    assert outcome == (True, "controller: done; driver: done")
    assert stack.called == ["controller/reset", "driver/reset"]
    looks = iter([(), {"driver"}, ()])
    assert release_all(lambda: next(looks), stack, lambda: False) == (True, "driver: done")


def test_a_refused_release_is_tried_again_until_the_time_is_over():
    stack, ends = Stack(controller=False), iter([False, False, True])
    assert release_all(lambda: {"controller"}, stack, lambda: next(ends)) == (False, "controller: not now")
    assert len(stack.called) == 3
    stack, ends = Stack(controller=True), iter([True])
    assert release_all(lambda: {"controller"}, stack, lambda: next(ends)) == (True, "controller: done")
