"""The growth of a solver step's time, in small."""

import dataclasses

from arm_simulation import ARM

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments import scaling
from contact_reach_ros.planning.settings import PlanningSettings

SETTINGS = PlanningSettings(population=16, elite=4, line_search_points=16)


def test_everything_is_varied_and_compared_with_one_core_where_there_are_several(monkeypatch):
    seen = []

    def step(arm, settings, gains, permitted_force, nodes):
        seen.append([(each.population, each.horizon, nodes, each.cpus) for each in settings])
        return [4.0 / each.cpus for each in settings]

    monkeypatch.setattr(scaling, "_step_ms", step)
    one = scaling.measure_scaling(ARM, SETTINGS, ImpedanceSettings(), 10.0)
    assert list(one) == ["k", "H", "nodes"]
    assert {entry[0] for (entry,) in seen} == {*scaling.POPULATIONS, SETTINGS.population}
    assert {entry[3] for (entry,) in seen} == {1}
    assert scaling.scaling_table(one).splitlines()[-1] == "| nodes | 0, 1, 4, 12, 24 | 4.00, 4.00, 4.00, 4.00, 4.00 |"

    seen.clear()
    two = scaling.measure_scaling(ARM, dataclasses.replace(SETTINGS, cpus=2), ImpedanceSettings(), 10.0)
    assert list(two)[3:] == ["k, 24 nodes", "cores, k each"]
    k, horizon = SETTINGS.population, SETTINGS.horizon
    assert seen[-2:] == [[(k, horizon, 1, 1), (k, horizon, 1, 1)], [(2 * k, horizon, 1, 2), (2 * k, horizon, 1, 1)]]
    last = scaling.scaling_table(two).splitlines()[-1]
    assert last == "| cores, k each | 1, 2 | 4.00, 2.00 | 4.00, 4.00 | 1.00, 2.00 |"


def test_a_step_is_timed_and_the_curves_are_drawn(tmp_path):
    times = scaling._step_ms(ARM, [SETTINGS, dataclasses.replace(SETTINGS, horizon=1)], ImpedanceSettings(), 10.0, 0)
    assert len(times) == 2 and min(times) > 0.0
    scaling.plot_scaling({"k": {"value": [1, 2], "step_ms": times, "one_core_ms": times}}, tmp_path / "growth.png")
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")
