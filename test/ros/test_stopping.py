"""Who stops and releases the arm when some nodes do not answer, or refuse."""

import itertools
import time
from types import SimpleNamespace

import pytest

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.ros.client import StackClient


class Stack(StackClient):
    """Nodes that answer, refuse or are missing; the rest is missing. `looks`: who is stopped, look by look."""

    def __init__(self, looks=(), **answers):
        self.looks, self._stopped_ns, self._requested = iter(looks), {}, set()
        self.answers = answers
        self.called = []

    def hear_stops(self):
        self.stops = dict.fromkeys(next(self.looks), "stopped")
        self.safety = dict.fromkeys(self.answers, "")

    def call(self, service, *_):
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
    assert stack.stop().done and stack.called == called


def test_an_arm_that_nobody_stops_is_named_as_such():
    outcome = Stack(observer=False).stop()
    assert not outcome.done and outcome.text.startswith("NOT stopped: ") and "observer: not now" in outcome.text


def test_the_controller_is_released_last_and_only_after_the_others():
    stack = Stack(controller=True, observer=True, driver=True)
    assert stack.release({"controller", "driver", "observer"}).done
    assert stack.called == ["driver/reset", "observer/reset", "controller/reset"]
    for refusing in (Stack(controller=True, observer=False), Stack(controller=True)):
        outcome = refusing.release({"controller", "observer"})
        assert not outcome.done and outcome.text.startswith("NOT reset, refused by observer")
        assert "controller/reset" not in refusing.called


def test_brakes_that_close_while_the_controller_is_released_are_opened_too():
    stack = Stack([{"controller"}, {"driver"}, ()], controller=True, driver=True)
    assert stack.release_all() == (True, "driver: done; controller: done")
    assert stack.called == 2 * ["driver/reset", "controller/reset"]
    assert Stack([()]).release_all() == (True, "nothing is stopped")


def test_an_arm_that_stops_again_is_not_reset_again_and_again():
    stack = Stack(itertools.repeat({"controller"}), controller=True, observer=True)
    outcome = stack.release_all()
    assert outcome == (False, "reset, and stopped again: controller: stopped")
    assert stack.called == ["observer/reset", "controller/reset"]


def test_however_long_it_takes_to_hear_who_is_stopped_a_release_is_tried(monkeypatch):
    """As without an observer, which is waited for."""
    stack, hear = Stack(itertools.repeat({"controller"}), controller=False), Stack.hear_stops
    monkeypatch.setattr(Stack, "hear_stops", lambda self: time.sleep(0.02) or hear(self))
    assert stack.release_all(0.01) == (False, "NOT reset, refused by controller: not now")


def test_a_refused_release_is_tried_again_until_the_time_is_over():
    stack = Stack(itertools.repeat({"controller"}), controller=False)
    assert stack.release_all(0.01) == (False, "NOT reset, refused by controller: not now")
    assert len(stack.called) > 1
