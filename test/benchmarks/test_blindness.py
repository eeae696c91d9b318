"""The map of blindness says what the observer does with a real force, and the docs show it."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from contact_reach_command import bench

from benchmarks import blindness, pictures
from benchmarks.blindness import Blindness, Contacts, estimate_error, measure, random_contacts, random_postures
from contact_reach_ros.arm import Arm, JointState
from contact_reach_ros.arm.capsules import segment_distances, shape_radii, shape_segments
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.safety import HANDOVER_TIME
from contact_reach_ros.observer.settings import MomentumSettings, ObserverSettings

ROOT = Path(__file__).parents[2]
SUDDEN = ObserverSettings(momentum=MomentumSettings(gain=500.0))
"""An observer so quick that its baseline takes up nothing of a force that appears at once."""
BEFORE, AFTER = 0.97, 1.06
"""Shares of the least force with which nothing happens, and with which it does."""
SPEED = 0.25
TICK_NS = 1_000_000
PUSHED = 25
"""States with the force."""


def pushed(arm: Arm, contacts: Contacts, index: int, force: float, speed: float) -> Observer:
    """The observer after a force on the arm at rest, or in motion with a constant speed of all joints, of their limits.

    What the arm feels of the force, and its dynamics, are Pinocchio's.
    """
    model = RobotModel(arm)
    link, there = model.pinocchio.getJointId(arm.joint_names[contacts.link[index] - 1]), model.pinocchio.createData()
    pin.computeJointJacobians(model.pinocchio, there, contacts.q[index])
    jacobian = pin.getJointJacobian(model.pinocchio, there, link, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
    lever = contacts.point[index] - there.oMi[link].translation
    external = force * jacobian.T @ np.concatenate([contacts.force[index], np.cross(lever, contacts.force[index])])
    observer = Observer(arm, SUDDEN, load_budget())
    v, states = speed * arm.velocity_limits, round(1e3 * HANDOVER_TIME) + 20
    for state in range(states + PUSHED):
        # An encoder's last bit is never still.
        q = contacts.q[index] + 1e-3 * (state - states) * v + 1e-9 * (-1) ** state
        torque = pin.rnea(model.pinocchio, there, q, v, np.zeros(arm.n)) - external * (state >= states)
        observer.update(JointState(state * TICK_NS, q, v, torque))
    assert not observer.sight.blind
    return observer


def draw(name: str) -> tuple[Arm, Blindness, list[int]]:
    """The map of a few contacts, and one of them on each link that a force below 1 kN shows."""
    arm = load_arm(name)
    found = measure(arm, random_contacts(arm, random_postures(arm, 4, 7), 1, 7), SPEED)
    shown = np.flatnonzero(found.stops < 1000.0)
    return arm, found, [int(index) for index in shown[np.unique(found.contacts.link[shown], return_index=True)[1]]]


@pytest.mark.parametrize(
    "name", ["iiwa14", pytest.param("panda", marks=pytest.mark.slow), pytest.param("ur10", marks=pytest.mark.slow)]
)
def test_a_force_is_noticed_and_stops_the_arm_from_where_the_map_says(name):
    arm, found, shown = draw(name)
    assert len(shown) >= 5
    for index in shown:
        for speed, noticed, stops in (
            (0.0, found.noticed[index], found.stops[index]),
            (SPEED, found.noticed_moving[index], found.stops_moving[index]),
        ):
            quiet, touched, pressed, stopped = (
                pushed(arm, found.contacts, index, share * least, speed).monitor
                for least in (noticed, stops)
                for share in (BEFORE, AFTER)
            )
            assert not quiet.contacts and touched.contacts == 1, (index, speed)
            assert not pressed.stopped and "sudden external torque" in stopped.stop_reason, (index, speed)


def test_the_estimate_is_what_the_observer_reports_in_proportion_to_the_force():
    arm, found, shown = draw("iiwa14")
    for index in shown:
        for factor in (AFTER, 3.0):
            force = factor * found.noticed[index]
            observer = pushed(arm, found.contacts, index, force, 0.0)
            contact = observer.locate(found.contacts.q[index])
            assert contact.strength == pytest.approx(found.estimate[index] * force, rel=0.1, abs=0.2)
            assert arm.link_names.index(contact.link) + 1 == found.named[index]


def test_contacts_lie_on_the_bare_surface_and_press_inwards():
    arm = load_arm("panda")
    q = random_postures(arm, 1, 3)
    contacts = random_contacts(arm, q, 400, 3)
    starts, ends = shape_segments(arm, q)

    def depths(points: np.ndarray) -> np.ndarray:
        return shape_radii(arm) - segment_distances((points[:, None], points[:, None]), (starts, ends))

    assert depths(contacts.point).max() < 1e-9
    assert depths(contacts.point + 1e-3 * contacts.force).max(axis=1) == pytest.approx(1e-3, abs=1e-5)


def test_the_error_is_what_a_force_may_have_above_the_permitted_one_before_its_estimate_has():
    arm = load_arm("iiwa14")
    found = measure(arm, random_contacts(arm, random_postures(arm, 50), 8))
    errors = estimate_error(arm, share=1.0, postures=50)
    for link, name in enumerate(arm.link_names[1:], start=2):
        own = found.contacts.link == link
        force = (found.permitted + errors[name]) * 1.001
        over = (found.estimate * force >= found.permitted) & (found.noticed <= force) | (found.stops <= force)
        assert over[own].all(), name
    assert errors["lbr_link_2"] > 100.0 > errors["lbr_link_5"] > 0.0


@pytest.mark.parametrize(
    ("name", "page"),
    [
        ("iiwa14", "docs/safety.md"),
        *(pytest.param(name, "benchmarks/README.md", marks=pytest.mark.slow) for name in ("panda", "ur10")),
    ],
)
@pytest.mark.slow
def test_the_docs_show_what_the_command_prints(name, page, capsys):
    assert bench(blindness, "--arm", name) == 0
    rows = [row for row in capsys.readouterr().out.splitlines() if row.startswith("|")]
    assert len(rows) == 2 + len(load_arm(name).contact_links)
    for row in rows:
        assert row in (ROOT / page).read_text(), f"{page} lacks the row {row}"


@pytest.mark.slow
def test_the_picture_is_drawn_from_the_run(tmp_path):
    file, pictures_of = tmp_path / "blindness.json", [tmp_path / name for name in ("one.svg", "two.svg", "one.png")]
    assert bench(blindness, "--postures", 20, "--json", file) == 0
    for picture in pictures_of:
        assert bench(pictures, file, picture) == 0
    one, two = (picture.read_text() for picture in pictures_of[:2])
    shipped = (ROOT / "docs" / "blindness.svg").read_text()
    assert one == two and len(shipped) < 60_000
    assert all(f">{link}<" in drawn for link in load_arm().contact_links for drawn in (one, shipped))


@pytest.mark.parametrize("arguments", [("--postures", 0), ("--points", 0), ("--speed", 2), ("--arm", "none")])
def test_what_cannot_be_drawn_is_refused(arguments, capsys):
    assert bench(blindness, *arguments) == 2
    assert "expected" in capsys.readouterr().err
