"""Which obstacles the bring-up table sets for the planner."""

import pytest
from stack_helpers import parameter_file

from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup.processes import BringupOptions, processes
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.ros.parameters import settings_of
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import MAX_SPHERES


def planner_parameters(**options):
    (planner,) = (process for process in processes(BringupOptions(**options)) if process.name == "planner")
    return planner.parameters


@pytest.mark.parametrize(("scene", "spheres"), [("free", 0), ("ball", 1), ("wall_mismatch", MAX_SPHERES)])
def test_the_planner_looks_at_as_many_spheres_as_the_scene_needs(scene, spheres):
    assert planner_parameters(scene=scene)["max_spheres"] == spheres


def test_the_planner_is_told_what_obstacles_are_made_of(tmp_path):
    """Where materials differ, the stiffest."""
    (wall,), given = read_scene("wall").obstacles, planner_parameters(scene="wall")
    assert given["edge_stiffness"] == wall.edge_stiffness
    file = tmp_path / "own.yaml"
    balls = [f"  - {{kind: ball, center: [0.7, {y}, 0.5], stiffness: {k}}}\n" for y, k in ((0.3, 400.0), (-0.3, 60.0))]
    file.write_text(f"obstacles:\n{''.join(balls)}")
    assert planner_parameters(scene=str(file))["sphere_stiffness"] == 400.0


def test_what_the_parameter_file_says_holds(tmp_path):
    file = parameter_file(tmp_path / "own.yaml", planner={"max_spheres": 5, "period": 0.1})
    given = planner_parameters(scene="wall", parameters=str(file))
    assert "max_spheres" not in given and "edge_stiffness" in given


def test_a_real_arms_planner_is_told_nothing_of_the_simulated_scene():
    assert planner_parameters(scene="free", driver=False) == planner_parameters(scene="wall", driver=False)
    given = planner_parameters(scene="free", driver=False)
    assert not {"max_spheres", "sphere_stiffness"} & set(given)


@pytest.mark.parametrize("driver", [True, False])
def test_with_an_adapter_the_controller_commands_it_and_it_ends_after_the_controller(driver):
    table = {process.name: process.parameters for process in processes(BringupOptions(adapter="effort", driver=driver))}
    assert table["controller"]["supervision.adapter"] is True
    # The simulated driver cannot be asked for the order of its joints.
    assert (table["adapter"]["kind"], table["adapter"]["effort.ask_joints"]) == ("effort", not driver)
    # They are ended in the reverse order.
    names = list(table)
    assert names.index("adapter") < names.index("controller")
    without = {process.name: process.parameters for process in processes(BringupOptions(driver=driver))}
    assert "adapter" not in without and "supervision.adapter" not in without["controller"]


@pytest.mark.parametrize(("own", "waited_for"), [({}, "recorder"), ({"waits_for": "gripper"}, "gripper,recorder")])
def test_in_lockstep_time_waits_for_the_recorder_too(tmp_path, own, waited_for):
    file = str(parameter_file(tmp_path / "own.yaml", driver=own))
    for lockstep in (True, False):
        options = BringupOptions(lockstep=lockstep, bag=str(tmp_path / "bag"), parameters=file)
        table = {process.name: process.parameters for process in processes(options)}
        assert table["recorder"]["use_sim_time"] is lockstep
        assert table["driver"].get("waits_for") == (waited_for if lockstep else None)
        assert table["planner"].get("planning.deadline") == (0.0 if lockstep else None)


def test_overrides_reach_their_node_only(tmp_path):
    options = BringupOptions(overrides=("planner:period=0.05", "driver:seed=7"), bag=str(tmp_path / "bag"))
    given = {process.name: process.parameters for process in processes(options)}
    assert given["planner"]["period"] == 0.05 and given["driver"]["seed"] == 7 and "seed" not in given["controller"]
    assert "seed=7" in given["recorder"]["custom_data"]
    with pytest.raises(SettingsError, match="not started here"):
        processes(BringupOptions(driver=False, overrides=("driver:seed=7",)))


@pytest.mark.parametrize(
    "text",
    ["planner:period", "nobody:period=1", "planner:a={", "planner:perod=0.05", "planner:period=5"],
)
def test_an_override_that_is_none_is_refused(text):
    with pytest.raises(SettingsError):
        processes(BringupOptions(overrides=(text,)))


def test_the_planner_plans_for_gains_that_are_changed():
    options = BringupOptions(overrides=("controller:impedance.task_damping=90.0",))
    given = {process.name: process.parameters for process in processes(options)}
    assert given["controller"]["impedance.task_damping"] == 90.0
    arguments = [
        "planner",
        "-p",
        f"controller:impedance.task_damping:={given['planner']['controller:impedance.task_damping']}",
    ]
    read = settings_of(arguments, "controller", {"impedance": ImpedanceSettings}, load_arm())
    assert read["impedance"].task_damping == 90.0


def test_only_the_viewer_may_end_alone():
    table = processes(BringupOptions(view=True, bag="somewhere"))
    assert [process.name for process in table if not process.essential] == ["viewer"]
    assert not any(process.name == "viewer" for process in processes(BringupOptions()))
