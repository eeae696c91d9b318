"""`contact-reach bench`: what it makes of counters; what it finds depends on the machine."""

import subprocess

import numpy as np
import pytest
from stack_helpers import environment, module

from contact_reach_ros.doctor.fitness import FitnessOptions, Sample, make_report
from contact_reach_ros.timing import Histogram, write_counts


def sample(ticks, missed, trips_us, timer=(0, 0)):
    """A sample with these round trips; a tenth of each is the wake-up, half the computing."""
    counts = {}
    for share, name in ((1.0, "round trip counts"), (0.1, "wake-up late counts"), (0.5, "compute counts")):
        histogram = Histogram()
        for trip in trips_us:
            histogram.add(round(1000 * share * trip))
        counts[name] = write_counts(histogram.counts())
    driver = {"ticks": str(ticks), "missed ticks": str(missed), **counts}
    return Sample({"driver": driver, "controller": counts}, timer)


def test_only_what_happened_in_between_counts():
    slow_start = [900.0] * 1000
    later = list(np.linspace(200.0, 400.0, 4000))
    first = sample(1000, 500, slow_start, (4000, 70))
    last = sample(5000, 504, slow_start + later, (8000, 72))
    report = make_report(FitnessOptions(4.0, 2), first, last, reached=3, realtime=True)
    assert report["ticks"] == 4000
    assert report["missed_fraction"] == pytest.approx(0.001)
    assert report["timer_missed_fraction"] == 0.0005
    assert report["round_trip_us"] == pytest.approx({"p50": 300.0, "p99": 398.0, "p999": 400.0}, abs=5.0)
    assert report["wakeup_late_us"] == pytest.approx({"p50": 30.0, "p99": 40.0, "p999": 40.0}, abs=5.0)
    assert report["compute_us"] == pytest.approx({"p50": 150.0, "p99": 199.0, "p999": 200.0}, abs=5.0)


def bench(*arguments):
    command = [*module("cli"), "bench", *arguments]
    return subprocess.run(command, env=environment(), capture_output=True, text=True, check=False, timeout=120)


def test_the_loop_of_the_running_stack_is_timed_beside_another_program():
    done = bench("--seconds", "2", "--load", "1")
    assert done.returncode == 0, done.stderr
    lines = dict(line.strip().split(maxsplit=1) for line in done.stdout.splitlines())
    assert int(lines["ticks"].split(",")[0]) > 500
    for name in ("bare", "round", "woken", "controller"):
        assert any(character.isdigit() for character in lines[name])


@pytest.mark.parametrize("option", [("--seconds", "0.5"), ("--load", "-1"), ("--scene", "nowhere")])
def test_what_cannot_be_run_is_refused_at_once(option):
    done = bench(*option)
    assert done.returncode == 2
    assert option[1].removeprefix("-") in done.stderr
    assert "Traceback" not in done.stderr
