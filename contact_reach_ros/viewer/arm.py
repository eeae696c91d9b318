"""The arm in the scene: its links as simple bodies, each in the colour of its joint's external torque."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import viser

from contact_reach_ros.arm import Arm, Array, Capsule, link_frames, quaternion_from_rotation
from contact_reach_ros.palette import ORANGE, VERMILION, as_bytes

_BODY, _COVER, _DARK = "#DBDEE0", "#F2731A", "#383B40"
_COVER_RADIUS = 0.62
"""Radius of a joint's cover, in radii of the link."""
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
        base = [self._add(f"/arm/0/fixed{number}", capsule, _BODY) for number, capsule in enumerate(arm.base_capsules)]
        thickness = max((capsule.radius for capsule in arm.base_capsules[-1:]), default=0.0)
        for number, capsule in enumerate(arm.capsules):
            colour, axis = _DARK if capsule.link == arm.n else _BODY, np.subtract(capsule.end, capsule.start)
            body = self._add(f"/arm/{capsule.link}/body{number}", capsule, colour)
            is_first = not self._tinted[capsule.link - 1]
            self._tinted[capsule.link - 1].append(body)
            # A joint whose axis, z, runs along its link only twists the arm; one that bends it has a cover.
            if is_first and abs(axis[2]) < 0.5 * np.linalg.norm(axis):
                radius, height = _COVER_RADIUS * capsule.radius, 2.08 * max(thickness, capsule.radius)
                self._scene.add_cylinder(f"/arm/{capsule.link}/cover", radius, height, as_bytes(_COVER))
            thickness = capsule.radius
        if not self._tinted[0]:
            self._tinted[0] = base[-1:]

    def move(self, q: Array) -> None:
        """Show the links at joint angles `q` (n,), rad."""
        for frame, rotation, origin in zip(self._frames[1:], *link_frames(self._arm, q), strict=False):
            frame.wxyz = quaternion_from_rotation(rotation)
            frame.position = origin

    def colour(self, shares: Array) -> None:
        """Colour the links by shares (n,) of the torque that stops the arm."""
        for share, handles in zip(shares.tolist(), self._tinted, strict=True):
            for handle in handles:
                handle.color = share_colour(share)

    def _add(self, name: str, capsule: Capsule, colour: str) -> Any:
        axis = np.subtract(capsule.end, capsule.start)
        place = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], axis)
        place[:3, 3] = 0.5 * np.add(capsule.start, capsule.end)
        count = [_AROUND, _AROUND // 2]
        mesh = trimesh.creation.capsule(float(np.linalg.norm(axis)), capsule.radius, count=count, transform=place)
        return self._scene.add_mesh_simple(name, mesh.vertices, mesh.faces, color=as_bytes(colour))


def share_colour(share: float) -> tuple[int, int, int]:
    """Colour from the arm's own at 0 to vermilion at 1 and beyond."""
    red, green, blue = (round(float(np.interp(share, _SHARES, channel))) for channel in _RAMP.T)
    return red, green, blue


def share_gradient() -> str:
    """The colours of `share_colour` as a CSS gradient from left to right."""
    stops = ", ".join(f"rgb{share_colour(share)} {share:.0%}" for share in _SHARES)
    return f"linear-gradient(to right, {stops})"
