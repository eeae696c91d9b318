"""Where forces on the arm are drawn."""

import numpy as np

from contact_reach_ros.observer.location import Contact
from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.scenes.overlap import capsule_segments
from contact_reach_ros.viewer.contacts import arrows
from contact_reach_ros.viewer.frame import Frame, Level, Status

HOME = np.array(iiwa14.HOME_POSITION)


def frame(**more) -> Frame:
    return Frame(time=0.0, q=HOME, external_torque=None, plan=None, goal=None, **more)


def test_estimate_is_drawn_where_the_observer_says():
    contact = Contact("lbr_link_5", np.array([0.1, 0.2, 0.9]), np.array([0.0, -4.0, 0.0]), 4.0)
    safety = {"observer": Status(Level.CONTACT, "contact", contact), "controller": Status(Level.OK, "tracking")}
    (arrow,) = arrows(frame(obstacles=None, safety=safety))
    assert arrow.estimated
    np.testing.assert_array_equal(arrow.point, contact.position)
    np.testing.assert_array_equal(arrow.force, contact.force)


def test_known_force_is_drawn_on_the_surface_towards_the_obstacle():
    place = 3
    capsule = iiwa14.CAPSULES[place]
    starts, ends = capsule_segments(HOME)
    middle = 0.5 * (starts[place] + ends[place])
    sideways = np.cross(ends[place] - starts[place], [0.3, 0.5, 0.8])
    sideways /= np.linalg.norm(sideways)
    center = (middle + (capsule.radius + 0.05) * sideways)[None]
    ball = Spheres(center, center, np.array([0.06]), np.array([500.0]), np.array([10.0]))
    name = iiwa14.LINK_NAMES[capsule.link - 1]
    (arrow,) = arrows(frame(obstacles=ball, forces={name: 5.0, iiwa14.LINK_NAMES[0]: 0.0}, safety={}))
    assert not arrow.estimated
    np.testing.assert_allclose(arrow.point, middle + capsule.radius * sideways, atol=1e-9)
    np.testing.assert_allclose(arrow.force, -5.0 * sideways, atol=1e-9)
