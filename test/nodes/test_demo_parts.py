"""What the demo prints while it runs and afterwards, without any process."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
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
from contact_reach_ros.report.summary import EpisodeSummary

TICK_NS = 1_000_000
START_NS = 1_000_000_000_000
NAN = float("nan")


class Stack:
    """Node and stack of a watcher: keeps how it handles what it hears."""

    def __init__(self) -> None:
        self.handlers: dict[str, Any] = {}
        self.inbox = SimpleNamespace(add=lambda topic, handle, *_: self.handlers.update({topic.name: handle}))

    def create_publisher(self, *_: Any) -> Any:
        return SimpleNamespace()

    def hear(self, topic: topics.Topic, message: Any) -> None:
        self.handlers[topic.name](message)

    def state(self, stamp_ns: int) -> None:
        message = JointState(name=ARM.joint_names, position=ARM.home, effort=[0.0] * ARM.n)
        message.header.stamp = to_time(stamp_ns)
        self.hear(topics.JOINT_STATES, message)


def make() -> tuple[Watcher, Stack]:
    stack = Stack()
    return Watcher(stack, stack, RobotModel(ARM), np.zeros(3)), stack  # type: ignore[arg-type]


def test_the_age_of_a_plan_is_the_time_since_it_took_effect() -> None:
    watcher, stack = make()
    stack.state(START_NS)
    assert "plan age    -" in watcher.line(START_NS)
    for effect_ns in (START_NS + 15 * TICK_NS, START_NS + 45 * TICK_NS):
        stack.hear(topics.REFERENCE_POSE, MultiDOFJointTrajectory(header=Header(stamp=to_time(effect_ns))))
    for now, age in ((10, "-"), (20, "5 ms"), (44, "29 ms"), (50, "5 ms")):
        stack.state(START_NS + now * TICK_NS)
        assert watcher.line(START_NS).split("plan age")[1].split("starting")[0].strip() == age


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
