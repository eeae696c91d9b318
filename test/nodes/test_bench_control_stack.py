"""`contact-reach bench control --seconds`: what it makes of counters; what it finds depends on the machine."""

import subprocess

import numpy as np
import pytest
from stack_helpers import environment, module

from contact_reach_ros.experiments.bench_control_stack import measure_echo
from contact_reach_ros.experiments.control_report import ControlBench, Run, Sample, make_report
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
    run = Run(first, settled, last, reached=3, realtime=True)
    report = make_report(ControlBench(4.0, 2), ECHOES, run)
    assert report["ticks"] == 4000
    assert report["missed_fraction"] == pytest.approx(0.001)
    assert report["timer_missed_fraction"] == 0.0005
    assert report["round_trip_us"] == pytest.approx({"p50": 300.0, "p99": 398.0, "p999": 400.0}, abs=5.0)
    assert report["wakeup_late_us"] == pytest.approx({"p50": 30.0, "p99": 40.0}, abs=5.0)
    assert report["compute_us"] == pytest.approx({"p50": 150.0, "p99": 199.0}, abs=5.0)
    assert report["ratio_to_echo"] == pytest.approx(1.5, abs=0.05)
    assert report["memory_growth_mb"] == pytest.approx(0.5)


def test_bare_nodes_answer_each_other(monkeypatch, capfd):
    monkeypatch.setenv("ROS_DOMAIN_ID", environment()["ROS_DOMAIN_ID"])
    echoes = measure_echo(0.5)
    assert 0.0 < echoes["p50"] <= echoes["p99"] <= echoes["p999"]
    # Who only answers has nothing to say.
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("option", [("--seconds", "0.5"), ("--load", "-1"), ("--scene", "nowhere")])
def test_what_cannot_be_run_is_refused_at_once(option):
    command = [*module("cli"), "bench", "control", "--seconds", "5", *option]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert option[1].removeprefix("-") in done.stderr
    assert "Traceback" not in done.stderr
