"""A plan as visualization markers, for RViz and the viewer."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Vector3
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.nodes.messages import set_time, to_point, to_quaternion
from contact_reach_ros.planning.problem import Plan
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.scenes.overlap import capsule_segments

Array = NDArray[np.float64]

FLANGE = "flange"
ELBOW = "elbow"
ARM = "arm"
CONTACT = "contact"

_ELBOW_LINK = 4
_SHOWN_FORCE = 0.05
"""Least force that is worth a text, N."""
_TEXT_HEIGHT = 0.04
_PATH_WIDTH = 0.006
_BLUE = (0.2, 0.4, 0.9, 0.9)
_ORANGE = (0.9, 0.55, 0.1, 0.9)
_GHOST = 0.25


class PlanMarkers:
    """Markers of one plan after the other; what the next one no longer shows is deleted."""

    def __init__(self, permitted_force: float) -> None:
        """`permitted_force`: what colours a contact red, N."""
        self._permitted_force = permitted_force
        self._shown: set[tuple[str, int]] = set()

    def show(self, plan: Plan) -> MarkerArray:
        """Paths of flange and elbow, the arm at the end of the plan, and each link's largest contact force.

        A text stands where the link is expected to be at the end of the knot with that force. The direction of a force
        is not known from a plan.
        """
        elbow = np.array([link_frames(q)[1][_ELBOW_LINK - 1] for q in plan.predicted_q])
        markers = [_path(FLANGE, plan.predicted_positions, _BLUE), _path(ELBOW, elbow, _ORANGE)]
        forces = plan.predicted_contact_forces.max(axis=0)
        shares = np.clip(forces / self._permitted_force, 0.0, 1.0)
        starts, ends = capsule_segments(plan.predicted_q[-1])
        for index, capsule in enumerate(iiwa14.CAPSULES):
            color = (0.5 + 0.5 * shares[index], 0.5 - 0.4 * shares[index], 0.5 - 0.4 * shares[index], _GHOST)
            markers.append(_cylinder(capsule.link, starts[index], ends[index], capsule.radius, color))
            if forces[index] >= _SHOWN_FORCE:
                knot = int(plan.predicted_contact_forces[:, index].argmax())
                middle = np.mean(capsule_segments(plan.predicted_q[knot + 1]), axis=0)[index]
                markers.append(_text(capsule.link, middle, f"{forces[index]:.1f} N", shares[index]))
        shown = {(marker.ns, marker.id) for marker in markers}
        for namespace, identifier in sorted(self._shown - shown):
            markers.append(Marker(ns=namespace, id=identifier, action=Marker.DELETE))
        self._shown = shown
        for marker in markers:
            marker.header.frame_id = iiwa14.BASE_NAME
            set_time(marker.header.stamp, plan.effect_ns)
        return MarkerArray(markers=markers)

    def clear(self) -> MarkerArray:
        """Deletes all that is shown."""
        self._shown = set()
        marker = Marker(action=Marker.DELETEALL)
        marker.header.frame_id = iiwa14.BASE_NAME
        return MarkerArray(markers=[marker])


def _path(namespace: str, points: Array, color: tuple[float, ...]) -> Marker:
    marker = _marker(namespace, 0, Marker.LINE_STRIP, (_PATH_WIDTH, 0.0, 0.0), color)
    marker.points = [to_point(point) for point in points.tolist()]
    return marker


def _cylinder(link: int, start: Array, end: Array, radius: float, color: tuple[float, ...]) -> Marker:
    axis = end - start
    length = float(np.linalg.norm(axis))
    marker = _marker(ARM, link, Marker.CYLINDER, (2.0 * radius, 2.0 * radius, length), color)
    marker.pose.position = to_point((0.5 * (start + end)).tolist())
    marker.pose.orientation = to_quaternion(_frame_along(axis / length))
    return marker


def _text(link: int, position: Array, text: str, share: float) -> Marker:
    marker = _marker(CONTACT, link, Marker.TEXT_VIEW_FACING, (0.0, 0.0, _TEXT_HEIGHT), (1.0, 1.0 - share, 0.0, 1.0))
    marker.pose.position = to_point(position.tolist())
    marker.text = text
    return marker


def _marker(namespace: str, identifier: int, kind: int, scale: tuple[float, ...], color: tuple[float, ...]) -> Marker:
    red, green, blue, opacity = (float(value) for value in color)
    marker = Marker(
        ns=namespace,
        id=identifier,
        type=kind,
        scale=Vector3(x=scale[0], y=scale[1], z=scale[2]),
        color=ColorRGBA(r=red, g=green, b=blue, a=opacity),
    )
    marker.pose.orientation.w = 1.0
    return marker


def _frame_along(axis: Array) -> Array:
    """A rotation (3, 3) whose z is the unit vector `axis`."""
    aside = np.eye(3)[np.abs(axis).argmin()]
    x = np.cross(aside, axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
