"""The growth of a solver step's time, in small."""

import dataclasses

from arm_simulation import ARM

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments import scaling
from contact_reach_ros.planning.settings import PlanningSettings

SETTINGS = PlanningSettings(population=16, elite=4, line_search_points=16)


def test_everything_is_varied_and_cores_where_there_are_several(monkeypatch):
    seen = []

    def step(arm, settings, gains, permitted_force, nodes):
        seen.append((settings.population, settings.horizon, nodes, settings.cpus))
        return float(len(seen))

    monkeypatch.setattr(scaling, "_step_ms", step)
    one = scaling.measure_scaling(ARM, SETTINGS, ImpedanceSettings(), 10.0)
    assert list(one) == ["k", "H", "nodes"]
    assert {entry[0] for entry in seen} == {*scaling.POPULATIONS, SETTINGS.population}
    assert {entry[3] for entry in seen} == {1}

    seen.clear()
    two = scaling.measure_scaling(ARM, dataclasses.replace(SETTINGS, cpus=2), ImpedanceSettings(), 10.0)
    assert list(two)[3:] == ["cores, k together", "cores, k each"]
    k, horizon = SETTINGS.population, SETTINGS.horizon
    assert seen[-4:] == [(k, horizon, 1, 1), (k, horizon, 1, 2), (k, horizon, 1, 1), (2 * k, horizon, 1, 2)]
    assert scaling.scaling_table(two).splitlines()[-1].startswith("| cores, k each | 1, 2 | ")
