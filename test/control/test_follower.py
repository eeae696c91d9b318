"""The reference moves from knot to knot."""

import numpy as np
import pinocchio as pin
from arm_simulation import ARM, FAR, HOME, TICK_NS, references_of
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.follower import Follower
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ImpedanceSettings, SupervisionSettings

RAMP_MS = 40
IMPEDANCE = ImpedanceSettings(reference_ramp=1e-3 * RAMP_MS).resolve(ARM)
MODEL = RobotModel(ARM)
MODEL.update(HOME, np.zeros(ARM.n))


@given(st.integers(0, 60))
def test_it_goes_straight_from_the_pose_that_was_held_to_the_knot_and_stays_there(elapsed):
    follower = Follower(ARM.n, IMPEDANCE, SupervisionSettings(**FAR), 0.001)
    follower.restart(MODEL, HOME, 0)
    start, turn = follower.reference, np.array([0.3, -0.8, 1.2])
    end = Reference(np.array([0.5, -0.2, 0.6]), pin.exp3(turn) @ start.rotation, -np.arange(7.0))
    follower.queue.offer(references_of([end], 0, (100 * TICK_NS,)), 0)
    for tick in {0, elapsed}:
        found = follower.follow(MODEL, HOME, np.zeros(6), tick * TICK_NS, True)
    share = min((elapsed + 1) / RAMP_MS, 1.0)
    np.testing.assert_allclose(found.position, (1 - share) * start.position + share * end.position, atol=1e-12)
    np.testing.assert_allclose(found.posture, (1 - share) * start.posture + share * end.posture, atol=1e-12)
    np.testing.assert_allclose(found.rotation, pin.exp3(share * turn) @ start.rotation, atol=1e-12)


def test_plans_that_come_with_every_state_move_the_reference_too():
    follower = Follower(ARM.n, IMPEDANCE, SupervisionSettings(**FAR), 0.001)
    follower.restart(MODEL, HOME, 0)
    start, end = follower.reference, np.array([0.5, -0.2, 0.6])
    for tick in range(1, 4 * RAMP_MS):
        target = Reference(end, start.rotation, HOME)
        follower.queue.offer(references_of([target], tick * TICK_NS, (100 * TICK_NS,)), tick * TICK_NS)
        found = follower.follow(MODEL, HOME, np.zeros(6), tick * TICK_NS, True)
    assert np.linalg.norm(found.position - end) < 0.02 * np.linalg.norm(start.position - end)
