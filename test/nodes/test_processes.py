"""What the bring-up table sets for each node."""

import pytest
from stack_helpers import parameter_file

from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup.processes import BringupOptions, processes
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.settings import PLANNER_SECTIONS
from contact_reach_ros.ros.parameters import check_arguments, settings_of
from contact_reach_ros.settings import as_arguments
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import MAX_SPHERES


def given(**options):
    """Parameters by node, in the order in which the nodes are started."""
    return {process.name: process.parameters for process in processes(BringupOptions(**options))}


@pytest.mark.parametrize(("scene", "spheres"), [("free", 0), ("ball", 1), ("wall_mismatch", MAX_SPHERES)])
def test_the_planner_looks_at_as_many_spheres_as_the_scene_needs(scene, spheres):
    assert given(scene=scene)["planner"]["max_spheres"] == spheres


def test_the_planner_is_told_what_obstacles_are_made_of(tmp_path):
    """Where materials differ, the stiffest."""
    (wall,), found = read_scene("wall").obstacles, given(scene="wall")["planner"]
    assert found["edge_stiffness"] == wall.edge_stiffness
    file = tmp_path / "own.yaml"
    balls = [f"  - {{kind: ball, center: [0.7, {y}, 0.5], stiffness: {k}}}\n" for y, k in ((0.3, 400.0), (-0.3, 60.0))]
    file.write_text(f"obstacles:\n{''.join(balls)}")
    assert given(scene=str(file))["planner"]["sphere_stiffness"] == 400.0


def test_what_the_parameter_file_says_holds(tmp_path):
    file = parameter_file(tmp_path / "own.yaml", planner={"max_spheres": 5, "period": 0.1})
    found = given(scene="wall", parameters=str(file))["planner"]
    assert "max_spheres" not in found and "edge_stiffness" in found


def test_a_real_arms_planner_is_told_nothing_of_the_simulated_scene():
    found = given(scene="free", driver=False)["planner"]
    assert found == given(scene="wall", driver=False)["planner"]
    assert not {"max_spheres", "sphere_stiffness"} & set(found)


@pytest.mark.parametrize("driver", [True, False])
def test_with_an_adapter_the_controller_commands_it_and_it_ends_after_the_controller(driver):
    table = given(adapter="effort", driver=driver)
    assert table["controller"]["supervision.adapter"] is True
    # The simulated driver cannot be asked for the order of its joints.
    assert (table["adapter"]["kind"], table["adapter"]["effort.ask_joints"]) == ("effort", not driver)
    # They are ended in the reverse order.
    assert list(table).index("adapter") < list(table).index("controller")
    without = given(driver=driver)
    assert "adapter" not in without and "supervision.adapter" not in without["controller"]


@pytest.mark.parametrize("lockstep", [True, False])
def test_in_lockstep_every_node_has_simulated_time_and_plans_have_no_deadline(lockstep):
    table = given(lockstep=lockstep, bag="bag", view=True, adapter="effort")
    assert all(parameters["use_sim_time"] is lockstep for parameters in table.values())
    assert table["planner"].get("planning.deadline") == (0.0 if lockstep else None)


def test_overrides_reach_every_node_under_the_name_of_theirs(tmp_path):
    overrides = ("planner:period=5e-2", "driver:seed=7", "observer:momentum.torque_offset=[1, 1, 1, 1, 1, 1, 1]")
    table = given(overrides=overrides, bag=str(tmp_path / "bag"))
    changed = {"planner:period": 0.05, "driver:seed": 7, "observer:momentum.torque_offset": [1] * 7}
    assert all(changed.items() <= parameters.items() for parameters in table.values())
    arguments = ["planner", "--ros-args", *as_arguments(table["planner"])]
    assert check_arguments(arguments, "planner", PLANNER_SECTIONS)[""].period == 0.05
    assert "seed=7" in table["recorder"]["custom_data"]


@pytest.mark.parametrize("text", ["planner:period", "nobody:period=1", "planner:perod=0.05", "planner:period=5"])
def test_an_override_that_is_none_is_refused(text):
    with pytest.raises(SettingsError):
        given(overrides=(text,))
    with pytest.raises(SettingsError, match="not started here"):
        given(driver=False, overrides=("driver:seed=7",))


def test_the_planner_plans_for_gains_that_are_changed():
    name = "controller:impedance.task_damping"
    table = given(overrides=(f"{name}=90.0",))
    assert table["controller"][name] == 90.0
    arguments = ["planner", "-p", f"{name}:={table['planner'][name]}"]
    read = settings_of(arguments, "controller", CONTROLLER_SECTIONS, load_arm())
    assert read["impedance"].task_damping == 90.0


def test_only_the_viewer_may_end_alone():
    table = processes(BringupOptions(view=True, bag="somewhere"))
    assert [process.name for process in table if not process.essential] == ["viewer"]
    assert "viewer" not in given()
