"""The arm in the scene: its links as simple bodies, each in the colour of its joint's external torque."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import viser
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm import Arm, Array, Capsule, link_frames
from contact_reach_ros.palette import ORANGE, VERMILION, as_bytes

_BODY, _COVER, _DARK = "#DBDEE0", "#F2731A", "#383B40"
_COVER_RADIUS = 0.62
"""Radius of a joint's cover, in radii of the link."""
_PLATE = 0.03
"""Thickness of the plate below the base, m."""
_AROUND = 36
"""Number of corners of a circle."""
_SHARES = (0.0, 0.5, 1.0)
_RAMP = np.array([as_bytes(_BODY), as_bytes(ORANGE), as_bytes(VERMILION)])


class ArmView:
    """The arm. The base has the colour of the first joint where the first link has no body of its own."""

    def __init__(self, server: viser.ViserServer, arm: Arm) -> None:
        self._arm = arm
        self._scene = server.scene
        self._frames = [server.scene.add_frame(f"/arm/{link}", show_axes=False) for link in range(arm.n + 1)]
        self._tinted: list[list[Any]] = [[] for _ in arm.joints]
        base = [self._add_fixed(number, capsule) for number, capsule in enumerate(arm.base_capsules)]
        thickness = max((capsule.radius for capsule in arm.base_capsules[-1:]), default=0.0)
        for number, capsule in enumerate(arm.capsules):
            start, end = np.array(capsule.start, float), np.array(capsule.end, float)
            colour = _DARK if capsule.link == arm.n else _BODY
            body = self._add(capsule.link, f"body{number}", _capsule(start, end, capsule.radius), colour)
            is_first = not self._tinted[capsule.link - 1]
            self._tinted[capsule.link - 1].append(body)
            # A joint whose axis, z, runs along its link only twists the arm; one that bends it has a cover.
            if is_first and abs(end - start)[2] < 0.5 * np.linalg.norm(end - start):
                half = np.array([0.0, 0.0, 1.04 * max(thickness, capsule.radius)])
                self._add(capsule.link, "cover", _cylinder(-half, half, _COVER_RADIUS * capsule.radius), _COVER)
            thickness = capsule.radius
        if not self._tinted[0]:
            self._tinted[0] = base[-1:]

    def move(self, q: Array) -> None:
        """Show the links at joint angles `q` (n,), rad."""
        for frame, rotation, origin in zip(self._frames[1:], *link_frames(self._arm, q), strict=False):
            frame.wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
            frame.position = origin

    def colour(self, shares: Array) -> None:
        """Colour the links by shares (n,) of the torque that stops the arm."""
        for share, handles in zip(shares.tolist(), self._tinted, strict=True):
            for handle in handles:
                handle.color = share_colour(share)

    def _add_fixed(self, number: int, capsule: Capsule) -> Any:
        """Add a capsule that does not move; on a plate without its lower end if that reaches through the ground."""
        start, end = np.array(capsule.start, float), np.array(capsule.end, float)
        if not np.array_equal(start[:2], end[:2]) or not 0.0 <= min(start[2], end[2]) <= capsule.radius:
            return self._add(0, f"fixed{number}", _capsule(start, end, capsule.radius), _BODY)
        ground, top = np.array([*start[:2], 0.0]), np.array([*start[:2], max(start[2], end[2])])
        plate = ground + np.array([0.0, 0.0, _PLATE])
        self._add(0, f"plate{number}", _cylinder(ground, plate, 1.15 * capsule.radius), _DARK)
        self._add(0, f"top{number}", _ball(top, capsule.radius), _BODY)
        return self._add(0, f"fixed{number}", _cylinder(ground, top, capsule.radius), _BODY)

    def _add(self, link: int, name: str, mesh: trimesh.Trimesh, colour: str) -> Any:
        return self._scene.add_mesh_simple(f"/arm/{link}/{name}", mesh.vertices, mesh.faces, color=as_bytes(colour))


def share_colour(share: float) -> tuple[int, int, int]:
    """Colour from the arm's own at 0 to vermilion at 1 and beyond."""
    red, green, blue = (round(float(np.interp(share, _SHARES, channel))) for channel in _RAMP.T)
    return red, green, blue


def share_gradient() -> str:
    """The colours of `share_colour` as a CSS gradient from left to right."""
    stops = ", ".join(f"rgb{share_colour(share)} {share:.0%}" for share in _SHARES)
    return f"linear-gradient(to right, {stops})"


def _ball(center: Array, radius: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.apply_translation(center)
    return mesh


def _cylinder(start: Array, end: Array, radius: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.cylinder(radius, segment=np.stack([start, end]), sections=_AROUND)
    # Split at its edges; otherwise viser would shade the flat ends and the side as one round surface.
    return mesh.smooth_shaded


def _capsule(start: Array, end: Array, radius: float) -> trimesh.Trimesh:
    place = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end - start)
    place[:3, 3] = 0.5 * (start + end)
    length = float(np.linalg.norm(end - start))
    return trimesh.creation.capsule(length, radius, count=[_AROUND, _AROUND // 2], transform=place)
