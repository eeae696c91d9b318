"""Checks of the machine and its software, and how findings are reported."""

import json

import pytest
from rich.console import Console

from contact_reach_ros.doctor import machine
from contact_reach_ros.doctor.findings import Verdict, exit_code, failed, graded, print_table, write_report
from contact_reach_ros.errors import InputError


def test_report(tmp_path, capsys):
    warning = graded("so so", "better it", warn=True)
    assert exit_code({"part": {"a": graded("good", "better it"), "b": warning}}) == 0
    report = {"part": {"a": graded("good [0, 1]", ""), "b": failed("bad", "mend it")}}
    print_table(report, Console(width=80))
    printed = capsys.readouterr().out
    assert "good [0, 1]" in printed and "fix: mend it" in printed and "1 pass, 0 warn, 1 fail" in printed
    write_report(report, tmp_path / "report.json")
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["exit_code"] == 1 and content["verdicts"] == {"pass": 1, "warn": 0, "fail": 1}
    good, bad = content["checks"]
    assert good == {"part": "part", "name": "a", "verdict": "pass", "found": "good [0, 1]", "fix": ""}
    assert bad["fix"] == "mend it"
    with pytest.raises(InputError, match=r"report\.json/a' cannot be written: .*; name a file"):
        write_report(report, tmp_path / "report.json" / "a")


def test_refused_priority_names_the_limit_to_raise(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(machine.os, "sched_setscheduler", refuse)
    finding = machine.timer_jitter(0.02)
    assert finding.verdict is not Verdict.PASS and "rtprio 90" in finding.fix and "memlock" in finding.fix
    assert "without real-time priority" in finding.found and "ticks" in finding.found


def test_granted_priority_is_named_and_stays_with_its_thread(monkeypatch):
    policy = machine.os.sched_getscheduler(0)
    monkeypatch.setattr(machine.os, "sched_setscheduler", lambda *_: None)
    assert machine.timer_jitter(0.02).found.endswith("SCHED_FIFO 80")
    assert machine.os.sched_getscheduler(0) == policy
