"""Checks of the machine and its software, and how findings are reported."""

import json
import subprocess
import sys

import pytest
from rich.console import Console

from contact_reach_ros.doctor import machine, software
from contact_reach_ros.doctor.findings import (
    Verdict,
    check,
    exit_code,
    failed,
    graded,
    passed,
    print_table,
    warned,
    write_json,
)
from contact_reach_ros.doctor.machine import timer_jitter
from contact_reach_ros.errors import InputError


@pytest.mark.parametrize("error", [InputError("no such thing"), FileNotFoundError("no such thing")])
def test_a_check_that_meets_an_error_has_failed(error):
    def meets():
        raise error

    finding = check("thing")(meets)()
    assert finding.verdict is Verdict.FAIL and finding.name == "thing"
    assert "no such thing" in finding.found and finding.fix


def test_a_fault_of_a_check_is_no_finding():
    def broken():
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        check("thing")(broken)()


def test_only_failures_make_the_exit_code():
    assert exit_code({"part": [passed("good"), warned("so so", "better it")]}) == 0
    assert exit_code({"part": [passed("good")], "other": [failed("bad", "mend it")]}) == 1


@pytest.mark.parametrize(
    ("conditions", "verdict"),
    [({}, "pass"), ({"warn": True}, "warn"), ({"fail": True}, "fail"), ({"warn": True, "fail": True}, "fail")],
)
def test_only_a_finding_that_passes_has_no_fix(conditions, verdict):
    finding = graded("found", "mend it", **conditions, number=3)
    assert finding.verdict.value == verdict and finding.values == {"number": 3}
    assert bool(finding.fix) == (verdict != "pass")


def test_report(tmp_path, capsys):
    good = check(lambda part: part)(lambda part: passed("good [0, 1]", number=3.0))
    bad = check("b")(lambda: failed("bad", "mend it"))
    report = {"part": [good("a"), bad()]}
    print_table(report, Console(width=80))
    printed = capsys.readouterr().out
    assert "good [0, 1]" in printed and "fix: mend it" in printed and "1 pass, 0 warn, 1 fail" in printed
    write_json(report, tmp_path / "report.json")
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["exit_code"] == 1 and content["verdicts"] == {"pass": 1, "warn": 0, "fail": 1}
    good, bad = content["checks"]
    assert good == {
        "part": "part", "name": "a", "verdict": "pass", "found": "good [0, 1]", "fix": "", "values": {"number": 3.0}
    }  # fmt: skip
    assert bad["fix"] == "mend it"


def test_refused_priority_names_the_limit_to_raise(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(machine.os, "sched_setscheduler", refuse)
    monkeypatch.setattr(machine, "_CONTAINERS", ())
    finding = machine.realtime_permission()
    assert finding.verdict is Verdict.WARN and "rtprio 90" in finding.fix and "memlock" in finding.fix
    assert timer_jitter(0.02).values["realtime"] is False


def test_granted_priority_passes_and_stays_with_its_thread(monkeypatch):
    policy = machine.os.sched_getscheduler(0)
    monkeypatch.setattr(machine.os, "sched_setscheduler", lambda *_: None)
    assert machine.realtime_permission().verdict is Verdict.PASS
    assert machine.os.sched_getscheduler(0) == policy


@pytest.mark.parametrize(
    ("cores", "load", "isolated", "verdict", "fix"),
    [
        (8, 1.0, set(), "pass", ""),
        (8, 9.0, set(), "warn", "top"),
        (2, 1.0, set(), "warn", "docs/realtime.md"),
        (2, 1.0, {1}, "pass", ""),
    ],
)
def test_processors(monkeypatch, cores, load, isolated, verdict, fix):
    monkeypatch.setattr(machine.os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(machine.os, "getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr(machine, "isolated_cpus", lambda: isolated)
    finding = machine.processors()
    assert finding.verdict.value == verdict and fix in finding.fix


@pytest.mark.parametrize(
    ("governors", "named"),
    [([], False), (["performance"] * 2, False), (["performance", "powersave"], True), (["schedutil"] * 2, True)],
)
def test_late_wake_ups_are_put_down_to_the_governor(tmp_path, governors, named):
    for number, governor in enumerate(governors):
        folder = tmp_path / f"cpu{number}" / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(f"{governor}\n")
    fixes = " ".join(machine.late_wake_up_fixes(True, tmp_path))
    assert ("cpupower frequency-set -g performance" in fixes) == named


def test_late_wake_ups_are_put_down_to_the_kernel(tmp_path):
    def fixes(version: str) -> str:
        return " ".join(machine.late_wake_up_fixes(True, tmp_path, tmp_path / "realtime", version))

    assert "PREEMPT_RT" not in fixes("#1 SMP PREEMPT_RT")
    assert "PREEMPT_RT" in fixes("#1 SMP PREEMPT_DYNAMIC")
    (tmp_path / "realtime").write_text("1\n")
    assert "PREEMPT_RT" not in fixes("#1 SMP")


def test_timer_reports_what_it_measured():
    finding = timer_jitter(0.05)
    values = finding.values
    assert 0.0 <= values["p50_us"] <= values["p99_us"] <= values["max_us"]
    assert values["missed"] >= 0 and "ticks" in finding.found


def test_versions_against_constraints(tmp_path):
    assert software.python_packages().verdict is not Verdict.FAIL
    constraints = tmp_path / "constraints.txt"
    constraints.write_text("# pinned\nmujoco==0.0.1\n")
    finding = software.python_packages(constraints)
    assert finding.verdict is Verdict.WARN
    assert "mujoco" in finding.found and "tested 0.0.1" in finding.found
    assert finding.fix == f"{sys.executable} -m pip install -c {constraints} mujoco"


def test_a_missing_package_is_named(monkeypatch):
    have = software._version
    monkeypatch.setattr(software, "_version", lambda package: "" if package == "brax" else have(package))
    finding = software.python_packages()
    assert finding.verdict is Verdict.FAIL and "brax" in finding.fix


def test_the_timer_of_a_process_tells_how_far_it_is():
    command = [sys.executable, "-m", machine.__name__, "81"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        first, second = ([int(number) for number in process.stdout.readline().split()] for _ in range(2))
        process.kill()
    # A thousand wake-ups each, and the ticks that were over before one.
    assert first[0] == 1000 + first[1]
    assert second[0] == 2000 + second[1]
    assert 0 <= first[1] <= second[1]
