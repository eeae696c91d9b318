"""Contacts of the arm, as arrows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import viser

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.palette import ORANGE, PURPLE, VERMILION, as_bytes
from contact_reach_ros.viewer.frame import Frame
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.spheres import Spheres

_LEAST = 0.2
"""Least force that gets an arrow, N."""
_NEWTON = 0.02
"""Length of an arrow per newton, m."""
_ABOVE = np.array([0.0, 0.0, 0.06])
"""Offset of the labels of estimates, which may be at the same place as true forces, m."""


class Arrow(NamedTuple):
    """A force on the arm.

    Attributes
    ----------
    point
        (3,) point of application, m.
    force
        (3,), N.
    estimated
        Whether the observer estimated the force from torques; otherwise the simulation measured it.
    """

    point: Array
    force: Array
    estimated: bool


class ContactView:
    """Arrows of forces, with their magnitudes as labels."""

    def __init__(self, server: viser.ViserServer, arm: Arm, permitted_force: float) -> None:
        self._server = server
        self._arm = arm
        self._permitted = permitted_force
        self._handle: Any = None
        self._labels: list[Any] = []

    def show(self, frame: Frame) -> None:
        """Show the contacts of a moment."""
        found = arrows(self._arm, frame)
        # From outside the arm to the point of application.
        tips = np.array([arrow.point for arrow in found]).reshape(-1, 3)
        tails = tips - _NEWTON * np.array([arrow.force for arrow in found]).reshape(-1, 3)
        self._show_labels(found, tails)
        if self._handle is not None:
            self._handle.visible = bool(found)
        if not found:
            return
        points = np.stack([tails, tips], axis=1).astype(np.float32)
        colours = np.array([self._colour(arrow) for arrow in found], np.uint8)
        if self._handle is None or len(self._handle.points) != len(points):
            self._handle = self._server.scene.add_arrows(
                "/contacts", points, colours, shaft_radius=0.006, head_radius=0.015, head_length=0.03
            )
        else:
            self._handle.points = points
            self._handle.colors = colours

    def _colour(self, arrow: Arrow) -> tuple[int, int, int]:
        if arrow.estimated:
            return as_bytes(PURPLE)
        return as_bytes(VERMILION if np.linalg.norm(arrow.force) > self._permitted else ORANGE)

    def _show_labels(self, found: Sequence[Arrow], tails: Array) -> None:
        while len(self._labels) < len(found):
            self._labels.append(self._server.scene.add_label(f"/labels/{len(self._labels)}", ""))
        for number, label in enumerate(self._labels):
            label.visible = number < len(found)
        for label, arrow, tail in zip(self._labels, found, tails, strict=False):
            label.position = tail + _ABOVE if arrow.estimated else tail
            label.text = f"{np.linalg.norm(arrow.force):.1f} N{' (estimated)' if arrow.estimated else ''}"


def arrows(arm: Arm, frame: Frame) -> list[Arrow]:
    """The contacts of a moment.

    The simulation publishes the magnitude of the force on each link: it is drawn where the link is nearest to an
    obstacle, along their common normal. The observer estimates magnitude, direction and place.
    """
    found = []
    obstacles = frame.obstacles
    if obstacles is not None and len(obstacles):
        for name, size in frame.forces.items():
            if name in arm.contact_links and size >= _LEAST:
                point, normal = _touched(arm, name, frame.q, obstacles)
                found.append(Arrow(point, size * normal, False))
    for status in frame.safety.values():
        contact = status.contact
        if contact is not None and np.linalg.norm(contact.force) >= _LEAST:
            found.append(Arrow(contact.position, contact.force, True))
    return found


def _touched(arm: Arm, link: str, q: Array, spheres: Spheres) -> tuple[Array, Array]:
    """Point of a link's surface nearest to, or deepest in, a sphere, and the unit normal there, pointing inwards."""
    of_link = np.array([arm.link_names[capsule.link - 1] == link for capsule in arm.capsules])
    radii = np.array([capsule.radius for capsule in arm.capsules])[of_link]
    starts, ends = (points[of_link, None] for points in capsule_segments(arm, q))
    axes = ends - starts
    along = np.clip(np.sum((spheres.center - starts) * axes, axis=-1) / np.sum(axes * axes, axis=-1), 0.0, 1.0)
    towards = starts + along[..., None] * axes - spheres.center
    lengths = np.linalg.norm(towards, axis=-1)
    gaps = lengths - spheres.radius - radii[:, None]
    capsule, sphere = np.unravel_index(np.argmin(gaps), gaps.shape)
    normal = towards[capsule, sphere] / max(lengths[capsule, sphere], 1e-9)
    return spheres.center[sphere] + towards[capsule, sphere] - radii[capsule] * normal, normal
