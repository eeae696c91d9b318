"""Which references are in force when, and where they bring the arm."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, rotation_about
from planning_helpers import MS
from plans import make_plan

from contact_reach_ros.arm import link_frames
from contact_reach_ros.control.references import Reference, Way
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.prediction import Predictor, hold_at, pieces_between, reference_at

HOLD = hold_at(ARM, HOME)


def plan_at(effect_ms: int, label: float, knots: int = 3) -> Plan:
    """A plan whose reference positions are (label + knot, 0, 0)."""
    positions = np.zeros((knots, 3))
    positions[:, 0] = label + np.arange(knots)
    rotations, postures = np.tile(HOLD.rotation, (knots, 1, 1)), np.tile(HOME, (knots, 1))
    return make_plan(positions, rotations, postures, effect_ns=effect_ms * MS)


def label_at(plans: list[Plan], milliseconds: float) -> float | None:
    reference = reference_at(plans, round(milliseconds * MS))
    return None if reference is None else reference.position[0]


def test_knot_holds_up_to_and_including_its_end():
    plans = [plan_at(0, 10.0)]
    assert label_at(plans, 0) is None
    assert label_at(plans, 0.001) == 10.0
    assert label_at(plans, 100) == 10.0
    assert label_at(plans, 100.001) == 11.0
    assert label_at(plans, 300) == 12.0
    assert label_at(plans, 300.001) is None


def test_newer_plan_takes_over_when_it_takes_effect_and_not_before():
    plans = [plan_at(0, 10.0), plan_at(150, 20.0)]
    assert label_at(plans, 150) == 11.0
    assert label_at(plans, 150.001) == 20.0
    # A plan that has run out does not give the arm back to an older one.
    assert label_at([plan_at(0, 10.0, knots=10), plan_at(150, 20.0)], 500) is None


def test_time_is_cut_where_the_reference_changes():
    plans = [plan_at(0, 10.0), plan_at(130, 20.0)]
    pieces = pieces_between(plans, HOLD, 60 * MS, 270 * MS, 0.025)
    assert sum(piece.duration for piece in pieces) == pytest.approx(0.21)
    assert max(piece.duration for piece in pieces) <= 0.025 + 1e-9
    duration = {}
    for piece in pieces:
        label = piece.held.position[0]
        duration[label] = duration.get(label, 0.0) + piece.duration
    assert duration == pytest.approx({10.0: 0.04, 11.0: 0.03, 20.0: 0.1, 21.0: 0.04})


@pytest.mark.parametrize(("milliseconds", "share"), [(101, 0.02), (125, 0.5), (150, 1.0), (180, 1.0)])
def test_reference_moves_between_knots_as_the_controller_moves_it(milliseconds, share):
    turned = rotation_about([0.0, 0.6, 0.8], 0.7) @ HOLD.rotation
    knots = np.array([[0.5, 0.0, 0.4], [0.6, -0.1, 0.4]]), np.array([HOLD.rotation, turned]), np.array([HOME, -HOME])
    plan = make_plan(*knots, effect_ns=0, before=HOLD, ramp_s=0.05)
    expected = Way(*(Reference(*(half[knot] for half in knots)) for knot in (0, 1))).at(share)
    for found, part in zip(plan.in_force(milliseconds * MS), expected, strict=True):
        np.testing.assert_allclose(found, part, rtol=0, atol=1e-9)


def test_predicted_arm_moves_to_the_reference(objective):
    predictor = Predictor(objective.system)
    q, v, _ = predictor.predict(HOME, REST, None, pieces_between([], HOLD, 0, 0, 0.025))
    np.testing.assert_allclose(q[:, 0], HOME, rtol=0, atol=1e-6)
    plan = plan_at(0, 0.0, knots=10)
    plan.positions[:] = HOLD.position + np.array([0.01, 0.0, -0.01])
    q, v, _ = predictor.predict(HOME, REST, None, pieces_between([plan], HOLD, 0, 1000 * MS, 0.025))
    flange = link_frames(ARM, np.asarray(q, dtype=float)[:, 0])[1][-1]
    np.testing.assert_allclose(flange, plan.positions[0], rtol=0, atol=5e-4)
    assert np.abs(v).max() < 0.01
