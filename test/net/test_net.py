"""What the package computes stays so while its code is rearranged.

Where nothing touches rounding, episodes have the same hash. Where the compiler rounds differently, candidates of equal
cost change places and the runs part: the tolerances are twice what other compiler flags make of the same code.
"""

import itertools

import numpy as np
import pytest
from episodes import RECORDED, SCENES, SEEDS, run_episode
from net_bags import BAGS

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.reexecution.loops import reexecute

EARLY = 60
"""Samples during which the first plans are in force."""


OUTPUTS = {"controller": 4205, "observer": 4350}
"""Outputs of the bag that can be compared."""


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "seed"), itertools.product(SCENES, SEEDS))
def test_episodes_take_the_same_course(scene: str, seed: int) -> None:
    with np.load(RECORDED) as recorded:
        known = {name: recorded[f"{scene}_{seed}/{name}"] for name in ("tip", "torques", "hash", "duration", "force")}
    episode = run_episode(scene, seed)
    assert episode.result.reached
    if episode.hash == str(known["hash"]):
        return
    common = min(len(episode.tip), len(known["tip"]))
    distance = np.linalg.norm(episode.tip[:common] - known["tip"][:common], axis=1)
    assert distance[:EARLY].max() < 5e-3
    assert distance.max() < 14e-3
    assert episode.result.duration == pytest.approx(float(known["duration"]), rel=0.08)
    assert episode.result.max_contact_force == pytest.approx(float(known["force"]), abs=1.2)


def test_controller_and_observer_answer_as_recorded() -> None:
    """In real time, with states that were lost."""
    inputs = RecordedInputs(BagReader(BAGS / "real_time"))
    for node in ("controller", "observer"):
        found = reexecute(node, inputs)
        assert found.first_difference is None
        assert found.compared >= OUTPUTS[node]
