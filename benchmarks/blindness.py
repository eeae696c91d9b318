"""Where torques cannot see: the least contact force that is noticed, or stops the arm, and the error of its estimate.

Contacts are drawn uniformly on the arm's surface, as its capsules describe it, in random postures in which it touches
neither the floor nor itself. Each presses along the surface's normal on an arm that is its model; what the torques show
of it, thresholds and location are the observer's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.output import Report, command_line, given, machine, percentiles, run_command, table, write_report
from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.capsules import moving, segment_distances, shape_radii, shape_segments, shapes
from contact_reach_ros.arm.kinematics import link_frames_of_many
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import DEFAULT_ARM, load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.location import ContactLocator
from contact_reach_ros.world.collision import nearest
from contact_reach_ros.world.rigid import Plane

HARM = 140.0
"""Force that a quasi-static contact may have on hand and fingers, N (ISO/TS 15066)."""
FORCES = (10.0, 30.0)
"""Of which the estimate is compared with the true one, N."""
BINS = 8
"""Along each link, of the picture."""

_FLOOR = (Plane("floor", (0.0, 0.0, 0.0)),)
_UNSEEN = 9999.0
"""Forces above it, N, are not told apart in tables."""
_UNFELT = 1e9
"""Stands for the least force, N, where no joint feels any."""


@dataclasses.dataclass(frozen=True)
class Contacts:
    """P contacts, each with the force 1 N against the arm.

    Attributes
    ----------
    q
        Postures (P, n), rad.
    link
        Numbers (P,) of the touched links, counted from 1.
    along
        Places (P,) from one end of the link's capsule, 0, to the other, 1.
    point, force
        Points on the surface (P, 3), m, and forces (P, 3), N, base frame.
    torque
        External torques (P, n), N m.
    """

    q: Array
    link: NDArray[np.intp]
    along: Array
    point: Array
    force: Array
    torque: Array


def random_postures(arm: Arm, count: int, seed: int = 0) -> Array:
    """Joint angles (count, n), rad, uniform within the limits where the arm touches neither floor nor itself."""
    random, found = np.random.default_rng(seed), np.zeros((0, arm.n))
    while len(found) < count:
        q = random.uniform(arm.lower, arm.upper, (count, arm.n))
        clear = [near.distance > 0.0 for near in nearest(arm, q, _FLOOR)]
        found = np.concatenate([found, q[clear]])
    return found[:count]


def random_contacts(arm: Arm, q: Array, points: int, seed: int = 0) -> Contacts:
    """Contacts on the surface of the arm in postures `q` (N, n), rad: so many on each capsule, less those in others."""
    random = np.random.default_rng(seed)
    starts, ends = shape_segments(arm, q)
    places = np.mgrid[: len(q), moving(arm).start : starts.shape[1], :points]
    posture, shape = (index.ravel() for index in places[:2])
    start, axis, radius = starts[posture, shape], (ends - starts)[posture, shape], shape_radii(arm)[shape]
    length = np.linalg.norm(axis, axis=1)
    axis /= length[:, None]
    across = np.cross(axis, random.standard_normal(axis.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    # Of points that are uniform on a sphere or a cylinder, the places along the axis are uniform, too.
    along = random.uniform(size=len(axis))
    place = along * (length + 2.0 * radius) - radius
    foot = np.clip(place, 0.0, length)
    cosine = ((place - foot) / radius)[:, None]
    normal = cosine * axis + np.sqrt(1.0 - cosine**2) * across
    point = start + foot[:, None] * axis + radius[:, None] * normal
    inside = segment_distances((point[:, None], point[:, None]), (starts[posture], ends[posture])) < shape_radii(arm)
    inside[np.arange(len(point)), shape] = False
    bare = ~inside.any(axis=1)
    posture, shape, point, force = posture[bare], shape[bare], point[bare], -normal[bare]
    axes, origins = link_frames_of_many(arm, q)
    turning, origin = axes[:-1, 2][:, :, posture].transpose(2, 0, 1), origins[:-1][:, :, posture].transpose(2, 0, 1)
    link = np.array([one.link for one in shapes(arm)])[shape]
    felt = np.arange(arm.n) < link[:, None]
    torque = felt * np.einsum("pjc,pjc->pj", turning, np.cross(point[:, None] - origin, force[:, None]))
    return Contacts(q[posture], link, along[bare], point, force, torque)


@dataclasses.dataclass(frozen=True)
class Blindness:
    """What the observer makes of P contacts.

    Attributes
    ----------
    contacts
        The contacts.
    noticed, stops
        Least forces (P,) that are reported, and that stop the arm, at rest, N.
    noticed_moving, stops_moving
        The same while all joints move.
    estimate
        Estimated force (P,), N per N of the true force, which it is in proportion to.
    named
        Numbers (P,) of the links that are taken for the touched ones.
    permitted
        ε of the contact budget, N.
    """

    contacts: Contacts
    noticed: Array
    stops: Array
    noticed_moving: Array
    stops_moving: Array
    estimate: Array
    named: NDArray[np.intp]
    permitted: float

    def missing(self, force: float) -> Array:
        """What the estimate lacks (P,), N, of a force at rest, N: all of it unless it is noticed."""
        return force * (1.0 - self.estimate * (force > self.noticed))

    @property
    def excess(self) -> Array:
        """True force (P,) at rest, N, less the permitted one, when the estimate reaches that or the arm stops."""
        read = np.maximum(self.permitted / np.maximum(self.estimate, 1.0 / _UNFELT), self.noticed)
        return np.minimum(read, self.stops) - self.permitted


def measure(arm: Arm, contacts: Contacts, speed: float = 0.25) -> Blindness:
    """What the observer makes of contacts, with the shipped budget; `speed`: of each joint, as a share of its limit."""
    budget = load_budget().resolve(arm)
    moving = speed * arm.velocity_limits
    contact, contact_per_speed = np.array(budget.contact_thresholds), np.array(budget.contact_per_speed)
    # Without an error of the model all external torque is sudden.
    stop = np.minimum(budget.sudden_thresholds, budget.torque_thresholds)
    stop_per_speed = np.array(budget.torque_per_speed)
    locator = ContactLocator(RobotModel(arm), budget.contact_thresholds)
    found = [locator.locate(q, torque) for q, torque in zip(contacts.q, contacts.torque, strict=True)]
    return Blindness(
        contacts,
        _least_force(contacts, contact),
        _least_force(contacts, stop),
        _least_force(contacts, contact + contact_per_speed * moving),
        _least_force(contacts, stop + stop_per_speed * moving),
        np.array([one.strength for one in found]),
        np.array([1 + arm.link_names.index(one.link) for one in found]),
        budget.permitted_force,
    )


def _least_force(contacts: Contacts, limits: Array) -> Array:
    """Force (P,), N, from which on the torque of any joint exceeds its limit, (n,) N m."""
    shares: Array = np.abs(contacts.torque) / limits
    return 1.0 / np.maximum(shares.max(axis=1), 1.0 / _UNFELT)


def estimate_error(
    arm: Arm, share: float = 0.95, postures: int = 300, points: int = 8, seed: int = 0
) -> dict[str, float]:
    """By how much a contact force may exceed the permitted one, N, before its estimate does, by the link's name.

    An arm that stops sooner ends it there. So it is in a `share` of the contacts on each link, at rest, with an arm
    that is its model.
    """
    contacts = random_contacts(arm, random_postures(arm, postures, seed), points, seed)
    excess = measure(arm, contacts).excess
    own = {arm.link_names[link - 1]: excess[contacts.link == link] for link in np.unique(contacts.link)}
    return {name: max(float(np.quantile(values, share)), 0.0) for name, values in own.items()}


def bench_blindness(
    arm: str = DEFAULT_ARM,
    postures: int = 1500,
    points: int = 8,
    speed: float = 0.25,
    seed: int = 0,
    file: Path | None = None,
) -> Report:
    """Measure, print a table and write JSON to `file`; `points`: on each capsule in each posture.

    Raises
    ------
    SettingsError
        If there is no such arm, not at least one posture or point, or the speed is not a share.
    """
    for name, value in (("postures", postures), ("points", points)):
        if value < 1:
            raise SettingsError(f"--{name} {value}: expected at least 1")
    if not 0.0 <= speed <= 1.0:
        raise SettingsError(f"--speed {speed:g}: expected a share of the joints' speed limits, 0 to 1")
    loaded = load_arm(arm)
    found = measure(loaded, random_contacts(loaded, random_postures(loaded, postures, seed), points, seed), speed)
    links = {loaded.link_names[link - 1]: _link_report(found, int(link)) for link in np.unique(found.contacts.link)}
    report: Report = {
        "bench": "blindness",
        "machine": machine(),
        "arm": arm,
        "postures": postures,
        "points": points,
        "speed": speed,
        "seed": seed,
        "permitted_force_N": found.permitted,
        "links": links,
    }
    print(f"{arm}, {postures} postures; forces in N: p50 / p95 / max\n{_table(report)}")
    write_report(report, file)
    return report


def _link_report(found: Blindness, link: int) -> dict[str, Any]:
    own = found.contacts.link == link
    along = np.minimum((BINS * found.contacts.along).astype(int), BINS - 1)
    bins = [own & (along == place) for place in range(BINS)]
    names = ("noticed", "stops", "noticed_moving", "stops_moving")
    return {
        "contacts": int(own.sum()),
        **{f"{name}_N": percentiles(getattr(found, name)[own]) for name in names},
        **{f"{name}_above_{HARM:g}_N": float((getattr(found, name)[own] > HARM).mean()) for name in names},
        "missing_N": {f"{force:g}": percentiles(found.missing(force)[own]) for force in FORCES},
        "excess_N": percentiles(found.excess[own]),
        "named_right": float((found.named[own] == link).mean()),
        "named_within_one": float((np.abs(found.named[own] - link) <= 1).mean()),
        "along": [
            {name: percentiles(getattr(found, name)[one]) for name in ("noticed", "stops")} if one.any() else None
            for one in bins
        ],
    }


def _table(report: Report) -> str:
    permitted = f"{report['permitted_force_N']:g} N"
    header = [
        "link",
        "noticed",
        "stops",
        f"stops at {100.0 * report['speed']:g} % of speed",
        f"stops above {HARM:g} N",
        *(f"estimate lacks of {force:g} N" for force in FORCES),
        f"true force when {permitted} are estimated",
        "link right, ± 1",
    ]
    rows = []
    for name, link in report["links"].items():
        figures = [link[key] for key in ("noticed_N", "stops_N", "stops_moving_N")]
        figures += [link["missing_N"][f"{force:g}"] for force in FORCES]
        noticed, stops, moving, *missing = map(_triple, figures)
        above = f"{100.0 * link[f'stops_above_{HARM:g}_N']:.1f} %"
        true = _triple({key: report["permitted_force_N"] + value for key, value in link["excess_N"].items()})
        right = f"{100.0 * link['named_right']:.0f} %, {100.0 * link['named_within_one']:.0f} %"
        rows.append([name, noticed, stops, moving, above, *missing, true, right])
    return table(header, rows)


def _triple(values: dict[str, float]) -> str:
    return " / ".join(f"> {_UNSEEN:.0f}" if value > _UNSEEN else str(round(value)) for value in values.values())


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--arm", metavar="ARM", help="a name, or the path of a URDF or YAML file (default: iiwa14)")
    parser.add_argument("--postures", type=int, help="random postures (default: 1500)")
    parser.add_argument("--points", type=int, help="contacts on each capsule in each posture (default: 8)")
    parser.add_argument("--speed", type=float, help="of moving joints, as a share of their limits (default: 0.25)")
    parser.add_argument("--seed", type=int, help="of postures and contacts (default: 0)")
    bench_blindness(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
