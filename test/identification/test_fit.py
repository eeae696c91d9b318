"""The fit against torques that are known exactly."""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from motions import ARM, COULOMB, OFFSET, VISCOUS, samples

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.mount import mounted
from contact_reach_ros.arm.tool import NO_TOOL, Tool
from contact_reach_ros.errors import InputError
from contact_reach_ros.identification.fit import Parameters, fit

HELD = Tool(mass=0.8, center=(0.02, -0.03, 0.06))
SHIFTS_X, SHIFTS_Y = (0.0, 0.01, -0.02, 0.0, 0.03, 0.0, 0.01), (0.0, -0.04, 0.01, 0.02, 0.0, -0.01, 0.0)


def flange_moment(tool: Tool) -> np.ndarray:
    """Mass and first moment in the frame of the last link."""
    return tool.mass * np.array([1.0, *np.add(tool.center, ARM.tip_offset)])


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.0, 1.5708, 0.0), (3.1416, 0.0, 0.0)])
def test_exact_torques_give_exact_values_of_the_tool_or_of_the_links(mount):
    arm = dataclasses.replace(ARM, gravity=mounted(mount))
    held = arm.with_tool(HELD)
    found = fit(Parameters(arm, NO_TOOL), samples(held, 40.0))
    expected = {"tool": flange_moment(HELD), "coulomb": COULOMB, "viscous": VISCOUS, "offset": OFFSET}
    for kind, values in expected.items():
        np.testing.assert_allclose(found.of(kind)[0], values, atol=1e-5)
    assert found.known.all() and not found.unknown
    links = fit(Parameters(held, None), samples(held.with_center_shifts(SHIFTS_X, SHIFTS_Y), 40.0))
    np.testing.assert_allclose(links.of("shift_x")[0][1:], SHIFTS_X[1:], atol=1e-3)
    np.testing.assert_allclose(links.of("shift_y")[0][1:], SHIFTS_Y[1:], atol=1e-3)


def test_intervals_hold_the_truth_as_often_as_they_promise():
    """Errors of the torques are alike for a quarter of a second: intervals for independent ones would be far off."""
    taken = samples(ARM.with_tool(HELD), 60.0)
    parameters = Parameters(ARM, NO_TOOL)
    truth = np.concatenate([flange_moment(HELD), COULOMB, VISCOUS, OFFSET])
    random, covered = np.random.default_rng(0), []
    for _ in range(8):
        noise = random.standard_normal(taken.torque.shape)
        for index in range(1, len(noise)):
            noise[index] = 0.92 * noise[index - 1] + 0.39 * noise[index]
        found = fit(parameters, taken._replace(torque=taken.torque + 0.2 * noise))
        covered.append(np.abs(found.values - truth) <= found.half_widths)
    assert 0.91 < np.mean(covered) < 0.99
    assert np.mean(covered, axis=0).min() > 0.6


def test_what_the_motion_does_not_tell_is_said_and_has_no_number():
    found = fit(Parameters(ARM, NO_TOOL), samples(ARM.with_tool(HELD), 40.0, joints=[0, 6]))
    names = found.parameters.names
    words = " ".join(found.unknown)
    for name in ("coulomb A2", "viscous A4", "offset A3", "tool moment z"):
        assert name in words
        assert np.isnan(found.half_widths[names.index(name)]) and found.values[names.index(name)] == 0.0
    for name, expected in (("coulomb A7", COULOMB[6]), ("viscous A1", VISCOUS[0])):
        assert found.values[names.index(name)] == pytest.approx(expected, abs=1e-3)
        assert np.isfinite(found.half_widths[names.index(name)])


def test_torques_without_weight_and_without_rotors():
    """Of an arm that compensates gravity itself, and whose sensors are behind the gears."""
    taken = samples(ARM.with_tool(HELD), 40.0)
    model = RobotModel(ARM.with_tool(HELD))
    weight = np.array([pin.computeGeneralizedGravity(model.pinocchio, model.data, q).copy() for q in taken.q])
    rotors = model.pinocchio.armature * taken.a
    bare = taken._replace(torque=taken.torque - weight - rotors)
    found = fit(Parameters(ARM, NO_TOOL, gravity=False, rotors=False), bare)
    np.testing.assert_allclose(found.of("coulomb")[0], COULOMB, atol=0.02)
    np.testing.assert_allclose(found.of("offset")[0], OFFSET, atol=0.02)
    assert found.of("tool")[1][0] > 0.0


def test_no_motion_and_a_motion_that_is_too_short_are_refused():
    resting = samples(ARM, 40.0, joints=[])
    with pytest.raises(InputError, match="no joint moves fast enough"):
        fit(Parameters(ARM, NO_TOOL), resting)
    with pytest.raises(InputError, match="lasts 15 s, too short for 25 parameters"):
        fit(Parameters(ARM, NO_TOOL), samples(ARM, 15.0))
