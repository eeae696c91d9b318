"""Episodes for each value of a setting."""

import dataclasses
import json

import pytest
from contact_reach_command import contact_reach

from contact_reach_ros.experiments import bench_setting
from contact_reach_ros.experiments.baselines.method import Method
from contact_reach_ros.experiments.grid import episode_seeds


def run(*arguments: str) -> int:
    return contact_reach("bench", "setting", *arguments)


@pytest.mark.slow
def test_slower_planning_makes_the_arm_slower(tmp_path, capsys):
    """x_d is latched with every plan, so fewer plans move it less far."""
    file = tmp_path / "report.json"
    assert run("latency", "0.04", "0.1", "--scene", "free", "--targets", "1", "--json", str(file)) == 0
    fast, slow = json.loads(file.read_text())["scenes"]["free"]
    assert (fast["value"], slow["value"]) == (0.04, 0.1)
    assert fast["reached"] == slow["reached"] == 1
    assert 1.0 < fast["time_ratio"]["mean"] < 1.3 < slow["time_ratio"]["mean"] < 2.0
    assert fast["largest_force"]["mean"] == 0.0
    assert "| free | contact_reach | 0.04 | 1/1 |" in capsys.readouterr().out


@pytest.mark.slow
def test_each_target_has_random_numbers_of_its_own_and_the_same_for_each_value(monkeypatch):
    seeds: list[tuple[int, int | None]] = []
    episode = bench_setting.run_episode

    def reseed(method, seed):
        seeds.append((seed, None))
        method.planner.reseed(seed)

    def run_episode(scene, method, options):
        seeds[-1] = (seeds[-1][0], options.noise_seed)
        return episode(scene, method, dataclasses.replace(options, timeout=0.1))

    monkeypatch.setattr(Method, "reseed", reseed)
    monkeypatch.setattr(bench_setting, "run_episode", run_episode)
    assert run("latency", "0.04", "0.1", "--scene", "free", "--targets", "2") == 0
    assert seeds[:2] == seeds[2:] == [episode_seeds(0, 0), episode_seeds(1, 0)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["contact_wieght", "1"], "contact_wieght"),
        (["population", "2"], "population"),
        (["max_steps", "many"], "max_steps"),
        (["max_steps", "1", "--with", "population"], "expected NAME=VALUE"),
        (["max_steps", "1", "--with", "populatoin=3"], "populatoin"),
        (["max_steps", "1", "--arm", "kuka"], "kuka"),
    ],
)
def test_settings_that_are_not_there_and_values_out_of_range_are_refused(arguments, message, capsys):
    assert run(*arguments) == 2
    assert message in capsys.readouterr().err
