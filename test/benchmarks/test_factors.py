"""The factors apart: what is run, and the effects that are read off."""

import itertools
import json

import numpy as np
import pytest
from contact_reach_command import bench

from benchmarks import pictures
from benchmarks.factors import (
    ALONE,
    COSTS,
    CROSSED,
    DELAYS,
    FIGURES,
    SHIPPED,
    Factors,
    bench_factors,
    complete,
    effect,
    effects_tables,
    episodes,
    scene_of,
)
from contact_reach_ros.planning.settings import PlanningSettings, ReplanningSettings


def record(target: int, factors: Factors, time: float, scene: str = "wall") -> dict:
    reached = time < 20.0
    found = {"scene": scene, "target": target, **factors._asdict(), "timeout": 20.0, "max_contact_force": 2.0}
    return found | {"time": time if reached else None, "reached": reached, "success": reached}


def crossed(target: int) -> list[dict]:
    """The hinge costs 3 s, the long delay 4 s, and detours nothing; targets differ."""
    every = itertools.product(COSTS, DELAYS, (False, True))
    return [
        record(target, Factors(*each), 5.0 + target + 3.0 * (each[0] == "hinge") + 4.0 * (each[1] == 0.47))
        for each in every
    ]


def test_scenes_are_crossed_or_compared_alone():
    every = list(episodes(10))
    assert len(every) == len(set(every)) == 10 * (2 * 24 + len(ALONE) * 4)
    assert {factors for scene, _, factors in every if scene in ALONE} == {Factors(cost, 0.04, True) for cost in COSTS}
    # Target by target: what has been run is a comparison whenever it ends.
    assert [target for _, target, _ in every] == sorted(target for _, target, _ in every)
    assert {scene for scene, _, _ in every} == {*CROSSED, *ALONE}


def test_costs_differ_in_weights_only_and_the_shipped_one_is_shipped():
    shipped = Factors(*SHIPPED).setup("wall")
    assert shipped.planning == PlanningSettings(deadline=0.0, max_steps=5)
    assert shipped.replanning == ReplanningSettings()
    for cost in COSTS:
        changed = {
            name
            for name, value in vars(Factors(cost, 0.04, True).setup("wall").planning).items()
            if value != getattr(shipped.planning, name, 0.0)
        }
        assert all(name.endswith("_weight") or name == "contact_patience" for name in changed), cost
    slow = Factors("shipped", 0.47, False).setup("slalom")
    assert (slow.replanning.period, slow.replanning.latency, slow.planning.detour_patience) == (0.47, 0.47, 0.0)


def test_targets_of_a_scene_with_a_given_one_are_around_it():
    places = [np.array(scene_of("slalom", target).target.position) for target in range(5)]
    assert places[0].tolist() == [0.9, -0.1, 0.5]
    assert all(0.0 < np.abs(place - places[0]).max() <= 0.1 for place in places[1:])
    assert scene_of("wall", 3) == scene_of("wall", 0)


def test_an_effect_is_the_difference_over_all_other_factors():
    records = [each for target in range(3) for each in crossed(target)]
    own, difference = effect(records, "cost", "hinge", FIGURES["time, s"])
    assert own.mean == pytest.approx(5.0 + 1.0 + 3.0 + 4.0 / 3.0)
    assert [*difference] == pytest.approx([3.0, 3.0, 3.0])
    assert effect(records, "delay", 0.47, FIGURES["time, s"])[1].mean == pytest.approx(4.0)
    assert effect(records, "detours", False, FIGURES["time, s"])[1].mean == pytest.approx(0.0)
    assert effect(records, "cost", "shipped", FIGURES["success, %"])[1] is None
    text = effects_tables(records)
    assert "wall, 3 targets, 72 episodes" in text
    assert "| cost | hinge | 100.00, +0.00 [0.00, 0.00] |" in text


def test_targets_that_lack_episodes_are_left_out():
    records = [*crossed(0), *crossed(1)[:-1]]
    assert {each["target"] for each in complete(records)} == {0}


def test_a_run_goes_on_with_what_is_missing(tmp_path, monkeypatch, capsys):
    file, asked = tmp_path / "factors.jsonl", []

    def run(scene: str, target: int, factors: Factors) -> dict:
        asked.append(factors)
        return record(target, factors, 5.0, scene)

    monkeypatch.setattr("benchmarks.factors.run_episode_of", run)
    bench_factors(file, targets=1)
    lines = file.read_text().splitlines()
    assert len(lines) == len(asked) == 2 * 24 + 4 * len(ALONE)
    file.write_text("\n".join(lines[:-3]) + "\n")
    asked.clear()
    bench_factors(file, targets=1)
    assert len(asked) == 3 and len([json.loads(line) for line in file.read_text().splitlines()]) == len(lines)
    assert "slalom, 1 targets, 24 episodes" in capsys.readouterr().out


def test_the_picture_is_of_a_file_of_episodes(tmp_path):
    file, picture = tmp_path / "factors.jsonl", tmp_path / "factors.svg"
    file.write_text("".join(json.dumps(each) + "\n" for target in range(3) for each in crossed(target)))
    assert bench(pictures, file, picture) == 0
    text = picture.read_text()
    assert all(name in text for name in ("wall: cost hinge", "wall: delay 0.47", "wall: detours False"))
    assert "wall: cost shipped" not in text
