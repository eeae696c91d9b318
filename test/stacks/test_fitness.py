"""`contact-reach bench`: what it makes of counters; what it finds depends on the machine."""

import re
from functools import partial

import pytest
from contact_reach_command import contact_reach
from stack_helpers import PATIENT_PLANNER, environment, parameter_file

from contact_reach_ros.bringup.processes import BringupOptions
from contact_reach_ros.doctor import fitness


def test_ticks_in_between_count_and_the_newest_percentiles():
    names = {"round trip": 300.0, "wake-up late": 30.0, "compute": 150.0}
    newest = {f"{name} {key} us": str(us) for name, us in names.items() for key in ("p50", "p95", "p99", "p999")}
    first, last = {"ticks": "1000", "missed ticks": "500"}, {"ticks": "5000", "missed ticks": "504", **newest}
    found = fitness.timing_between({"driver": first, "controller": {}}, {"driver": last, "controller": newest})
    assert found["ticks"] == 4000
    assert found["missed_fraction"] == pytest.approx(0.001)
    for key, us in {"round_trip_us": 300.0, "wakeup_late_us": 30.0, "compute_us": 150.0}.items():
        assert found[key] == {"p50": us, "p99": us, "p999": us}


@pytest.mark.usefixtures("signal_handlers")
@pytest.mark.slow
def test_the_loop_of_the_running_stack_is_timed_beside_another_program(monkeypatch, tmp_path, capsys):
    file = parameter_file(tmp_path / "patient.yaml", planner=PATIENT_PLANNER)
    monkeypatch.setattr(fitness, "BringupOptions", partial(BringupOptions, parameters=str(file)))
    monkeypatch.setattr(fitness, "_SETTLE_S", 0.5)
    monkeypatch.setenv("ROS_DOMAIN_ID", environment()["ROS_DOMAIN_ID"])
    assert contact_reach("bench", "--seconds", "2", "--load", "1") == 0
    lines = dict(line.strip().split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert int(lines["ticks"].split(",")[0]) > 500
    assert all(re.search(r"\d", lines[name]) for name in ("round", "woken", "controller", "goals"))


def test_what_cannot_be_run_is_refused_at_once(capsys):
    assert contact_reach("bench", "--seconds", "0.5") == 2
    assert "--seconds 0.5: expected 2 to 86400 s" in capsys.readouterr().err
