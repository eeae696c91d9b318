"""The force over time that is written is what happened in the episodes, and can be drawn."""

import dataclasses
import json

import numpy as np
import pytest
from arm_simulation import ARM
from contact_reach_command import bench
from test_grid import TINY

from benchmarks import fig5 as fig5_module
from benchmarks import pictures
from benchmarks.baselines.method import Method
from benchmarks.baselines.scripted import ScriptedPlanner
from benchmarks.fig5 import Fig5, bench_fig5
from benchmarks.grid import concrete_scene
from contact_reach_ros.simulation.plant import TICK

SETUP = dataclasses.replace(TINY, timeout=3.5)
METHODS = ("contact_reach",)


def scripted(method, file, setup):
    """Stands for the planners, which would take long to compile."""
    return Method(ScriptedPlanner(concrete_scene(file, ARM, 0)), setup.controller)


@pytest.mark.slow
def test_profiles_are_those_of_the_episodes_and_can_be_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(fig5_module, "prepared", scripted)
    file, picture = tmp_path / "fig5.json", tmp_path / "fig5.png"
    report = bench_fig5(Fig5(methods=METHODS, latency=0.05), file, SETUP)
    assert json.loads(file.read_text()) == json.loads(json.dumps(report))
    for method in METHODS:
        profile, episode = np.array(report["methods"][method]["profile_N"]), report["methods"][method]["episode"]
        assert profile.max() == pytest.approx(episode["max_contact_force"], abs=1e-4)
        assert profile.sum() * TICK == pytest.approx(episode["contact_impulse"], rel=1e-3)
        assert profile.max() > 0.2
    assert bench(pictures, file, picture) == 0
    assert picture.stat().st_size > 10_000
