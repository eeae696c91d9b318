"""Episodes of the grid: the same wherever and in whatever order they are run."""

import dataclasses
import itertools

import pytest

from benchmarks.grid import DEADLINE_STEPS, Cell, EpisodeTask, Setup, cell_of, run_cell
from benchmarks.workers import run_each
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.scene_file import read_scene

TINY = Setup(
    planning=PlanningSettings(deadline=0.0, population=32, horizon=1, substeps=2, max_steps=3),
    timeout=0.6,
)


def tasks():
    scene, cells = read_scene("free"), itertools.product(["hold", "free"], [0], [0, 1])
    return [EpisodeTask(Cell("free", goal, "cma_es", *seeds), scene, 0.05, TINY) for goal, *seeds in cells]


def figures(record):
    return {key: value for key, value in record.items() if key != "timing"}


@pytest.mark.slow
def test_other_processes_and_another_order_give_the_same_to_the_last_bit():
    here = [run_cell(task) for task in tasks()]
    found = {cell_of(record): record for record in run_each(run_cell, tasks()[::-1], 2)}
    assert [figures(found[task.cell]) for task in tasks()] == [figures(record) for record in here]
    assert {record["failure"] for record in here} == {""}


def test_an_error_is_a_failed_episode_with_its_message():
    task = tasks()[0]
    strange = dataclasses.replace(task, cell=dataclasses.replace(task.cell, method="rrt"))
    record = run_cell(strange)
    assert not record["reached"] and cell_of(record) == strange.cell
    assert record["failure"].startswith("SettingsError: method 'rrt' is unknown")


def test_a_preset_is_run_without_the_wall_clock():
    shipped, paper = (Setup.of(name, ContactBudget()) for name in ("shipped", "paper_hinge"))
    assert (shipped.planning.deadline, shipped.planning.max_steps) == (0.0, DEADLINE_STEPS)
    assert (paper.planning.deadline, paper.planning.max_steps) == (0.0, 100)
    # What plans nothing on the way answers at once.
    assert paper.latency("contact_reach") == paper.latency("collision_free") == paper.latency("reactive") == 0.04
    ours = paper.options("contact_reach", "hold", 0.04)
    assert (ours.period, ours.timeout, ours.until_settled) == (0.03, 20.0, True)
    assert paper.options("collision_free", "hold", 0.04).period == 0.03
