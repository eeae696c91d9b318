"""Where forces on the arm are drawn."""

import numpy as np
from arm_simulation import ARM

from contact_reach_ros.arm import link_frames
from contact_reach_ros.messages.safety_state import OK, WARN, SafetyState
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.viewer.frame import Frame
from contact_reach_ros.viewer.scene import arrows
from contact_reach_ros.world.spheres import Spheres

HOME = np.array(ARM.home)


def frame(**more) -> Frame:
    return Frame(time=0.0, q=HOME, external_torque=None, plan=None, goal=None, **more)


def test_estimate_is_drawn_where_the_observer_says():
    contact = Contact("lbr_link_5", np.array([0.1, 0.2, 0.9]), np.array([0.0, -4.0, 0.0]), np.zeros(ARM.n))
    safety = {
        "observer": SafetyState(0.0, WARN, "observer", "contact", contact),
        "controller": SafetyState(0.0, OK, "controller", "tracking"),
    }
    (arrow,) = arrows(ARM, frame(obstacles=None, safety=safety))
    assert arrow.estimated
    np.testing.assert_array_equal(arrow.point, contact.position)
    np.testing.assert_array_equal(arrow.force, contact.force)


def test_known_force_is_drawn_on_the_surface_towards_the_obstacle():
    capsule = ARM.capsules[3]
    rotations, origins = link_frames(ARM, HOME)
    rotation, origin = rotations[capsule.link - 1], origins[capsule.link - 1]
    start, end = (origin + rotation @ point for point in (capsule.start, capsule.end))
    middle = 0.5 * (start + end)
    sideways = np.cross(end - start, [0.3, 0.5, 0.8])
    sideways /= np.linalg.norm(sideways)
    center = (middle + (capsule.radius + 0.05) * sideways)[None]
    ball = Spheres(center, center, np.array([0.06]), np.array([500.0]), np.array([10.0]))
    name = ARM.link_names[capsule.link - 1]
    (arrow,) = arrows(ARM, frame(obstacles=ball, forces={name: 5.0, ARM.link_names[0]: 0.0}, safety={}))
    assert not arrow.estimated
    np.testing.assert_allclose(arrow.point, middle + capsule.radius * sideways, atol=1e-9)
    np.testing.assert_allclose(arrow.force, -5.0 * sideways, atol=1e-9)
