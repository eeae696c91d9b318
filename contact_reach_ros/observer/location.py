"""Which link is touched, and how hard: the point force that explains the external torque best."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import Array
from contact_reach_ros.arm.model import RobotModel

_POINTS = 5
"""Candidates along the axis of each capsule."""
_FORCE = 100.0
"""Expected size of a force across a link, N, with which its square is weighted in the fit."""
_FORCE_ALONG = 5.0
"""The same along the link, where contact acts only by friction."""
_ACROSS = np.eye(3) / _FORCE**2
_ALONG = 1.0 / _FORCE_ALONG**2 - 1.0 / _FORCE**2
_ALIKE = 0.1
"""Squared misfits that differ by less fit alike: as by an error of a third of a threshold on one joint."""
_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]
"""Coordinates in a cross product; NumPy's own function takes ten times as long."""


@dataclass(frozen=True, eq=False)
class Contact:
    """Where the arm is touched.

    Attributes
    ----------
    link
        Name of the link.
    position
        Point on the axis of the link's capsule that the force acts through, (3,), m, base frame.
    force
        Force on the arm, (3,), N, base axes: the one that explains the torques best.
    torque
        Sudden external torque (n,), N m, that the force is fitted to.
    is_excessive
        Whether even `least` has exceeded the permitted force for too long.
    least
        Smallest of the forces that explain the torques best at each point, where they do so about as well, N: where
        levers are short, errors of torques are large forces. See `locate`; messages do not carry it.
    """

    link: str
    position: Array
    force: Array
    torque: Array
    is_excessive: bool = False
    least: float = math.nan

    def rounded(self) -> Contact:
        """The same contact to 1 mm, 0.1 N and 0.01 N m, as messages carry it."""
        position, force, torque = np.round(self.position, 3), np.round(self.force, 1), np.round(self.torque, 2)
        return dataclasses.replace(self, position=position, force=force, torque=torque)

    @property
    def strength(self) -> float:
        """Magnitude of the force, N."""
        return float(np.linalg.norm(self.force))


class ContactLocator:
    """Fits τ_ext ≈ J_p(q)ᵀ f over points p on the axes of the arm's collision capsules.

    A force normal to a capsule passes through its axis, so points off the axis are not needed. Joints beyond the
    touched link feel nothing, which distinguishes the links.

    Attributes
    ----------
    weights
        (n,) factors that make torques comparable, 1/(N m).
    """

    def __init__(self, model: RobotModel, scales: tuple[float, ...]) -> None:
        """`scales`: torques (n,), N m, that count as equally large on their joints, such as thresholds."""
        arm = model.arm
        self._link_names = arm.link_names
        self._model = model.pinocchio
        self._data = self._model.createData()
        self.weights = 1.0 / np.array(scales)
        self._joints = [self._model.getJointId(name) for name in arm.joint_names]
        shares = np.linspace(0.0, 1.0, _POINTS)[:, None]
        capsules = [(c.link - 1, np.array(c.start, float), np.array(c.end, float)) for c in arm.capsules]
        self._links = np.repeat([link for link, _, _ in capsules], _POINTS)
        self._points = np.concatenate([start + shares * (end - start) for _, start, end in capsules])[:, :, None]
        axes = [(end - start) / np.linalg.norm(end - start) for _, start, end in capsules]
        self._axes = np.repeat(axes, _POINTS, axis=0)[:, :, None]

    def locate(self, q: Array, torque: Array, *others: Array) -> Contact:
        """The contact that best explains the external torque (n,) N m at joint positions (n,) rad.

        `others` are what the torque may be as well, (n,) N m: `Contact.least` is the smallest force for any of them.
        """
        rotations, origins = self.frames(q)
        turns = rotations[self._links]
        points = origins[self._links] + (turns @ self._points)[:, :, 0]
        axes = turns @ self._axes
        rows = self.rows(rotations, origins, points, self._links)
        targets = (self.weights * np.array([torque, *others])).T
        prior = _ACROSS + _ALONG * (axes @ axes.transpose(0, 2, 1))
        columns = rows.transpose(0, 2, 1)
        right = columns @ targets
        forces = np.linalg.solve(columns @ rows + prior, right)
        # At the minimum |target - rows f|² + fᵀ prior f is |target|² - fᵀ right.
        gains = (forces * right).sum(axis=1)
        best = int(np.argmax(gains[:, 0]))
        strengths = np.linalg.norm(forces, axis=1)
        # Of a torque that is not finite, nothing fits.
        least = float(strengths[gains >= gains.max(axis=0) - _ALIKE].min(initial=strengths[best, 0]))
        return Contact(self._link_names[self._links[best]], points[best], forces[best, :, 0], torque, least=least)

    def frames(self, q: Array) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) and origins (n, 3), m, of the joints' frames."""
        pin.forwardKinematics(self._model, self._data, q)
        frames = [self._data.oMi[joint] for joint in self._joints]
        return np.array([frame.rotation for frame in frames]), np.array([frame.translation for frame in frames])

    def rows(self, rotations: Array, origins: Array, points: Array, links: Array) -> Array:
        """Weighted J_pᵀ (P, n, 3) of points (P, 3), m: joint axis × lever, zero for the joints beyond the link."""
        levers = points[:, None, :] - origins
        turning = rotations[:, :, 2]
        rows = turning[:, _NEXT] * levers[:, :, _AFTER] - turning[:, _AFTER] * levers[:, :, _NEXT]
        return rows * ((np.arange(len(origins)) <= links[:, None]) * self.weights)[:, :, None]
