"""`contact-reach bench control --seconds`: what it makes of counters; what it finds depends on the machine."""

import subprocess

import numpy as np
import pytest
from stack_helpers import environment, module

from contact_reach_ros.experiments.bench_control_stack import measure_echo
from contact_reach_ros.experiments.control_report import ControlBench, Part, Run, Sample, make_report
from contact_reach_ros.timing import Histogram, write_counts

ECHOES = {"p50": 200.0, "p95": 250.0, "p99": 300.0, "p999": 400.0}


def sample(ticks, missed, trips_us, memory, timer=(0, 0)):
    """A sample with these round trips; a tenth of each is the wake-up, half the computing."""
    counts = {}
    for share, name in ((1.0, "round trip counts"), (0.1, "wake-up late counts"), (0.5, "compute counts")):
        histogram = Histogram()
        for trip in trips_us:
            histogram.add(round(1000 * share * trip))
        counts[name] = write_counts(histogram.counts())
    driver = {"ticks": str(ticks), "missed ticks": str(missed), **counts}
    return Sample({"driver": driver, "controller": counts}, memory, timer)


def test_only_what_happened_in_between_counts():
    slow_start = [900.0] * 1000
    later = list(np.linspace(200.0, 400.0, 4000))
    first = sample(1000, 500, slow_start, {"driver": 80.0, "planner": 300.0}, (4000, 70))
    settled = sample(3000, 500, slow_start, {"driver": 90.0, "planner": 500.0}, (6000, 70))
    last = sample(5000, 504, slow_start + later, {"driver": 90.5, "planner": 499.0}, (8000, 72))
    run = Run([Part(0, first, settled), Part(0, settled, last)], reached=3, realtime=True)
    report = make_report(ControlBench(4.0, 2), ECHOES, run)
    assert report["ticks"] == 4000
    assert report["missed_fraction"] == pytest.approx(0.001)
    assert report["timer_missed_fraction"] == 0.0005
    assert report["round_trip_us"] == pytest.approx({"p50": 300.0, "p99": 398.0, "p999": 400.0}, abs=5.0)
    assert report["wakeup_late_us"] == pytest.approx({"p50": 30.0, "p99": 40.0}, abs=5.0)
    assert report["compute_us"] == pytest.approx({"p50": 150.0, "p99": 199.0}, abs=5.0)
    assert report["ratio_to_echo"] == pytest.approx(1.5, abs=0.05)
    assert report["memory_growth_mb"] == pytest.approx(0.5)


def test_pages_are_compared_in_turns():
    bench = ControlBench(80.0, pages=2)
    assert bench.parts == [(20.0, 0), (20.0, 2)] * 2
    missed = iter([0, 10, 100, 130, 400, 420, 500, 540])
    timer = iter([(0, 0), (10, 1), (10, 1), (20, 3), (30, 3), (40, 4), (40, 4), (50, 6)])
    parts = [
        Part(
            count,
            *(sample(20000 * (2 * turn + end), next(missed), [200.0], {"driver": 90.0}, next(timer)) for end in (0, 1)),
        )
        for turn, count in enumerate((0, 2, 0, 2))
    ]
    found = make_report(bench, ECHOES, Run(parts, reached=3, realtime=True))["pages"]
    assert found["missed_fraction_closed"] == pytest.approx([10 / 20000, 20 / 20000])
    assert found["missed_fraction_open"] == pytest.approx([30 / 20000, 40 / 20000])
    assert found["difference_mean"] == found["difference_median"] == pytest.approx(0.001)
    assert found["difference_standard_error"] == pytest.approx(0.0, abs=1e-12)
    assert found["timer_difference_mean"] == pytest.approx(0.1)
    # One turn says nothing of the spread.
    assert make_report(bench, ECHOES, Run(parts[:2], 3, True))["pages"]["difference_standard_error"] is None


def test_bare_nodes_answer_each_other(monkeypatch, capfd):
    monkeypatch.setenv("ROS_DOMAIN_ID", environment()["ROS_DOMAIN_ID"])
    echoes = measure_echo(0.5)
    assert 0.0 < echoes["p50"] <= echoes["p99"] <= echoes["p999"]
    # Who only answers has nothing to say.
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("option", [("--seconds", "0.5"), ("--load", "-1"), ("--scene", "nowhere"), ("--pages", "-2")])
def test_what_cannot_be_run_is_refused_at_once(option):
    command = [*module("cli"), "bench", "control", "--seconds", "5", *option]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert option[1].removeprefix("-") in done.stderr
    assert "Traceback" not in done.stderr
