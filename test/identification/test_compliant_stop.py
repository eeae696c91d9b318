"""A compliant stop carries the weights that only the observer knows."""

import dataclasses

import numpy as np
from motions import ARM

import contact_reach_ros as cr
from contact_reach_ros.observer.settings import MomentumSettings, ObserverSettings
from contact_reach_ros.world.scene import MismatchSettings

KNOWN = MomentumSettings(
    coulomb_friction=(0.6,) * 7,
    viscous_friction=(0.9,) * 7,
    center_shift_y=(0.0, -0.0562, 0.0048, -0.0727, -0.0077, 0.0033, 0.0),
)
"""What identification finds of an arm with the other inertias and 0.5 kg; test_identify.py fits it."""
FRICTIONLESS = MismatchSettings(friction_scale=0.0)
"""Nothing but the right torque holds this arm."""


def sunk(observer: ObserverSettings) -> float:
    """Distance of the flange from where it was a second after a stop, m."""
    scene = dataclasses.replace(cr.load_scene("free", arm=ARM, seed=0), mismatch=FRICTIONLESS)
    stack = cr.Stack(scene, observer=observer)
    stack.settle(1.5)
    before = stack.tip_position
    stack.stop()
    for _ in range(1000):
        stack.step()
    assert "stop requested" in stack.stop_reason
    return float(np.linalg.norm(stack.tip_position - before))


def test_the_arm_does_not_sink():
    unknown, known = sunk(ObserverSettings()), sunk(ObserverSettings(momentum=KNOWN))
    assert known < 2.0 * unknown + 1e-3 and known < 0.005, (unknown, known)
