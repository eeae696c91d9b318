"""`contact-reach bench`: what it makes of counters; what it finds depends on the machine."""

import re
from functools import partial

import numpy as np
import pytest
from contact_reach_command import contact_reach
from stack_helpers import PATIENT_PLANNER, environment, parameter_file

from contact_reach_ros.bringup.processes import BringupOptions
from contact_reach_ros.doctor import fitness
from contact_reach_ros.timing import Histogram, write_counts


def counters(ticks, missed, trips_us):
    """Counters with these round trips; a tenth of each is the wake-up, half the computing."""
    counts = {}
    for share, name in ((1.0, "round trip counts"), (0.1, "wake-up late counts"), (0.5, "compute counts")):
        histogram = Histogram()
        for trip in trips_us:
            histogram.add(round(1000 * share * trip))
        counts[name] = write_counts(histogram.counts)
    return {"driver": {"ticks": str(ticks), "missed ticks": str(missed), **counts}, "controller": counts}


def test_only_what_happened_in_between_counts():
    slow_start = [900.0] * 1000
    later = list(np.linspace(200.0, 400.0, 4000))
    found = fitness.timing_between(counters(1000, 500, slow_start), counters(5000, 504, slow_start + later))
    assert found["ticks"] == 4000
    assert found["missed_fraction"] == pytest.approx(0.001)
    assert found["round_trip_us"] == pytest.approx({"p50": 300.0, "p99": 398.0, "p999": 400.0}, abs=5.0)
    assert found["wakeup_late_us"] == pytest.approx({"p50": 30.0, "p99": 40.0, "p999": 40.0}, abs=5.0)
    assert found["compute_us"] == pytest.approx({"p50": 150.0, "p99": 199.0, "p999": 200.0}, abs=5.0)


@pytest.mark.usefixtures("signal_handlers")
def test_the_loop_of_the_running_stack_is_timed_beside_another_program(monkeypatch, tmp_path, capsys):
    file = parameter_file(tmp_path / "patient.yaml", planner=PATIENT_PLANNER)
    monkeypatch.setattr(fitness, "BringupOptions", partial(BringupOptions, parameters=str(file)))
    monkeypatch.setattr(fitness, "_SETTLE_S", 0.5)
    monkeypatch.setenv("ROS_DOMAIN_ID", environment()["ROS_DOMAIN_ID"])
    assert contact_reach("bench", "--seconds", "2", "--load", "1") == 0
    lines = dict(line.strip().split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert int(lines["ticks"].split(",")[0]) > 500
    assert all(re.search(r"\d", lines[name]) for name in ("round", "woken", "controller"))


def test_what_cannot_be_run_is_refused_at_once(capsys):
    assert contact_reach("bench", "--seconds", "0.5") == 2
    assert "--seconds 0.5: expected 2 to 86400 s" in capsys.readouterr().err
