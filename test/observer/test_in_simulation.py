"""Observer and monitor on the arm that the real controller moves, in lockstep, with friction, noise and mismatch."""

import numpy as np
from arm_simulation import ARM

from benchmarks.free_motion import FreeMotion
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.safety import SafetyLevel
from contact_reach_ros.world.scene import MismatchSettings

BUDGET = ContactBudget()
MISMATCH = MismatchSettings()


def run(motion: FreeMotion, until: float) -> FreeMotion:
    while motion.plant.time < until and not motion.monitor.stopped:
        motion.tick()
    return motion


def push(motion: FreeMotion, body: str, force: tuple[float, float, float]) -> None:
    motion.plant.data.xfrc_applied[motion.plant.model.body(body).id, :3] = force


def test_free_motion_is_neither_contact_nor_collision():
    motion = run(FreeMotion(ARM, MISMATCH, 3, BUDGET), 5.0)
    assert not motion.monitor.stopped
    assert motion.monitor.contacts == 0
    # The arm did move, and was watched.
    assert np.abs(motion.observer.momentum.residual).max() > 0.0
    assert np.linalg.norm(motion.state.q - motion.plant.scene.start) > 0.05


def test_push_is_a_contact_that_ends_with_it_and_a_hard_one_stops_the_arm():
    motion = run(FreeMotion(ARM, MISMATCH, 0, BUDGET), 2.0)
    push(motion, "lbr_link_4", (0.0, 0.0, -15.0))
    run(motion, 2.06)
    assert motion.monitor.level is SafetyLevel.CONTACT
    push(motion, "lbr_link_4", (0.0, 0.0, 0.0))
    run(motion, 2.6)
    assert motion.monitor.level is SafetyLevel.FREE
    push(motion, "lbr_link_5", (0.0, 0.0, -80.0))
    run(motion, 2.7)
    assert motion.monitor.level is SafetyLevel.COLLISION
    assert "torque on lbr_A" in motion.monitor.stop_reason
    assert motion.plant.time < 2.63
