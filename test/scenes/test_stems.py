"""The plant: its fruits are the targets, its stems bend, and the planner expects what MuJoCo does."""

import dataclasses

import numpy as np
import pytest

from benchmarks.stems import push
from contact_reach_ros import load_scene
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup.processes import processes
from contact_reach_ros.bringup.settings import BringupOptions
from contact_reach_ros.errors import SceneError, SettingsError
from contact_reach_ros.messages.obstacle_markers import ObstacleMarkerWriter
from contact_reach_ros.messages.obstacle_reader import ObstacleMarkerReader
from contact_reach_ros.planning.obstacles import Network
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.obstacles import BEND_LIMIT
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

PLANT = read_scene("plant")
SCENE = load_scene("plant")
(STEMS,) = SCENE.obstacles


def of_direction(node: int) -> np.ndarray:
    along = STEMS.rest[node] - STEMS.rest[0]
    return along / np.linalg.norm(along)


def test_targets_are_the_fruits_of_a_plant_that_the_seed_turns():
    settings = PLANT.obstacles[0]
    fruits = settings.goals(np.array(settings.center))
    assert (len(settings.stems), len(fruits)) == (15, 3)
    seen = set()
    for seed in range(12):
        target = load_scene("plant", seed=seed).target
        # Turned about the vertical through the root.
        assert np.isclose(fruits[:, 2], target[2]).any()
        assert np.isclose(
            np.linalg.norm(fruits - settings.center, axis=1), np.linalg.norm(target - settings.center)
        ).any()
        seen.add(tuple(target.round(6)))
    assert len(seen) == 12
    assert np.array_equal(load_scene("plant", seed=3).target, load_scene("plant", seed=3).target)


@pytest.mark.parametrize("stem", [0, 5, 14])
def test_a_stem_yields_at_every_node_as_the_planner_expects(stem):
    softness = Network(obstacle_spheres(SCENE, rest_positions(SCENE))).softness
    for node in STEMS.bending.stems[stem][1:]:
        plant = Plant(SCENE)
        direction = np.cross(of_direction(node), [0.3, 0.5, 0.8])
        direction /= np.linalg.norm(direction)
        push(plant, f"plant_0_{node}", 0.5 * direction, 300)
        moved = plant.obstacle_positions() - STEMS.rest
        assert moved[node] @ direction == pytest.approx(0.5 * softness[node], rel=0.03)
        others = [each for each in range(len(STEMS.rest)) if each not in STEMS.bending.stems[stem]]
        assert np.abs(moved[others]).max() < 1e-6


def test_no_joint_bends_beyond_its_limit_and_the_stem_returns():
    plant, node = Plant(SCENE), STEMS.bending.stems[5][-1]
    across = np.cross(of_direction(node), [0.0, 0.0, 1.0])
    push(plant, f"plant_0_{node}", 30.0 * across, 300)
    assert np.abs(plant.data.qpos[SCENE.arm.n :]).max() < BEND_LIMIT + 0.1
    assert np.linalg.norm(plant.obstacle_positions()[node] - STEMS.rest[node]) > 0.1
    push(plant, f"plant_0_{node}", np.zeros(3), 1000)
    assert np.abs(plant.obstacle_positions() - STEMS.rest).max() < 1e-3


def test_markers_have_the_stiffness_of_each_edge_and_bringup_passes_no_other():
    data = ObstacleMarkerWriter(SCENE).write(rest_positions(SCENE), 1_000_000_000)
    read, own = ObstacleMarkerReader(SCENE.arm.base_frame).read(data), obstacle_spheres(SCENE, rest_positions(SCENE))
    # Of each body the reader has the spheres that can move first.
    order = np.r_[1 : len(own), 0]
    assert np.allclose(read.center, own.center[order], atol=1e-9)
    all_of = np.arange(len(own))
    compliances = Network(read).compliance(all_of, all_of), Network(own).compliance(order, order)
    assert np.allclose(*compliances, rtol=1e-3, atol=1e-9)
    assert (read.damping == own.damping).all()
    (planner,) = [each for each in processes(BringupOptions(scene="plant")) if each.name == "planner"]
    assert "edge_stiffness" not in planner.parameters


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stems": []}, "expected a list of stems such as '4 45 180 fruit'"),
        ({"stems": ["1 20 0 fruit"]}, "stem '1 20 0 fruit': expected 2 to 20 links"),
        ({"stems": ["4 45 inf"]}, "stem '4 45 inf': expected"),
        ({"stems": ["4 45"]}, "stem '4 45': expected"),
        ({"stems": ["4 45 0 flower"]}, "'fruit' or nothing"),
        ({"stems": ["4 200 0"]}, "stem '4 200 0': expected 2 to 20 links, 0 to 180 degrees"),
        ({"rigidity": 1.3}, r"rigidity = 1.3: expected a number in \[0.001, 1.25\] N m²"),
        ({"rigidity": -0.15}, r"rigidity = -0.15: expected a number in \[0.001, 1.25\] N m²"),
        ({"rigidity": float("nan")}, r"rigidity = nan: expected a number"),
        ({"radius": 0.0}, r"radius = 0.0: expected a number in \[0.002, 0.05\] m"),
    ],
)
def test_stems_that_cannot_be_are_refused(change, message):
    with pytest.raises(SettingsError, match=message):
        dataclasses.replace(PLANT.obstacles[0], **change)


def test_a_plant_in_the_arm_and_one_of_too_many_links_are_refused_with_what_to_do(tmp_path):
    inside = dataclasses.replace(PLANT.obstacles[0], center=(0.0, 0.0, 0.0))
    with pytest.raises(SceneError, match=r"lbr_link_0 lies \d+\.\d mm deep in the plant .* move plant.center"):
        make_scene(dataclasses.replace(PLANT, obstacles=(inside,)), load_arm(), 0)
    file = tmp_path / "dense.yaml"
    file.write_text(f"base: plant\nplant: {{stems: {['20 45 0'] * 11}}}\n")
    with pytest.raises(SceneError, match=r"221 spheres and nodes, 220 of which can move; .* at most 450 and 200"):
        read_scene(str(file))


def test_a_scene_changes_the_plant_of_its_base_key_by_key(tmp_path):
    file = tmp_path / "soft.yaml"
    file.write_text("base: plant\nplant: {rigidity: 0.01}\n")
    assert read_scene(str(file)).obstacles == (dataclasses.replace(PLANT.obstacles[0], rigidity=0.01),)


def test_goals_in_a_stem_and_fruits_out_of_reach_are_refused_with_the_numbers():
    between = STEMS.rest[list(STEMS.bending.stems[5][1:3])].mean(axis=0)
    with pytest.raises(SceneError, match=r"target .* lies \d\.\d mm inside the plant"):
        load_scene("plant", target=between)
    far = dataclasses.replace(PLANT.obstacles[0], center=(1.4, 0.0, 0.0))
    with pytest.raises(SceneError, match=r"plant.yaml: goal: position is \d\.\d+ m from the shoulder"):
        make_scene(dataclasses.replace(PLANT, obstacles=(far,)), load_arm(), 0)
