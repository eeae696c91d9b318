"""The reaction to contact that no known obstacle explains."""

import numpy as np
from arm_simulation import ARM, HOME, TICK_NS
from test_planner import touch

from contact_reach_ros.planning.planner import ContactReaction
from contact_reach_ros.planning.settings import UnexpectedContactSettings
from contact_reach_ros.world.collision import clearances
from contact_reach_ros.world.spheres import Spheres


def reaction(kind: str) -> ContactReaction:
    made = ContactReaction(ARM, UnexpectedContactSettings(reaction=kind))
    for step in range(100):
        made.moved(np.array([0.4 + 0.001 * step, 0.0, 0.4]))
    return made


def ball(gap: float) -> Spheres:
    """A known one, so far from the arm."""
    center = np.array([[0.0, 0.5, 0.6]])
    spheres = Spheres(center, center, np.array([0.01]), np.array([100.0]), np.array([30.0]))
    radius = 0.01 + clearances(ARM, HOME, spheres) - gap
    return Spheres(center, center, radius, spheres.stiffness, spheres.damping)


def test_by_default_the_flange_goes_back_the_way_it_came_and_stays_there():
    it = reaction(UnexpectedContactSettings().reaction)
    assert it.report(touch(), HOME, Spheres.none(), 0) is False
    assert it.report(touch(), HOME, Spheres.none(), 10 * TICK_NS)
    target = it.position
    assert 0.05 <= np.linalg.norm(target - [0.499, 0.0, 0.4]) < 0.06 and target[0] < 0.45
    assert it.reason == "retreat: unexpected contact at lbr_link_7, 10 N"
    # Only a new goal ends it.
    assert not it.report(None, HOME, Spheres.none(), 50 * TICK_NS)
    assert it.position is target
    it.reset()
    assert it.position is None and not it.reason


def test_what_is_known_weak_or_short_is_no_reason():
    it = reaction("retreat")
    for tick in range(0, 100, 10):
        assert not it.report(touch(), HOME, ball(0.005), tick * TICK_NS)
        assert not it.report(touch(4.0), HOME, Spheres.none(), tick * TICK_NS)
    for tick in range(100, 200, 10):
        contact = None if tick % 20 else touch()
        assert not it.report(contact, HOME, Spheres.none(), tick * TICK_NS)
    assert not it.report(touch(), HOME, ball(0.02), 300 * TICK_NS)
    assert it.report(touch(), HOME, ball(0.02), 320 * TICK_NS)


def test_one_that_ignores_contact_does_nothing():
    it = reaction("ignore")
    assert not any(it.report(touch(), HOME, Spheres.none(), tick * TICK_NS) for tick in range(100))
    assert it.position is None and not it.reason
