"""What the demo prints afterwards, without any process."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from contact_reach_ros.bringup.demo import _print_summary
from contact_reach_ros.report.summary import EpisodeSummary

NAN = float("nan")


def summary_of(reached: bool = False, ticks: int = 5000, missed: int = 0, stops: Sequence[dict] = ()) -> EpisodeSummary:
    unknown = dict.fromkeys(("p50", "p95", "p99", "p999", "max"), NAN)
    numbers = (0.2, NAN, 30.0, 0.5, 4.0, NAN, 0.0, 1.0)
    return EpisodeSummary(reached, *numbers, ticks, missed, unknown, unknown, NAN, list(stops))


STOPS = [{"time_s": 1.5, "source": "observer", "reason": "too much torque"}]


def test_a_run_that_failed_on_a_slow_machine_points_to_lockstep(capsys: pytest.CaptureFixture[str]) -> None:
    said = {}
    for missed in (50, 400):
        _print_summary("not reached", summary_of(missed=missed), Path("bag"), Path("plot"))
        said[missed] = "add --lockstep" in capsys.readouterr().out
    assert said == {50: False, 400: True}


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
    _print_summary("not reached", summary, Path("bag"))
    printed = capsys.readouterr().out
    assert why in printed and "no plan took effect" in printed and "nan" not in printed
    assert "4.00 s, the least time that" in printed
