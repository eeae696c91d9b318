"""Controller and simulated arm together: hold, expiry, stop."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, VELOCITY_LIMITS, ClosedLoop, ideal_plant

from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ControllerSettings, SupervisionSettings
from contact_reach_ros.control.supervisor import REST_TIME, Mode
from contact_reach_ros.simulation.plant import FRICTION
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings, Scene

MS = 1_000_000
REAL = {"friction": FRICTION, "mismatch": NO_MISMATCH}


def moving_plan(loop: ClosedLoop, milliseconds: int) -> None:
    """A plan that moves the flange at about 0.09 m/s, one knot per 100 ms."""
    now = loop.reference()
    count = milliseconds // 100
    knots = [
        Reference(now.position + np.array([-0.01 * k, 0.008 * k, 0.01 * k]), now.rotation, now.posture)
        for k in range(count)
    ]
    loop.plan(knots, *(100 * MS * (index + 1) for index in range(count)))


@pytest.mark.parametrize(("arm", "period"), [({}, 0.001), (REAL, 0.005)], ids=["ideal", "friction and noise at 200 Hz"])
def test_arm_is_held_then_follows_a_plan_and_comes_to_rest_when_none_follows(arm, period):
    loop = ClosedLoop(ideal_plant(**arm), period=period)
    loop.finish(1.0)
    assert loop.controller.mode is Mode.HOLDING
    assert np.abs(loop.q - HOME).max() < 2e-3 and np.abs(loop.v).max() < 0.01
    moving_plan(loop, 600)
    loop.finish(0.6)
    at_expiry = loop.reference().position
    assert np.abs(loop.v).max() > 0.05
    for _ in loop.run(1.0):
        assert np.abs(loop.torques[-1] - loop.controller.model.gravity).max() < 60.0
    assert loop.controller.mode is Mode.HOLDING
    assert np.abs(loop.v).max() < 0.01
    assert np.linalg.norm(loop.reference().position - at_expiry) < 1e-3


PATIENT = ControllerSettings(supervision=SupervisionSettings(drive_brakes=False))
"""To see the compliant stop alone, however long it takes."""


@pytest.mark.parametrize(
    ("arm", "late"),
    [({}, 0), ({}, 2), ({**REAL, "mismatch": MismatchSettings()}, 2)],
    ids=["ideal", "ideal, late", "mismatch, late"],
)
def test_compliant_stop_brakes_a_fast_arm_even_when_commands_come_late(arm, late):
    plant = ideal_plant(**arm)
    plant.data.qvel[:] = 0.7 * VELOCITY_LIMITS * np.array([1, -1, 1, -1, 1, -1, 1])
    loop = ClosedLoop(plant, PATIENT, late=late)
    loop.controller.stop("test")
    energy = [loop.v @ loop.v]
    for _ in loop.run(1.0):
        energy.append(loop.v @ loop.v)
    # No joint swings up, nor does the arm sink under the wrong gravity.
    assert max(energy) < 1.1 * energy[0]
    assert np.abs(loop.v).max() < 0.05


def test_a_stopped_arm_does_not_sink_with_a_wrong_model():
    start = HOME + 0.4 * np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    stack = Stack(Scene("sinking", ARM, 0, start, np.zeros(3), mismatch=MismatchSettings()), controller=PATIENT)
    stack.settle(1.5)
    stack.stop()
    plant = stack.robot.plant
    stopped_at = plant.tip_position
    for _ in range(3000):
        stack.step()
        assert np.linalg.norm(plant.tip_position - stopped_at) < 0.01
        assert np.abs(plant.data.qvel[: ARM.n]).max() < 0.02
    assert stack.controller.mode is Mode.STOPPED


def test_a_stopped_arm_ends_in_the_brakes():
    """It is held for `REST_TIME`, and can be released afterwards."""
    stack = Stack(Scene("stopped", ARM, 0, HOME, np.zeros(3), mismatch=MismatchSettings()))
    stack.settle(1.0)
    stack.stop()
    stopped_at, travel, ticks = stack.robot.plant.tip_position, 0.0, 0
    while stack.controller.mode is Mode.STOPPED:
        stack.step()
        ticks += 1
        travel = max(travel, float(np.linalg.norm(stack.robot.plant.tip_position - stopped_at)))
    assert REST_TIME <= ticks / 1000 < REST_TIME + 0.1
    assert stack.controller.stop_reason == "stop requested"
    for _ in range(150):
        stack.step()
    assert stack.robot.stop_reason.startswith("no command for ") and travel < 0.01
    stack.reset()
    for _ in range(700):
        stack.step()
    assert stack.controller.mode is Mode.HOLDING and not stack.stop_reason and stack.robot.is_open
