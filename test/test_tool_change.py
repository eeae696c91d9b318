"""Another tool while the arm is held: no step of the torque, no stop; and refusals in motion."""

import dataclasses

import mujoco
import numpy as np
import pytest
from arm_simulation import ARM, IDEAL_SENSORS, NO_FRICTION, random_states

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.bringup.tool_change import CARRYING, change_tool, tool_in
from contact_reach_ros.control.agreement import disagreement, plan_basis
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.observer.safety import SafetyLevel
from contact_reach_ros.ros.stopping import Outcome
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.generate import load_scene

TOOL = Tool(
    mass=1.0,
    center=(0.03, 0.0, 0.06),
    inertia=(0.002, 0.002, 0.001, 0.0, 0.0, 0.0),
    flange_to_tip=(0.0, 0.0, 0.15, 0.0, 0.3, 0.0),
)
LOADED = ARM.with_tool(TOOL)
SETTLED_MS = 1500


@pytest.fixture
def stack():
    """Held without a goal, the brakes open for long."""
    stack = Stack(load_scene("free", arm=ARM))
    for _ in range(SETTLED_MS):
        stack.step()
    assert stack.controller.mode is Mode.HOLDING and not stack.stop_reason
    return stack


def change(stack: Stack, arm) -> None:
    """As the nodes do."""
    stack.observer.change_model(stack.observer.models(arm))
    stack.controller.change_tool(Controller(arm, stack.controller.settings), stack.observer.models(arm))


def torques(stack: Stack, ticks: int) -> np.ndarray:
    """Commands of the next ticks, (ticks, n), N m."""
    return np.array([stack.step().torque for _ in range(ticks)])


@pytest.mark.parametrize("attached_first", [True, False])
def test_the_torques_go_on_and_nothing_stops(stack, attached_first):
    before = torques(stack, 100)
    noise = np.abs(np.diff(before, axis=0)).max(axis=0)
    gravity, change_ms = RobotModel(ARM).gravity_at(stack.state.q), 300
    started = stack.robot.plant.tip_position
    if attached_first:
        stack.robot.plant.change_tool(LOADED)
        carried = torques(stack, change_ms)
        change(stack, LOADED)
    else:
        change(stack, LOADED)
        stack.robot.plant.change_tool(LOADED)
        carried = torques(stack, 1)
    after = torques(stack, 1000)
    weight = RobotModel(LOADED).gravity_at(stack.state.q) - gravity
    assert np.abs(weight).max() > 5.0
    assert not stack.stop_reason and stack.controller.mode is Mode.HOLDING
    assert stack.observer.monitor.level is SafetyLevel.FREE
    np.testing.assert_allclose((after[-200:] - before.mean(axis=0)).mean(axis=0), weight, atol=1.0)
    steps = np.abs(np.diff(np.concatenate([carried[-1:], after]), axis=0)).max(axis=0)
    # No more than the limit of the torque's rate: 4 Nm per tick on A1, and in proportion.
    assert (steps <= 0.004 * 1000 * ARM.torque_limits / ARM.torque_limits.max() + 1e-9).all()
    if attached_first:
        # The impedance carried it already: there is no step at all.
        assert (steps <= 1.0 + 2.0 * noise).all(), steps
    assert np.abs(stack.observer.momentum.residual).max() < 1.5
    assert np.linalg.norm(stack.robot.plant.tip_position - started) > 0.1


def test_the_wrong_tool_stops_the_arm_at_its_hand_over(stack):
    change(stack, ARM.with_tool(dataclasses.replace(TOOL, mass=3.0)))
    for _ in range(500):
        stack.step()
    assert "gravity or payload does not match the arm" in stack.stop_reason


def test_in_motion_it_is_refused(stack):
    stack.robot.plant.data.qvel[1] = 0.3
    stack.step()
    stack.step()
    other = Controller(LOADED, stack.controller.settings)
    for refused in (
        lambda: stack.controller.change_tool(other),
        lambda: stack.observer.change_model(stack.observer.models(LOADED)),
    ):
        with pytest.raises(InputError, match=r"the arm moves with 0\.\d+ rad/s; another tool needs at most 0\.05"):
            refused()
    assert stack.controller.arm is ARM and stack.observer.arm is ARM


