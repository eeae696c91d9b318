"""What keeps the joints below their speed limits."""

import numpy as np
import pytest
from arm_simulation import POSITION_LIMITS, TICK_NS, VELOCITY_LIMITS, ClosedLoop, ideal_plant, offer_plan
from scipy.spatial.transform import Rotation

from contact_reach_ros.control.references import Reference


def null_direction(loop: ClosedLoop) -> np.ndarray:
    """How the joints move, (7,) of length 1, while the flange rests: A1 outwards."""
    model = loop.controller.model
    model.update(loop.q, loop.v)
    direction = np.linalg.svd(model.jacobian)[2][-1]
    return direction * np.sign(direction[0])


@pytest.mark.parametrize(("pulled", "least", "most"), [("posture", 0.3, 0.6), ("flange", 0.8, 0.95)])
def test_a_joint_that_a_plan_pulls_too_fast_is_braked_and_no_stop_is_needed(pulled, least, most):
    """References stay far ahead of the posture, which the flange must not feel, or far ahead of the flange."""
    loop = ClosedLoop(ideal_plant())
    start = loop.reference()
    fastest = farthest = 0.0

    def replan() -> None:
        if loop.now_ns % (40 * TICK_NS) == 0:
            if pulled == "posture":
                ahead = Reference(start.position, start.rotation, loop.q + 0.2 * null_direction(loop))
            else:
                ahead = Reference(loop.reference().position + np.array([0.0, 0.12, 0.0]), start.rotation, loop.q)
            offer_plan(loop.controller, [ahead], loop.now_ns, (100 * TICK_NS,), loop.now_ns)

    for _ in loop.run(0.5, replan):
        fastest = max(fastest, float((np.abs(loop.v) / VELOCITY_LIMITS).max()))
        farthest = max(farthest, float(np.linalg.norm(loop.reference().position - start.position)))
    assert not loop.controller.stop_reason
    assert least < fastest < most
    assert pulled == "flange" or farthest < 2e-3


@pytest.mark.parametrize("seed", [2, 9, 12])
def test_references_that_jump_about_near_a_singularity_do_not_make_a_joint_too_fast(seed):
    """Every 40 ms the farthest that a plan may ask for, elsewhere six times a second."""
    random = np.random.default_rng(seed)
    loop = ClosedLoop(ideal_plant(random.uniform(-0.7, 0.7, 7) * POSITION_LIMITS))
    loop.controller.model.update(loop.q, loop.v)
    assert np.linalg.svd(loop.controller.model.jacobian)[1][-1] < 0.2
    wish = np.sign(random.normal(size=6))

    def replan() -> None:
        nonlocal wish
        if loop.now_ns % (160 * TICK_NS) == 0:
            wish = np.sign(random.normal(size=6))
        if loop.now_ns % (40 * TICK_NS) == 0:
            here = loop.reference()
            turned = Rotation.from_rotvec(0.2 * wish[3:]).as_matrix() @ here.rotation
            wanted = Reference(here.position + 0.01 * wish[:3], turned, here.posture)
            offer_plan(loop.controller, [wanted], loop.now_ns, (60 * TICK_NS,), loop.now_ns)

    for _ in loop.run(1.0, replan):
        if loop.controller.stop_reason:
            break
        assert (np.abs(loop.v) < VELOCITY_LIMITS).all()
    assert "rad/s" not in loop.controller.stop_reason
