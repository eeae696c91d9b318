"""When the demo repeats itself, without any process."""

from collections.abc import Sequence

import pytest

from contact_reach_ros.bringup import demo
from contact_reach_ros.bringup.demo import INTERRUPTED, DemoOptions, run_demo
from contact_reach_ros.report.summary import EpisodeSummary

NAN = float("nan")


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
