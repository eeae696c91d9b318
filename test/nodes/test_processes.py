"""What the bring-up table tells the planner about the obstacles."""

import pytest
from stack_helpers import parameter_file

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.nodes.processes import StackOptions, processes
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.spheres import WALL_SPHERES


def planner_parameters(**options):
    (planner,) = (process for process in processes(StackOptions(**options)) if process.name == "planner")
    return planner.parameters


@pytest.mark.parametrize(
    ("scene", "spheres"),
    [("free", 0), ("ball", 1), ("wall", WALL_SPHERES), ("ball_mismatch", 1), ("wall_mismatch", WALL_SPHERES)],
)
def test_the_planner_looks_at_as_many_spheres_as_the_scene_needs(scene, spheres):
    assert planner_parameters(scene=scene)["max_spheres"] == spheres


def test_the_planner_is_told_what_walls_are_made_of():
    wall, told = read_scene("wall").wall, planner_parameters(scene="wall")
    assert told["edge_stiffness"] == wall.edge_stiffness
    assert told["node_damping"] == wall.damping
    assert told["node_stiffness"] == wall.anchor_stiffness


def test_the_planner_is_told_its_own_stiffness(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("base: wall\nwall: {edge_stiffness: 50.0, anchor_stiffness: 4.0, planner_stiffness_scale: 1.5}\n")
    told = planner_parameters(scene=str(file))
    assert (told["edge_stiffness"], told["node_stiffness"]) == (75.0, 6.0)


def test_what_the_parameter_file_says_holds(tmp_path):
    file = parameter_file(tmp_path / "own.yaml", planner={"max_spheres": 5, "period": 0.1})
    told = planner_parameters(scene="wall", parameters=str(file))
    assert "max_spheres" not in told and "edge_stiffness" in told


def test_overrides_reach_their_node_only():
    options = StackOptions(overrides=("planner:period=0.05", "driver:seed=7", "planner:goal_orientation=free"))
    told = {process.name: process.parameters for process in processes(options)}
    assert told["planner"]["period"] == 0.05 and told["planner"]["goal_orientation"] == "free"
    assert told["driver"]["seed"] == 7 and "seed" not in told["controller"]


@pytest.mark.parametrize(
    "text", ["planner", "planner:period", "nobody:period=1", "planner:=1", "planner:a=[1]", "planner:a={"]
)
def test_an_override_that_is_none_is_refused(text):
    with pytest.raises(SettingsError, match="override"):
        processes(StackOptions(overrides=(text,)))


def test_only_the_viewer_may_end_alone():
    table = processes(StackOptions(view=True, bag="somewhere"))
    assert [process.name for process in table if not process.essential] == ["viewer"]
    assert not any(process.name == "viewer" for process in processes(StackOptions()))
