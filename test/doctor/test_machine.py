"""Checks of the machine and its software, and how findings are reported."""

import json
import shutil
import subprocess
import sys

import pytest
from rich.console import Console

from contact_reach_ros.doctor import jitter, machine, software
from contact_reach_ros.doctor.findings import Check, Verdict, failed, passed, warned
from contact_reach_ros.doctor.jitter import timer_jitter
from contact_reach_ros.doctor.planner import planner_speed
from contact_reach_ros.doctor.report import exit_code, print_table, write_json


def test_a_check_that_breaks_has_failed():
    def breaks():
        raise RuntimeError("no such thing")

    (finding,) = Check("thing", breaks).run()
    assert finding.verdict is Verdict.FAIL and finding.name == "thing"
    assert "RuntimeError: no such thing" in finding.found and finding.fix


def test_only_failures_make_the_exit_code():
    assert exit_code({"part": [passed("a", "good"), warned("b", "so so", "better it")]}) == 0
    assert exit_code({"part": [passed("a", "good")], "other": [failed("b", "bad", "mend it")]}) == 1


def test_report(tmp_path, capsys):
    report = {"part": [passed("a", "good [0, 1]", number=3.0), failed("b", "bad", "mend it")]}
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
    assert finding.verdict is Verdict.WARN and "rtprio 90" in finding.fix
    assert timer_jitter(0.02).values["realtime"] is False


def test_granted_priority_passes_and_stays_with_its_thread(monkeypatch):
    policy = machine.os.sched_getscheduler(0)
    monkeypatch.setattr(machine.os, "sched_setscheduler", lambda *_: None)
    assert machine.realtime_permission().verdict is Verdict.PASS
    assert machine.os.sched_getscheduler(0) == policy


@pytest.mark.parametrize(("limit", "verdict"), [(8 * 2**20, "warn"), (64 * 2**30, "pass"), (-1, "pass")])
def test_memory_lock(monkeypatch, limit, verdict):
    monkeypatch.setattr(machine, "_capable", lambda _: False)
    monkeypatch.setattr(machine.resource, "getrlimit", lambda _: (limit, limit))
    finding = machine.memory_lock()
    assert finding.verdict.value == verdict
    assert verdict == "pass" or "memlock unlimited" in finding.fix


@pytest.mark.parametrize(
    ("governors", "verdict"),
    [([], "pass"), (["performance"] * 2, "pass"), (["performance", "powersave"], "warn"), (["schedutil"] * 2, "warn")],
)
def test_frequency_scaling(tmp_path, governors, verdict):
    for number, governor in enumerate(governors):
        folder = tmp_path / f"cpu{number}" / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(f"{governor}\n")
    finding = machine.frequency_scaling(tmp_path)
    assert finding.verdict.value == verdict
    assert verdict == "pass" or "cpupower frequency-set -g performance" in finding.fix


def test_kernel(tmp_path):
    assert machine.kernel(tmp_path / "none", "#1 SMP PREEMPT_RT").verdict is Verdict.PASS
    finding = machine.kernel(tmp_path / "none", "#1 SMP PREEMPT_DYNAMIC")
    assert finding.verdict is Verdict.WARN and "PREEMPT_RT" in finding.fix
    (tmp_path / "realtime").write_text("1\n")
    assert machine.kernel(tmp_path / "realtime", "#1 SMP").verdict is Verdict.PASS


@pytest.mark.parametrize(
    ("runtime", "cores", "verdict"), [(950000, 2, "warn"), (950000, 8, "pass"), (-1, 2, "pass"), (1000000, 1, "pass")]
)
def test_realtime_throttling(tmp_path, runtime, cores, verdict):
    (tmp_path / "sched_rt_runtime_us").write_text(f"{runtime}\n")
    (tmp_path / "sched_rt_period_us").write_text("1000000\n")
    finding = machine.realtime_throttling(tmp_path, cores, "6.8.0-generic", tmp_path / "none")
    assert finding.verdict.value == verdict
    if verdict == "warn":
        assert "50 ms in 1000 ms" in finding.found and "kernel.sched_rt_runtime_us=-1" in finding.fix


