"""Pinocchio model of the arm: everything that controller and observer need from it, computed once per tick."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm.arm import Arm, Array, Inertia
from contact_reach_ros.arm.kinematics import tensor_matrix
from contact_reach_ros.arm.mjcf import build_mjcf

_WORLD_ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class RobotModel:
    """Kinematics and dynamics of the arm at one state.

    `update` sets the attributes below; they are valid until the next call. The task frame is the flange; velocities
    and wrenches are (linear, angular), expressed in the axes of the base frame, at the flange.

    Attributes
    ----------
    mass_matrix
        M(q), (n, n), kg m², armature included.
    bias
        C(q, q̇) + g(q), (n,), N m.
    gravity
        g(q), (n,), N m.
    position, rotation
        Flange pose in the base frame, (3,) m and (3, 3).
    jacobian
        J(q), (6, n).
    twist
        ẋ = J q̇, (6,), m/s and rad/s.
    drift
        J̇ q̇, (6,), m/s² and rad/s².
    """

    mass_matrix: Array
    bias: Array
    gravity: Array
    position: Array
    rotation: Array
    jacobian: Array
    twist: Array
    drift: Array

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "arm.xml"
            file.write_text(build_mjcf(arm), "utf-8")
            self.pinocchio: pin.Model = pin.buildModelFromMJCF(str(file))
        # Pinocchio reads no gravity in MJCF.
        self.pinocchio.gravity.linear = np.array(arm.gravity)
        self.data: pin.Data = self.pinocchio.createData()
        self.tip: int = self.pinocchio.getFrameId(arm.tip_frame, pin.FrameType.BODY)
        self._no_acceleration = np.zeros(arm.n)
        # Views of Pinocchio's own memory, which stays where it is.
        self.mass_matrix, self.bias, self.gravity = self.data.M, self.data.nle, self.data.g
        self.update(np.zeros(arm.n), np.zeros(arm.n))

    def update(self, q: Array, v: Array) -> None:
        """Compute all attributes for joint positions (n,) in rad and velocities (n,) in rad/s."""
        model, data, flange = self.pinocchio, self.data, self.tip
        pin.computeAllTerms(model, data, q, v)
        self.jacobian = pin.getFrameJacobian(model, data, flange, _WORLD_ALIGNED)
        pin.forwardKinematics(model, data, q, v, self._no_acceleration)
        pose = pin.updateFramePlacement(model, data, flange)
        self.position = pose.translation
        self.rotation = pose.rotation
        self.drift = pin.getFrameClassicalAcceleration(model, data, flange, _WORLD_ALIGNED).vector
        self.twist = self.jacobian.dot(v)

    def update_dynamics(self, q: Array) -> None:
        """Compute `mass_matrix` and `gravity` only; the other attributes stay those of the last `update`."""
        pin.crba(self.pinocchio, self.data, q)
        pin.computeGeneralizedGravity(self.pinocchio, self.data, q)

    def coriolis_matrix(self, q: Array, v: Array) -> Array:
        """C(q, q̇), (n, n), with Ṁ = C + Cᵀ."""
        return pin.computeCoriolisMatrix(self.pinocchio, self.data, q, v)

    def jacobian_at(self, q: Array) -> Array:
        """J(q), (6, n)."""
        return pin.computeFrameJacobian(self.pinocchio, self.data, q, self.tip, _WORLD_ALIGNED)

    def gravity_at(self, q: Array) -> Array:
        """g(q), (n,), N m; does not change the attributes."""
        return pin.computeGeneralizedGravity(self.pinocchio, self.pinocchio.createData(), q)

    def tip_pose(self, q: Array) -> tuple[Array, Array]:
        """Flange position (3,) m and rotation (3, 3) in the base frame; does not change the attributes."""
        data = self.pinocchio.createData()
        pin.forwardKinematics(self.pinocchio, data, q)
        pose = pin.updateFramePlacement(self.pinocchio, data, self.tip)
        return pose.translation, pose.rotation


def spatial_inertia(inertia: Inertia) -> pin.Inertia:
    """An inertia for Pinocchio, whose constructor refuses what no body has."""
    made = pin.Inertia.Zero()
    made.mass, made.lever = inertia.mass, np.array(inertia.center, float)
    made.inertia = np.asfortranarray(tensor_matrix(inertia.tensor))
    return made
