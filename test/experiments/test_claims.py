"""Summaries, ratios and what is demanded, on episodes made up so that the answers are known."""

import math

import pytest

from contact_reach_ros.experiments.claims import Results, claims, number, plus_minus, ratio_text
from contact_reach_ros.experiments.grid import Cell, failed


def record(scene="ball", goal="hold", method="contact_reach", target=0, repeat=0, **figures):
    entry = failed(Cell(scene, goal, method, target, repeat), "")
    if "time" in figures:
        entry["reached"] = True
    return {**entry, **figures}


def forces(method, by_target):
    return [
        record(method=method, target=target, repeat=repeat, max_contact_force=force)
        for target, values in enumerate(by_target)
        for repeat, force in enumerate(values)
    ]


def test_mean_and_deviation_of_the_episodes_that_have_the_figure():
    results = Results([record(time=3.0), record(target=1, time=5.0), record(target=2), record(scene="free", time=9.0)])
    summary = results.summary("ball", "hold", "contact_reach", "time")
    assert (summary.mean, summary.sd, summary.count) == (4.0, pytest.approx(math.sqrt(2.0)), 2)
    assert plus_minus(summary) == "4.00 ± 1.41"
    assert plus_minus(results.summary("free", "hold", "contact_reach", "time")) == "9.00"
    assert plus_minus(results.summary("wall", "hold", "contact_reach", "time")) == "–"


def test_ratio_of_means_and_median_of_pairs():
    results = Results(forces("contact_reach", [[1, 3], [1, 1], [4, 4]]) + forces("reference_posture", [[4], [3], [8]]))
    ratio = results.ratio("ball", "hold", "reference_posture", "contact_reach", "max_contact_force")
    assert ratio.of_means == pytest.approx(15.0 / 7.0)
    assert ratio.paired_median == 2.0
    assert ratio.targets == 3
    # Whatever targets are drawn, the ratio lies between that of the worst and that of the best.
    assert 2.0 <= ratio.low < ratio.of_means < ratio.high <= 3.0
    assert results.ratio("ball", "hold", "reference_posture", "contact_reach", "max_contact_force") == ratio


def test_a_ratio_needs_targets_that_both_have():
    results = Results([*forces("contact_reach", [[1], [2]]), record(method="cma_es", target=5, max_contact_force=9.0)])
    assert results.ratio("ball", "hold", "cma_es", "contact_reach", "max_contact_force") is None
    one = Results(forces("contact_reach", [[2]]) + forces("cma_es", [[5], [7]]))
    assert ratio_text(one.ratio("ball", "hold", "cma_es", "contact_reach", "max_contact_force")) == (
        "2.50, paired median 2.50, 1 target"
    )


def test_something_over_nothing_is_infinite_and_nothing_over_nothing_is_no_ratio():
    results = Results(
        forces("contact_reach", [[0], [0], [0]])
        + forces("reference_posture", [[0], [2], [3]])
        + forces("cma_es", [[0], [0], [0]])
    )
    ratio = results.ratio("ball", "hold", "reference_posture", "contact_reach", "max_contact_force")
    assert (ratio.of_means, ratio.paired_median) == (math.inf, math.inf)
    assert number(ratio.low) == "∞"
    assert results.ratio("ball", "hold", "cma_es", "contact_reach", "max_contact_force") is None


def verdicts(episodes, scenes=("ball",)):
    return {claim.text: claim.met for claim in claims(Results(episodes), scenes, ["hold"])}


def test_demands_are_met_or_not():
    ours = [record(target=t, time=5.0, time_ratio=1.5, max_contact_force=2.0) for t in range(2)]
    others = [
        *(record(method="reference_posture", target=t, time=5.0, max_contact_force=4.0) for t in range(2)),
        *(record(method="rrt_star", target=t, time=12.0, max_contact_force=0.0) for t in range(2)),
    ]
    found = verdicts(ours + others)
    assert found == {
        "ball: every goal reached, no latched stop": True,
        "ball: time over the kinematic limit": True,
        "ball: time below half of the paper's 12.8 s": True,
        "ball: maximum force, reference posture over the method": True,
        "ball: time, collision-free over the method": False,
        "ball: maximum force of the paper (its foam is not published)": True,
    }
    slow = [{**entry, "time": 7.0, "time_ratio": 1.7, "max_contact_force": 3.0} for entry in ours]
    found = verdicts(slow + others)
    assert [text for text, met in found.items() if met] == ["ball: every goal reached, no latched stop"]


def test_one_goal_missed_or_one_stop_is_no_success():
    reached = record(time=5.0)
    text = "ball: every goal reached, no latched stop"
    assert verdicts([reached])[text] is True
    assert verdicts([reached, record(target=1)])[text] is False
    assert verdicts([reached, record(target=1, stop_reason="external torque on A2")])[text] is False
    assert verdicts([])[text] is None


def test_mismatch_scenes_are_asked_for_success():
    episodes = [record(scene="wall_mismatch", time=5.0)]
    assert verdicts(episodes, ("wall_mismatch",)) == {"wall_mismatch: every goal reached, no latched stop": True}
