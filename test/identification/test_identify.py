"""Identification of an arm from its motion with noise, and what is written of it."""

import dataclasses

import numpy as np
import pytest
from motions import ARM, COULOMB, OFFSET, VISCOUS, recording

from contact_reach_ros.arm.tool import NO_TOOL, Tool
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.identification.command import describe, write
from contact_reach_ros.identification.identify import identify
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.presets import check_parameters
from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import parameters_in

SETTINGS, BUDGET = ObserverSettings(), load_budget()
HELD = Tool(mass=0.8, center=(0.0, 0.02, 0.06), flange_to_tip=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def taken():
    return recording(ARM.with_tool(HELD), 29.0)


@pytest.fixture(scope="module")
def found(taken):
    return identify(ARM, NO_TOOL, SETTINGS, BUDGET, taken)


def test_tool_friction_and_offsets_of_a_motion_with_noise(found):
    assert found.tool.mass == pytest.approx(HELD.mass, rel=0.02)
    np.testing.assert_allclose(found.tool.center, HELD.center, atol=5e-3)
    np.testing.assert_allclose(found.momentum.coulomb_friction, COULOMB, atol=0.05)
    np.testing.assert_allclose(found.momentum.viscous_friction, VISCOUS, atol=0.1)
    np.testing.assert_allclose(found.momentum.torque_offset, OFFSET, atol=0.05)
    assert found.rms_ratio < 1.0 / 3.0 and (found.after.rms < 0.6 * found.before.rms).all()


def test_thresholds_follow_and_none_is_raised(found):
    before = BUDGET.resolve(ARM)
    for entry in ContactBudget.declared():
        assert np.all(np.array(getattr(found.budget, entry.name)) <= np.array(getattr(before, entry.name)))
    assert (np.divide(found.budget.contact_thresholds, before.contact_thresholds)[2:] < 0.7).all()
    assert found.budget.permitted_force == before.permitted_force
    # At rest, dry friction may carry so much.
    carried = np.minimum(found.momentum.coulomb_friction, before.handover_thresholds)
    assert (np.array(found.budget.handover_thresholds) >= carried - 0.01).all()


def test_links_that_differ_make_no_tool_of_negative_mass():
    with pytest.raises(InputError, match=r"a tool of -0\.6.* would explain the torques: the links differ"):
        identify(ARM.with_tool(Tool(mass=0.6)), NO_TOOL, SETTINGS, BUDGET, recording(ARM, 29.0))


def test_links_of_the_bare_arm_and_then_its_tool():
    shifted = ARM.with_center_shifts((0.0,) * 7, (0.0, -0.04, 0.01, 0.02, 0.0, -0.01, 0.0))
    bare = identify(ARM, NO_TOOL, SETTINGS, BUDGET, recording(shifted, 40.0), links=True)
    assert bare.tool is None
    np.testing.assert_allclose(bare.momentum.center_shift_y[1:6], (-0.04, 0.01, 0.02, 0.0, -0.01), atol=5e-3)
    settings = dataclasses.replace(SETTINGS, momentum=bare.momentum)
    held = shifted.with_tool(Tool(mass=0.5, center=(0.0, 0.0, 0.05)))
    loaded = identify(ARM, NO_TOOL, settings, BUDGET, recording(held, 29.0))
    assert loaded.tool.mass == pytest.approx(0.5, rel=0.05)
    assert loaded.momentum.center_shift_y[:6] == bare.momentum.center_shift_y[:6]


def test_what_was_found_before_is_found_again(found, taken):
    """On an arm whose nodes have a tool, and friction, from an earlier identification."""
    settings = dataclasses.replace(SETTINGS, momentum=found.momentum)
    again = identify(ARM, dataclasses.replace(HELD, mass=0.3), settings, BUDGET, taken)
    assert again.momentum == found.momentum
    assert again.tool.mass == pytest.approx(HELD.mass, abs=2e-3)
    assert again.tool.flange_to_tip == HELD.flange_to_tip
    np.testing.assert_allclose(again.after.rms, found.after.rms, rtol=0.01)


def test_the_files_are_those_that_nodes_read(found, tmp_path):
    base = tmp_path / "base.yaml"
    base.write_text("observer:\n  ros__parameters:\n    momentum: {gain: 40.0}\n    safety: {debounce: 4}\n")
    file, _ = write(found, base, tmp_path / "mine.yaml", "a test")
    check_parameters(file)
    observer = parameters_in(file, "observer")
    assert observer["momentum.gain"] == 40.0 and observer["safety.debounce"] == 4
    assert tuple(observer["momentum.coulomb_friction"]) == found.momentum.coulomb_friction
    assert load_budget(observer["contact_budget"]) == found.budget
    for node in ("planner", "controller", "driver"):
        assert parameters_in(file, node)["tool.mass"] == found.tool.mass
    check_parameters(write(found, config_file("default.yaml"), tmp_path / "second.yaml", "a test")[0])
    text = describe(found, ARM, BUDGET.resolve(ARM))
    assert f"tool: {found.tool.mass:.3f} ± 0.00" in text and "contact_thresholds, Nm" in text
    assert f"falls to {found.rms_ratio:.2f} of before" in text


def test_what_does_not_fit_together_is_refused(tmp_path, found):
    base = tmp_path / "base.yaml"
    base.write_text("observer: 3\n")
    with pytest.raises(SettingsError, match="'observer' has no ros__parameters"):
        write(found, base, tmp_path / "mine.yaml", "a test")
    with pytest.raises(InputError, match="cannot be written"):
        write(found, config_file("default.yaml"), base / "mine.yaml", "a test")
