"""The transfer model against the simulated robot: how it is compared, and that both agree."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM

from benchmarks import bench_model
from benchmarks.model import (
    MIN_FORCE,
    force_errors,
    motion_errors,
    predict,
)
from benchmarks.model_cases import draw_contact, draw_free, simulate
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.kinds.ball import BallSettings

STATES = 220
CONTACTS = 60
SUBSTEPS = PlanningSettings().substeps
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def free():
    cases = draw_free(ARM, np.random.default_rng(0), STATES)
    return predict(cases, SUBSTEPS), [simulate(case) for case in cases]


@pytest.fixture(scope="module")
def pushed():
    cases = draw_contact(ARM, np.random.default_rng(1), CONTACTS, BallSettings(friction=0.0))
    motions = [simulate(case) for case in cases]
    return cases, motions, force_errors(predict(cases, SUBSTEPS), motions)


def test_free_motion_agrees_to_a_millimetre_and_half_a_degree(free):
    rollout, motions = free
    every = motion_errors(rollout, motions)
    errors = every.commonly()
    assert len(errors.position) >= 150
    assert errors.position.max() <= 1e-3
    assert errors.rotation.max() <= np.radians(0.5)
    # What no arm could follow is not far off either, as a rule.
    assert np.percentile(every.position, 90) <= 1e-3


def test_contact_forces_agree_with_the_simulation_s_own_contacts(pushed):
    _, _, (force, error) = pushed
    assert len(force) >= 20
    assert force.min() >= MIN_FORCE
    assert np.median(np.abs(error)) <= 0.05
    assert np.mean(np.abs(error) <= 0.15) >= 0.85
    assert abs(np.mean(error)) <= 0.05


@pytest.mark.slow
def test_more_substeps_follow_contact_more_closely(pushed):
    cases, motions, (_, fine) = pushed
    _, coarse = force_errors(predict(cases, SUBSTEPS - 2), motions)
    assert np.percentile(np.abs(fine), 90) < 0.7 * np.percentile(np.abs(coarse), 90)


def test_errors_are_those_of_the_flange(free):
    """A shift and a turn of what was simulated come back as the errors."""
    rollout, motions = free
    shift = np.array([0.03, 0.04, 0.0])
    shifted = [dataclasses.replace(motion, positions=motion.positions + shift) for motion in motions]
    np.testing.assert_allclose(motion_errors(rollout, shifted).commonly().position, 0.05, rtol=0, atol=1e-3)
    turned = [dataclasses.replace(motion, rotations=motion.rotations @ HALF_TURN) for motion in motions]
    np.testing.assert_allclose(motion_errors(rollout, turned).commonly().rotation, np.pi, rtol=0, atol=0.1)


@pytest.mark.slow
def test_report_has_a_row_for_each_number_of_substeps(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench_model, "SUBSTEPS", (4,))
    monkeypatch.setattr(bench_model, "culling_errors", lambda *_: {})
    report = bench_model.bench_model(30, 2, tmp_path / "model.json")
    assert set(report["free"]) == set(report["contact"]) == {4}
    assert report["contact"][4]["contacts"] > 5
    assert (tmp_path / "model.json").is_file()
    assert capsys.readouterr().out.count("| 4 |") == 2
