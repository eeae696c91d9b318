"""What the oracle says of scenes whose answer is known."""

import json

import numpy as np
import pytest
from arm_simulation import ARM
from contact_reach_command import bench

from benchmarks import oracle
from benchmarks.clutter import Clutter
from benchmarks.oracle import Kind, classify
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.obstacle import BallSettings
from contact_reach_ros.world.scene_file import SceneFile, TargetSettings

LIMIT = load_budget().permitted_force
TIP, _ = RobotModel(ARM).tip_pose(np.array(ARM.home))
TARGET = TIP + np.array([0.0, 0.45, 0.05])


def scene(*bodies):
    place = TargetSettings(start=tuple(np.array(ARM.home).tolist()), position=tuple(TARGET.tolist()))
    return make_scene(SceneFile("known", place, bodies), ARM, 0)


def beside_the_target(stiffness, gap=0.005):
    """A ball that the hand cannot but press into where the flange is at the target."""
    return BallSettings(center=tuple(TARGET + np.array([0.08 + gap, 0.0, 0.0])), radius=0.08, stiffness=stiffness)


@pytest.mark.parametrize(
    ("bodies", "kind"),
    [
        ((), Kind.FREE),
        ((BallSettings(center=tuple(0.5 * (TIP + TARGET)), radius=0.08, stiffness=1000.0),), Kind.FREE),
        ((beside_the_target(60.0),), Kind.CONTACT),
        ((beside_the_target(2000.0),), Kind.BEYOND),
    ],
    ids=["nothing in the way", "a way around", "soft at the goal", "hard at the goal"],
)
def test_it_says_what_a_scene_asks_for(bodies, kind):
    found = classify(ARM, scene(*bodies), LIMIT)
    assert found.kind is kind
    assert (found.free_goals > 0) == (kind is Kind.FREE) and (found.tolerant_goals > 0) == (kind is not Kind.BEYOND)
    assert (found.least_force > LIMIT) == (kind is Kind.BEYOND)
    if kind is not Kind.BEYOND:
        assert (0.0 < found.path_force <= LIMIT) if kind is Kind.CONTACT else found.path_force == 0.0
        assert found.path_length > 0.3
    assert classify(ARM, scene(*bodies), LIMIT) == found


def test_its_command_lists_the_seeds_of_each_kind(tmp_path, capsys):
    file = tmp_path / "kinds.jsonl"
    assert bench(oracle, "--seed", "4", "--scenes", "2", "--json", str(file)) == 0
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert [line["seed"] for line in lines] == [4, 5]
    shown = capsys.readouterr().out
    for line in lines:
        assert f"| {line['kind']} | 1 | {line['seed']} |" in shown
    kind = lines[1]["kind"]
    assert Clutter(kind=kind, seed=4, scenes=1).seeds == Clutter(kind=kind, oracle=file, scenes=1).seeds == [5]
    assert bench(oracle, "--scenes", "0") == 2
    with pytest.raises(SettingsError, match=r"has kinds; expected a --kind, too"):
        Clutter(oracle=file)
    with pytest.raises(SettingsError, match=f"has 1 scenes of kind {kind}; expected 2"):
        _ = Clutter(kind=kind, oracle=file, scenes=2).seeds
    file.write_text("{}")
    with pytest.raises(SettingsError, match="expected what benchmarks"):
        _ = Clutter(kind=kind, oracle=file, scenes=1).seeds
