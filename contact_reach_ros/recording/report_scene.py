"""The three-dimensional view of a report: the flange's path, the arm along it, obstacles and contacts."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.observer.location import ContactLocator
from contact_reach_ros.palette import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILION
from contact_reach_ros.recording.bag_reader import BagReader, RawMessage
from contact_reach_ros.recording.columns import read_raw
from contact_reach_ros.recording.report_bag import ReportBag
from contact_reach_ros.recording.report_charts import Chart, packed
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.robot.model import RobotModel

Array = NDArray[np.float64]

_ARMS = 14
_PATH_POINTS = 1500
_CONTACTS = 150
_TOUCH = 0.5
"""Contact force that counts as a touch, N."""
_SPACING = 0.05
"""Between contacts that are shown, s."""
_KEEP_NS = 250_000_000
"""Between obstacle messages that are kept."""
_SPHERE_LIST, _SPHERE = 7, 2
_CONTACT_LEVEL = 1


class _Seen(NamedTuple):
    """Obstacle spheres at one time: (K, 3) m and (K,) m."""

    log_ns: int
    centres: Array
    radii: Array


def scene_chart(bag: ReportBag) -> Chart:
    """The view; plotly's own controls turn it."""
    positions = bag.signals.position
    inside = (positions.time >= bag.zero) & (positions.time <= bag.end) & np.isfinite(positions.values).all(axis=1)
    rows = np.flatnonzero(inside)
    layout: dict[str, Any] = {
        "scene": {
            "aspectmode": "data",
            "xaxis": {"title": {"text": "x [m]"}},
            "yaxis": {"title": {"text": "y [m]"}},
            "zaxis": {"title": {"text": "z [m]"}},
            "camera": {"eye": {"x": 1.4, "y": -1.4, "z": 0.8}},
        }
    }
    if not len(rows):
        return {"data": [], "layout": layout, "missing": "no joint states in this bag"}
    obstacles = _Obstacles(bag.reader)
    data = [_sweep(bag, rows), _path(bag, rows)]
    if bag.signals.goals:
        data.append(_points(np.array([goal.position for goal in bag.signals.goals]), "goal", GREEN, "diamond", 6))
    data += obstacles.traces()
    touches, forces = _true_contacts(bag, obstacles)
    if len(touches):
        words = [f"{force:.1f} N" for force in forces]
        data.append(_points(touches, "contact (simulation)", VERMILION, "circle", 5, words))
    located, words = _located_contacts(bag)
    if len(located):
        data.append(_points(located, "contact (observer)", ORANGE, "x", 4, words))
    return {"data": data, "layout": layout, "tall": True}


def _sweep(bag: ReportBag, rows: NDArray[np.intp]) -> dict[str, Any]:
    """The arm at moments between start and end, from light to dark."""
    chosen = rows[np.linspace(0, len(rows) - 1, min(_ARMS, len(rows))).astype(int)]
    lines, times = [], []
    for row in chosen:
        origins = np.array([np.zeros(3), *link_frames(bag.signals.position.values[row])[1], np.full(3, np.nan)])
        lines.append(origins)
        times += [bag.signals.position.time[row] - bag.zero] * len(origins)
    points = np.concatenate(lines)
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": "arm",
        "x": packed(points[:, 0]),
        "y": packed(points[:, 1]),
        "z": packed(points[:, 2]),
        "line": {
            "width": 6,
            "color": times,
            "colorscale": [[0.0, "#cfe3f1"], [1.0, BLUE]],
            "showscale": False,
        },
        "connectgaps": False,
        "showlegend": False,
        "hovertemplate": "arm at %{line.color:.2f} s<extra></extra>",
    }


def _path(bag: ReportBag, rows: NDArray[np.intp]) -> dict[str, Any]:
    chosen = rows[np.linspace(0, len(rows) - 1, min(_PATH_POINTS, len(rows))).astype(int)]
    points = np.array([link_frames(q)[1][-1] for q in bag.signals.position.values[chosen]])
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": "path of the flange",
        "x": packed(points[:, 0]),
        "y": packed(points[:, 1]),
        "z": packed(points[:, 2]),
        "line": {"color": BLACK, "width": 4},
        "hovertemplate": "flange at [%{x:.3f}, %{y:.3f}, %{z:.3f}] m<extra></extra>",
    }


