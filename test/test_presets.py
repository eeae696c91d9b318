"""What each preset sets, and that nodes take the same files."""

import dataclasses

import pytest
from arm_simulation import ARM

import contact_reach_ros as cr
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.presets import PRESETS, check_parameters, preset, preset_file

PAPER = ("paper_linear", "paper_hinge")


@pytest.mark.parametrize("name", PRESETS)
def test_nodes_take_the_file_of_every_preset(name):
    check_parameters(preset_file(name))


def test_shipped_is_what_the_nodes_run():
    shipped = preset("shipped")
    assert shipped.planning == cr.PlanningSettings().resolve(ARM)
    assert shipped.replanning == cr.ReplanningSettings()
    assert shipped.unexpected_contact == cr.UnexpectedContactSettings()


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_presets_have_its_solver_latch_and_time_of_a_plan(name):
    found = preset(name)
    planning = found.planning
    assert planning.sampling == "paper"
    assert (planning.population, planning.elite, planning.max_steps) == (200, 50, 100)
    assert planning.deadline == planning.null_motion_weight == planning.lead_change_weight == 0.0
    assert found.replanning.period == found.replanning.latency == 0.47
    assert found.controller.impedance.reference_ramp == 0.0
    assert found.unexpected_contact.reaction == "ignore"


@pytest.mark.parametrize(
    ("name", "force", "cost"),
    [("paper_hinge", 4.0, 0.0), ("paper_hinge", 12.0, 10.0), ("paper_linear", 4.0, 20.0), ("paper_linear", 12.0, 60.0)],
)
def test_the_readings_differ_in_what_a_newton_costs(name, force, cost):
    """λ3 = 5 per newton: above ε = 10 N only, or everywhere, up to the constant λ3 ε."""
    planning = preset(name).planning
    assert planning.contact_weight * force + planning.contact_limit_weight * max(0.0, force - 10.0) == cost


def test_the_readings_differ_in_nothing_else():
    linear, hinge = (preset(name) for name in PAPER)
    same = dataclasses.replace(hinge.planning, contact_weight=5.0, contact_limit_weight=0.0)
    assert linear == hinge._replace(planning=same)


def test_a_stack_takes_a_preset():
    stack = cr.Stack(cr.load_scene("free", arm=ARM), **preset("paper_hinge")._asdict())
    assert stack.planner.settings.latency == 0.47


def test_an_unknown_preset_is_refused_with_those_there_are():
    with pytest.raises(SettingsError, match="preset 'paper' is unknown; expected one of paper_linear, paper_hinge"):
        preset("paper")
