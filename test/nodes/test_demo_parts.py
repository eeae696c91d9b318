"""What the demo prints while it runs and afterwards, and when it sends its goal, without any process."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import MultiDOFJointTrajectory

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms.iiwa14 import ARM
from contact_reach_ros.bringup import demo
from contact_reach_ros.bringup.demo import INTERRUPTED, DemoOptions, _print_summary, run_demo
from contact_reach_ros.bringup.watcher import Watcher
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_time
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.report.summary import EpisodeSummary
from contact_reach_ros.ros.lockstep import FOREVER_NS

TICK_NS = 1_000_000
START_NS = 1_000_000_000_000
NAN = float("nan")


class Stack:
    """Node and stack of a watcher: keeps what it publishes, and how it handles what it hears."""

    def __init__(self) -> None:
        self.published: list[Any] = []
        self.handlers: dict[str, Any] = {}
        self.inbox = SimpleNamespace(add=lambda topic, handle, *_: self.handlers.update({topic.name: handle}))

    def create_publisher(self, *_: Any) -> Any:
        return SimpleNamespace(publish=self.published.append, get_subscription_count=lambda: 2)

    def hear(self, topic: topics.Topic, message: Any) -> None:
        self.handlers[topic.name](message)

    def state(self, stamp_ns: int, effort: float = 0.0) -> None:
        message = JointState(name=ARM.joint_names, position=ARM.home, effort=[effort] * ARM.n)
        message.header.stamp = to_time(stamp_ns)
        self.hear(topics.JOINT_STATES, message)


def make(tick_ns: int = 0) -> tuple[Watcher, Stack]:
    stack = Stack()
    return Watcher(stack, stack, RobotModel(ARM), np.zeros(3), tick_ns), stack  # type: ignore[arg-type]


def test_the_age_of_a_plan_is_the_time_since_it_took_effect() -> None:
    watcher, stack = make()
    stack.state(START_NS)
    assert "plan age    -" in watcher.line(START_NS)
    for effect_ns in (START_NS + 15 * TICK_NS, START_NS + 45 * TICK_NS):
        stack.hear(topics.REFERENCE_POSE, MultiDOFJointTrajectory(header=Header(stamp=to_time(effect_ns))))
    for now, age in ((10, "-"), (20, "5 ms"), (44, "29 ms"), (50, "5 ms")):
        stack.state(START_NS + now * TICK_NS)
        assert watcher.line(START_NS).split("plan age")[1].split("starting")[0].strip() == age


def test_in_lockstep_the_goal_is_sent_while_time_stands_still() -> None:
    watcher, stack = make(TICK_NS)

    def promised() -> list[int]:
        return [nanoseconds(message.stamp) for message in stack.published if isinstance(message, Header)]

    def done(stamp_ns: int) -> None:
        for name in ("observer", "planner"):
            stack.hear(topics.LOCKSTEP_HORIZON, Header(frame_id=name, stamp=to_time(stamp_ns + TICK_NS)))

    stack.state(START_NS, effort=NAN)
    watcher._go_on()
    # Nothing, or the nodes would wait for it before time begins.
    assert not promised()
    done(START_NS)
    # The brakes are closed: time goes on for a while.
    watcher._go_on()
    end_ns = START_NS + 100 * TICK_NS
    assert max(promised()) == end_ns
    stack.state(end_ns - TICK_NS)
    done(end_ns - TICK_NS)
    assert not watcher._stands_still()
    stack.state(end_ns)
    assert not watcher._stands_still()
    done(end_ns)
    assert watcher._stands_still()
    # They are open, and others may take their time.
    watcher._go_on()
    assert max(promised()) == end_ns
    stack.published.clear()
    watcher.send_goal()
    goal, promise = stack.published
    assert isinstance(goal, PoseStamped) and nanoseconds(goal.header.stamp) == end_ns
    assert (promise.frame_id, nanoseconds(promise.stamp)) == ("demo", FOREVER_NS)


def summary_of(reached: bool = False, ticks: int = 5000, missed: int = 0, stops: Sequence[dict] = ()) -> EpisodeSummary:
    unknown = dict.fromkeys(("p50", "p95", "p99", "p999", "max"), NAN)
    numbers = (0.2, NAN, 30.0, 0.5, 4.0, NAN, 0.0, 1.0)
    return EpisodeSummary(reached, *numbers, ticks, missed, unknown, unknown, NAN, list(stops))


STOPS = [{"time_s": 1.5, "source": "observer", "reason": "too much torque"}]


@pytest.mark.parametrize(
    ("code", "summary", "options", "runs"),
    [
        (1, summary_of(missed=400, stops=STOPS), {}, [False, True]),
        (1, summary_of(missed=400), {}, [False, True]),
        (1, summary_of(missed=50, stops=STOPS), {}, [False]),
        (0, summary_of(reached=True, missed=400), {}, [False]),
        (1, summary_of(missed=400), {"lockstep": True}, [True]),
        (1, summary_of(missed=400), {"view": True}, [False]),
        (INTERRUPTED, summary_of(missed=400), {}, [False]),
        (1, None, {}, [False]),
    ],
    ids=["stopped", "out of time", "a stop in time", "reached", "lockstep", "page", "interrupted", "a process died"],
)
def test_what_a_slow_machine_fails_in_real_time_is_repeated_in_lockstep(
    code: int, summary: EpisodeSummary | None, options: dict, runs: list[bool], monkeypatch, capsys
) -> None:
    found: list[bool] = []

    def run(options: DemoOptions) -> tuple[int, EpisodeSummary | None]:
        found.append(options.lockstep)
        return (code, summary) if len(found) == 1 else (0, summary_of(reached=True))

    monkeypatch.setattr(demo, "_run", run)
    assert run_demo(DemoOptions(**options)) == (code if len(runs) == 1 else 0)
    assert found == runs
    assert ("400 ticks of 5400 were missed" in capsys.readouterr().out) == (len(runs) == 2)


@pytest.mark.parametrize(
    ("stops", "why"),
    [
        ([], "not reached within 30.00 s"),
        (STOPS, "stopped after 1.50 s"),
    ],
)
def test_a_goal_that_was_not_reached_has_a_reason_instead_of_numbers(
    stops: list[dict], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = summary_of(stops=stops)
    _print_summary("not reached", summary, Path("bag"), Path("plot"))
    printed = capsys.readouterr().out
    assert why in printed and "no plan took effect" in printed and "nan" not in printed
    assert "4.00 s, the least time that" in printed