def _points(
    points: Array, name: str, colour: str, symbol: str, size: float, words: list[str] | None = None
) -> dict[str, Any]:
    return {
        "type": "scatter3d",
        "mode": "markers",
        "name": name,
        "x": packed(points[:, 0]),
        "y": packed(points[:, 1]),
        "z": packed(points[:, 2]),
        "marker": {"color": colour, "size": size, "symbol": symbol},
        "text": words or [name] * len(points),
        "hovertemplate": "%{text} at [%{x:.3f}, %{y:.3f}, %{z:.3f}] m<extra></extra>",
    }


class _Obstacles:
    """Obstacle spheres of a bag, some of the messages."""

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._kept: list[RawMessage] = []
        read_raw(reader, {"/obstacles": self._keep})
        self._decoded: dict[int, _Seen] = {}

    def at(self, log_ns: int) -> _Seen | None:
        """What was seen about that time of reception; None if nothing was."""
        if not self._kept:
            return None
        times = np.array([raw.log_time_ns for raw in self._kept])
        index = int(np.argmin(np.abs(times - log_ns)))
        if index not in self._decoded:
            self._decoded[index] = self._decode(self._kept[index])
        return self._decoded[index]

    def traces(self) -> list[dict[str, Any]]:
        """The spheres at the beginning and at the end."""
        if not self._kept:
            return []
        first, last = self.at(self._kept[0].log_time_ns), self.at(self._kept[-1].log_time_ns)
        traces = []
        for seen, name, opacity in ((first, "obstacles at first", 0.15), (last, "obstacles at last", 0.5)):
            if seen is not None and len(seen.radii):
                traces.append(_balls(seen, name, opacity))
        return traces

    def _keep(self, raw: RawMessage) -> None:
        if not self._kept or raw.log_time_ns - self._kept[-1].log_time_ns >= _KEEP_NS:
            self._kept.append(raw)

    def _decode(self, raw: RawMessage) -> _Seen:
        message = self._reader.decode(raw)
        centres: list[tuple[float, float, float]] = []
        radii: list[float] = []
        for marker in [] if message is None else message.markers:
            if marker.ns == "rest" or marker.type not in (_SPHERE, _SPHERE_LIST):
                continue
            points = [marker.pose.position] if marker.type == _SPHERE else marker.points
            centres += [(point.x, point.y, point.z) for point in points]
            radii += [0.5 * marker.scale.x] * len(points)
        return _Seen(raw.log_time_ns, np.reshape(centres, (-1, 3)), np.array(radii))


def _balls(seen: _Seen, name: str, opacity: float) -> dict[str, Any]:
    """All spheres as one mesh; the more there are the coarser."""
    turns, rings = (16, 9) if len(seen.radii) < 20 else (6, 4)
    angle = np.linspace(0.0, 2 * np.pi, turns, endpoint=False)
    height = np.linspace(0.0, np.pi, rings)
    unit = np.array([(np.sin(h) * np.cos(a), np.sin(h) * np.sin(a), np.cos(h)) for h in height for a in angle])
    corners = []
    for ring in range(rings - 1):
        for turn in range(turns):
            a, b = ring * turns + turn, ring * turns + (turn + 1) % turns
            corners += [(a, b, a + turns), (b, b + turns, a + turns)]
    faces = np.array(corners)
    points = (seen.centres[:, None] + seen.radii[:, None, None] * unit).reshape(-1, 3)
    triangles = (faces + len(unit) * np.arange(len(seen.radii))[:, None, None]).reshape(-1, 3)
    x, y, z = (packed(points[:, axis]) for axis in range(3))
    i, j, k = (triangles[:, corner].tolist() for corner in range(3))
    mesh = {"x": x, "y": y, "z": z, "i": i, "j": j, "k": k}
    look = {"color": GREEN if opacity > 0.2 else GREY, "opacity": opacity, "hoverinfo": "name", "showlegend": True}
    return {"type": "mesh3d", "name": name, **mesh, **look}