@pytest.mark.parametrize(
    ("runtimes", "cores", "verdict", "found"),
    [
        ([50_000_000, 50_000_000], 2, "warn", "50 ms in 1000 ms"),
        ([0, 20_000_000], 2, "warn", "20 ms in 1000 ms"),
        ([50_000_000] * 8, 8, "pass", "8 cores"),
        ([0, 0], 2, "pass", "off"),
        ([], 2, "warn", "unless that is changed"),
    ],
)
def test_from_linux_6_12_on_the_fair_servers_count_and_the_sysctl_does_not(tmp_path, runtimes, cores, verdict, found):
    (tmp_path / "sched_rt_runtime_us").write_text("-1\n")
    (tmp_path / "sched_rt_period_us").write_text("1000000\n")
    servers = tmp_path / "fair_server"
    for number, runtime in enumerate(runtimes):
        server = servers / f"cpu{number}"
        server.mkdir(parents=True)
        (server / "runtime").write_text(f"{runtime}\n")
        (server / "period").write_text("1000000000\n")
    finding = machine.realtime_throttling(tmp_path, cores, "6.12.3-rt", servers, set())
    assert finding.verdict.value == verdict and found in finding.found
    if verdict == "warn":
        assert f"{servers}/cpu*/runtime" in finding.fix and "isolcpus=1" in finding.fix
        # Who has done so is told that it helped, and a single CPU cannot be kept free.
        assert machine.realtime_throttling(tmp_path, 1, "6.12.3-rt", servers, {1}).verdict is Verdict.PASS
        assert "isolcpus" not in machine.realtime_throttling(tmp_path, 1, "6.12.3-rt", servers, set()).fix


def test_a_system_that_shows_no_throttling(tmp_path):
    assert machine.realtime_throttling(tmp_path, 2, "6.8.0", tmp_path / "none").verdict is Verdict.PASS


@pytest.mark.parametrize(("free", "verdict"), [(500e9, "pass"), (0.5e9, "warn"), (0.05e9, "fail")])
def test_disk(monkeypatch, tmp_path, free, verdict):
    usage = shutil.disk_usage(tmp_path)._replace(free=free)
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda _: usage)
    finding = machine.disk(tmp_path / "bags" / "not yet there", 1e6)
    assert finding.verdict.value == verdict
    assert finding.values["minutes"] == pytest.approx(free / 60e6)


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
    assert finding.fix == f"pip install -c {constraints} mujoco"


def test_a_missing_package_is_named(monkeypatch):
    have = software._version
    monkeypatch.setattr(software, "_version", lambda package: "" if package == "brax" else have(package))
    finding = software.python_packages()
    assert finding.verdict is Verdict.FAIL and "brax" in finding.fix


def test_a_planner_that_cannot_start_says_why():
    finding = planner_speed({"planning.deadline": 1e9})
    assert finding.verdict is Verdict.FAIL and "deadline" in finding.found


def test_a_planner_is_timed():
    small = {"population": 32, "elite": 8, "line_search_points": 32, "max_steps": 3}
    parameters = {f"planning.{name}": value for name, value in small.items()} | {"max_spheres": 0}
    finding = planner_speed({**parameters, "latency": 1000.0})
    assert finding.verdict is Verdict.PASS and finding.values["spheres"] == 0
    assert finding.values["compile_s"] > 0.0 and finding.values["solve_ms"] > 0.0


def test_the_timer_of_a_process_tells_how_far_it_is():
    command = [sys.executable, "-m", jitter.__name__, "81"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        first, second = ([int(number) for number in process.stdout.readline().split()] for _ in range(2))
        process.kill()
    # A thousand wake-ups each, and the ticks that were over before one.
    assert first[0] == 1000 + first[1]
    assert second[0] == 2000 + second[1]
    assert 0 <= first[1] <= second[1]
