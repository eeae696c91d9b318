"""Planner and controller have to mean the same arm, rate and gains."""

import dataclasses

import pytest
from arm_simulation import ARM

from contact_reach_ros.agreement import OF_PLANS, differences, plan_basis
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings, LimitSettings, SupervisionSettings

CONTROLLER = ControllerSettings(
    ImpedanceSettings(), LimitSettings(body_speed=0.2), SupervisionSettings(max_position_error=0.1)
)
TOOL = Tool(mass=1.0, center=(0.03, 0.0, 0.06), flange_to_tip=(0.0, 0.0, 0.15, 0.0, 0.3, 0.0))
OWN = {**plan_basis(ARM, CONTROLLER), "state_rate": 1000.0, "supervision.hold_limit": 5.0}


def disagreement(own, planners):
    return differences(own, planners, "planner", OF_PLANS)


def test_the_same_settings_agree_whatever_else_differs():
    assert disagreement(OWN, {**OWN, "supervision.hold_limit": 1.0, "planning.deadline": 3}) == ""


@pytest.mark.parametrize(
    ("name", "value", "own"),
    [
        ("impedance.task_stiffness", 500.0, "880.0"),
        ("impedance.null_damping", 2.0, "1.0"),
        ("supervision.max_position_error", 0.2, "0.1"),
        ("limits.body_speed", 0.25, "0.2"),
        ("state_rate", 200.0, "1000.0"),
        ("robot", "other", ARM.name),
    ],
)
def test_a_difference_is_named_with_both_values(name, value, own):
    found = disagreement(OWN, {**OWN, name: value})
    assert found == f"{name} = {value} in the planner, {own} in the controller"


def test_planner_and_controller_with_different_tools_disagree_and_the_tool_is_named():
    def reported(tool):
        values = {f"tool.{entry.name}": getattr(tool, entry.name) for entry in Tool.declared()}
        return plan_basis(ARM.with_tool(tool), CONTROLLER) | values

    assert disagreement(reported(TOOL), reported(TOOL)) == ""
    differs = disagreement(reported(TOOL), reported(dataclasses.replace(TOOL, mass=2.0)))
    assert differs.startswith("tool.mass = 2.0 in the planner, 1.0 in the controller; robot digest = ")


def test_lists_are_compared_as_messages_carry_them():
    own = {"momentum.viscous_friction": (0.0, 1.0), "safety.debounce": 3}
    same, other = {"momentum.viscous_friction": [0.0, 1.0]}, {"momentum.viscous_friction": [0.0, 2.0]}
    assert differences(own, same, "observer", ("momentum.", "safety.")) == ""
    found = differences(own, other, "observer", ("momentum.", "safety."))
    assert found == "momentum.viscous_friction = [0.0, 2.0] in the observer, (0.0, 1.0) in the controller"