@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.STOPPED])
def test_under_a_plan_and_in_a_compliant_stop_the_controller_refuses_it(stack, mode):
    stack.controller.supervisor.mode = mode
    with pytest.raises(InputError, match=f"the controller is {mode.value}; another tool needs it to hold the arm"):
        stack.controller.change_tool(Controller(LOADED, stack.controller.settings))


def mass_matrix(plant: Plant) -> np.ndarray:
    full = np.zeros((plant.model.nv, plant.model.nv))
    mujoco.mj_fullM(plant.model, plant.data, full)
    return full


def test_the_simulated_flange_carries_what_it_would_from_the_start():
    changed = Plant(load_scene("free", arm=ARM), IDEAL_SENSORS, NO_FRICTION)
    changed.change_tool(ARM.with_tool(dataclasses.replace(TOOL, mass=4.0)))
    changed.change_tool(LOADED)
    new = Plant(dataclasses.replace(load_scene("free", arm=ARM), arm=LOADED), IDEAL_SENSORS, NO_FRICTION)
    for q, v in zip(*random_states(20), strict=True):
        for plant in (changed, new):
            plant.data.qpos[: ARM.n], plant.data.qvel[: ARM.n] = q, v
            mujoco.mj_forward(plant.model, plant.data)
        np.testing.assert_allclose(changed.data.qfrc_bias, new.data.qfrc_bias, rtol=0, atol=1e-9)
        np.testing.assert_allclose(mass_matrix(changed), mass_matrix(new), rtol=0, atol=1e-9)
        np.testing.assert_allclose(changed.tip_position, new.tip_position, rtol=0, atol=1e-12)
        np.testing.assert_allclose(changed.data.geom_xpos, new.data.geom_xpos, rtol=0, atol=1e-12)


def test_planner_and_controller_with_different_tools_disagree_and_the_tool_is_named():
    def reported(tool):
        values = {f"tool.{entry.name}": getattr(tool, entry.name) for entry in Tool.declared()}
        return plan_basis(ARM.with_tool(tool), ImpedanceSettings(), 0.1) | values

    assert disagreement(reported(TOOL), reported(TOOL)) == ""
    differs = disagreement(reported(TOOL), reported(dataclasses.replace(TOOL, mass=2.0)))
    assert differs.startswith("tool.mass = 2.0 in the planner, 1.0 in the controller; robot digest = ")


class TestOrder:
    def test_each_node_gets_all_values_in_an_order_that_lets_no_goal_pass(self, capsys):
        asked = []

        def accept(node, values):
            asked.append((node, values["tool.mass"], len(values)))
            return Outcome(True, "")

        assert change_tool(accept, CARRYING, TOOL).done
        names = ["planner", "driver", "controller", "observer", "adapter"]
        assert asked == [(name, 1.0, len(list(Tool.declared()))) for name in names]
        assert "observer: has the tool" in capsys.readouterr().out

    def test_a_refusal_of_the_first_changes_nothing(self):
        outcome = change_tool(lambda node, values: Outcome(False, "there is a goal"), CARRYING, TOOL)
        assert outcome == (False, "the planner refuses the tool; nothing has changed")

    def test_a_refusal_half_way_names_who_has_it_already(self, capsys, monkeypatch):
        monkeypatch.setattr("contact_reach_ros.bringup.tool_change._PATIENCE_S", 0.0)
        outcome = change_tool(lambda node, values: Outcome(node != "observer", "it moves"), CARRYING, TOOL)
        assert not outcome.done and "planner, driver, controller already have it" in outcome.text
        assert "observer: it moves" in capsys.readouterr().out

    def test_the_arm_may_take_a_moment_to_come_to_rest(self):
        answers = {"planner": [True], "controller": [False, False, True]}
        assert change_tool(lambda node, values: Outcome(answers[node].pop(0), ""), list(answers), TOOL).done


def test_the_file_is_the_one_that_the_nodes_are_started_with(tmp_path):
    file = tmp_path / "tool.yaml"
    file.write_text("/**: {ros__parameters: {tool: {mass: 1.5, center: [0, 0, 0.05]}}}\n")
    assert tool_in(file) == Tool(mass=1.5, center=(0.0, 0.0, 0.05))
    file.write_text("/**: {ros__parameters: {robot: iiwa14}}\n")
    with pytest.raises(SettingsError, match="no section 'tool' for the controller"):
        tool_in(file)
