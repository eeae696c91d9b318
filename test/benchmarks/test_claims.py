"""Summaries, differences and what is demanded, on episodes made up so that the answers are known."""

import math

import numpy as np
import pytest

from benchmarks.claims import Results, claims, plus_minus
from benchmarks.grid import Cell, failed


def record(scene="ball", goal="hold", method="contact_reach", target=0, repeat=0, **figures):
    entry = failed(Cell(scene, goal, method, target, repeat), "")
    if "time" in figures:
        entry["reached"] = entry["success"] = True
    return {**entry, **figures}


def forces(method, by_target, scene="wall"):
    return [
        record(scene, method=method, target=target, repeat=repeat, max_contact_force=force)
        for target, values in enumerate(by_target)
        for repeat, force in enumerate(values)
    ]


def claim(episodes, text, scene="wall"):
    (found,) = (entry for entry in claims(Results(episodes), [scene], ["hold"]) if text in entry["claim"])
    return found


def test_mean_and_deviation_of_the_episodes_that_have_the_figure():
    results = Results([record(time=3.0), record(target=1, time=5.0), record(target=2), record(scene="free", time=9.0)])
    summary = results.summary("ball", "hold", "contact_reach", "time")
    assert (summary.mean, summary.sd, summary.count) == (4.0, pytest.approx(math.sqrt(2.0)), 2)
    assert plus_minus(summary) == "4.00 ± 1.41"
    assert plus_minus(results.summary("free", "hold", "contact_reach", "time")) == "9.00"
    assert plus_minus(results.summary("wall", "hold", "contact_reach", "time")) == "–"


def test_differences_are_paired_by_target_over_the_mean_of_its_repeats():
    episodes = forces("contact_reach", [[1, 3], [1], [4]]) + forces("reference_posture", [[4], [3]])
    found = Results(episodes).difference("wall", "hold", "reference_posture", "contact_reach", "max_contact_force")
    np.testing.assert_array_equal(found, [2.0, 2.0])


FORCE = "peak force of reference posture, less 4 times"


def test_four_times_the_force_is_a_difference_that_zeros_do_not_make_infinite():
    harder = forces("contact_reach", 4 * [[0.0], [1.0], [1.0]])
    harder += forces("reference_posture", 4 * [[2.0], [7.0], [6.0]])
    found = claim(harder, FORCE)
    assert found["value"] == pytest.approx((2.0 + 3.0 + 2.0) / 3)
    assert found["met"]
    few = [entry for entry in harder if entry["target"] < 9]
    assert claim(few, FORCE)["ci95"][0] > 0.0
    assert not claim(few, FORCE)["met"], "nine targets are too few"
    nothing = forces("contact_reach", [[0.0]] * 12) + forces("reference_posture", [[0.0]] * 12)
    assert not claim(nothing, FORCE)["met"], "two methods that touch nothing show nothing"


def test_success_takes_as_many_targets_as_show_it():
    enough = [record("free", target=target, time=3.0, reached=True) for target in range(40)]
    found = claim(enough, "settles at the goal within ε", "free")
    assert (found["value"], found["targets"], found["met"]) == (1.0, 40, True)
    assert not claim(enough[:10], "settles at the goal within ε", "free")["met"]
    # A target with one repeat that fails is no success.
    half = [*enough[:-1], record("free", target=38, repeat=1)]
    assert claim(half, "settles at the goal within ε", "free")["value"] == pytest.approx(38 / 39)


def test_collision_free_paths_of_both_kinds_are_compared_in_time():
    episodes = [
        record(method=method, target=target, time=time, time_ratio=1.0)
        for method, time in (("contact_reach", 3.0), ("collision_free", 4.0), ("rrt_star", 12.0))
        for target in range(12)
    ]
    found = {entry["claim"]: entry for entry in claims(Results(episodes), ["ball"], ["hold"])}
    assert found["ball: time of collision_free, less 2.6 times the method's"]["value"] == pytest.approx(4.0 - 7.8)
    assert not found["ball: time of collision_free, less 2.6 times the method's"]["met"]
    assert found["ball: time of rrt_star, less 2.6 times the method's"]["met"]