def _true_contacts(bag: ReportBag, obstacles: _Obstacles) -> tuple[Array, Array]:
    """Where links touch obstacles, by what the simulation knows: points (n, 3) m on the links, and forces (n,) N."""
    force = bag.signals.contact_force
    largest = force.column("max")
    bodies = [name for name in force.names if name in iiwa14.LINK_NAMES]
    points, forces = [], []
    for row in _spread(force.time, largest >= _TOUCH, bag):
        values = np.array([force.column(name)[row] for name in bodies])
        seen = obstacles.at(_reception(bag, float(force.time[row])))
        if seen is None or not len(seen.radii) or not np.isfinite(values).any():
            continue
        link = iiwa14.LINK_NAMES.index(bodies[int(np.nanargmax(values))]) + 1
        points.append(_nearest_point(_posture(bag, float(force.time[row])), link, seen))
        forces.append(float(np.nanmax(values)))
    return np.reshape(points, (-1, 3)), np.array(forces)


def _located_contacts(bag: ReportBag) -> tuple[Array, list[str]]:
    """Where the observer's method places the contacts that it told of."""
    torque = bag.signals.external_torque
    told = [event for event in bag.signals.safety if event.name == "observer"]
    touching = np.zeros(len(torque.time), bool)
    for event, after in zip(told, [*told[1:], None], strict=True):
        if event.level == _CONTACT_LEVEL:
            until = torque.time[-1] if after is None else after.time
            touching |= (torque.time >= event.time) & (torque.time <= until)
    rows = _spread(torque.time, touching, bag)
    if not len(rows):
        return np.zeros((0, 3)), []
    locator = ContactLocator(RobotModel(), bag.budget.contact_thresholds)
    contacts = [locator.locate(_posture(bag, float(torque.time[row])), torque.values[row]) for row in rows]
    return (
        np.array([contact.position for contact in contacts]),
        [f"{contact.link}, about {contact.strength:.0f} N" for contact in contacts],
    )


def _spread(time: Array, chosen: NDArray[np.bool_], bag: ReportBag) -> list[int]:
    """Rows among those chosen, apart from each other, and not too many."""
    rows = np.flatnonzero(chosen & (time <= bag.end))
    kept: list[int] = []
    for row in rows:
        if not kept or time[row] - time[kept[-1]] >= _SPACING:
            kept.append(int(row))
    return kept[:: max(1, -(-len(kept) // _CONTACTS))]


def _posture(bag: ReportBag, time: float) -> Array:
    positions = bag.signals.position
    row = min(int(np.searchsorted(positions.time, time)), len(positions.time) - 1)
    return np.nan_to_num(positions.values[row])


def _reception(bag: ReportBag, time: float) -> int:
    """When the joint state of that time was sent, ns."""
    row = min(int(np.searchsorted(bag.signals.position.time, time)), len(bag.signals.state_sent_ns) - 1)
    return int(bag.signals.state_sent_ns[row])


def _nearest_point(q: Array, link: int, seen: _Seen) -> Array:
    """The point of a link's surface that is nearest to an obstacle, (3,), m."""
    capsule = next((capsule for capsule in iiwa14.CAPSULES if capsule.link == link), iiwa14.CAPSULES[-1])
    rotations, origins = link_frames(q)
    rotation, origin = rotations[capsule.link - 1], origins[capsule.link - 1]
    start = origin + rotation @ np.array(capsule.start, float)
    axis = rotation @ np.subtract(capsule.end, capsule.start)
    share = np.clip((seen.centres - start) @ axis / (axis @ axis), 0.0, 1.0)
    on_axis = start + share[:, None] * axis
    gaps = np.linalg.norm(seen.centres - on_axis, axis=1) - seen.radii
    nearest = int(np.argmin(gaps))
    way = seen.centres[nearest] - on_axis[nearest]
    return on_axis[nearest] + capsule.radius * way / max(float(np.linalg.norm(way)), 1e-9)
