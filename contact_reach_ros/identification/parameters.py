"""What is identified: a rigid tool, shifts of the links' centres of mass, joint friction and torque offsets."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import Arm, Array, tensor_matrix
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.identification.recording import Samples

_TOOL_NAMES = ("tool mass", "tool moment x", "tool moment y", "tool moment z")
_TOOL_SCALES = (1.0, 0.1, 0.1, 0.1)
"""kg and kg m: what it would be worth knowing."""
_SHIFT_SCALE = 0.05
"""m."""
_DIFFERENCE = 1e-3
"""Step of central differences, m: exact, since inertias are quadratic in the centre."""


class Parameters:
    """The vector of parameters, and the torques that follow from it.

    Attributes
    ----------
    slots
        Where each kind stands in the vector: 'tool' (mass, kg, and first moment in the frame of the last link, kg m),
        'shift_x' and 'shift_y' (n,) m, 'coulomb' (n,) Nm, 'viscous' (n,) Nm s/rad and 'offset' (n,) Nm.
    names, scales
        Of all parameters.
    """

    def __init__(self, arm: Arm, tool: Tool | None, gravity: bool = True, rotors: bool = True) -> None:
        """Choose the parameters.

        Parameters
        ----------
        arm
            As its data have it, with the tool that is not to be identified.
        tool
            The tool whose mass and centre are to be identified; its own inertia is taken as it is. None identifies the
            shifts of the links' centres of mass instead.
        gravity
            Whether the torques carry the arm's weight.
        rotors
            Whether they accelerate the rotors, too.
        """
        self.arm = arm
        self._model: pin.Model = RobotModel(arm).pinocchio
        if not gravity:
            self._model.gravity = pin.Motion.Zero()
        self._armature = self._model.armature.copy() if rotors else np.zeros(arm.n)
        self._inertias = [self._model.inertias[link + 1] for link in range(arm.n)]
        self._tensor = np.zeros((3, 3)) if tool is None else tensor_matrix(tool.inertia)
        kinds: dict[str, tuple[tuple[str, ...], tuple[float, ...]]] = {}
        joints = [name.rpartition("_")[2] for name in arm.joint_names]
        if tool is not None:
            kinds["tool"] = (_TOOL_NAMES, _TOOL_SCALES)
        else:
            for axis in "xy":
                names = tuple(f"center {axis} of the link at {joint}" for joint in joints)
                kinds[f"shift_{axis}"] = (names, (_SHIFT_SCALE,) * arm.n)
        for kind in ("coulomb", "viscous", "offset"):
            kinds[kind] = (tuple(f"{kind} {joint}" for joint in joints), (1.0,) * arm.n)
        self.slots: dict[str, slice] = {}
        start = 0
        for kind, (names, _) in kinds.items():
            self.slots[kind] = slice(start, start + len(names))
            start += len(names)
        self.names = sum((names for names, _ in kinds.values()), ())
        self.scales = np.array(sum((scales for _, scales in kinds.values()), ()))

    def regressor(self, samples: Samples) -> tuple[Array, Array]:
        """Pinocchio's regressor (N, n, 10 n), and the torques (N, n) that accelerate the rotors, N m."""
        data, count = self._model.createData(), len(samples.q)
        found = np.empty((count, self.arm.n, 10 * self.arm.n))
        for row, q, v, a in zip(found, samples.q, samples.v, samples.a, strict=True):
            row[:] = pin.computeJointTorqueRegressor(self._model, data, q, v, a)
        return found, self._armature * samples.a

    def rows(self, samples: Samples, regressor: Array, rotors: Array, values: Array) -> tuple[Array, Array]:
        """Torques that the parameters do not explain, and how the explained ones change with them.

        Parameters
        ----------
        samples
            A motion.
        regressor, rotors
            What `regressor` returns for it, which does not change with the parameters.
        values
            (p,) of all parameters.

        Returns
        -------
        tuple
            (N, n) N m, and (N, n, p).
        """
        n, (inertial, slopes) = self.arm.n, self._inertial(values)
        columns = np.zeros((*samples.q.shape, len(self.names)))
        columns[:, :, : slopes.shape[1]] = regressor @ slopes
        joints = np.arange(n)
        for kind, signal in (("coulomb", samples.direction), ("viscous", samples.v), ("offset", 1.0)):
            columns[:, joints, self.slots[kind].start + joints] = signal
        friction = slice(self.slots["coulomb"].start, None)
        explained = regressor @ inertial + rotors + columns[:, :, friction] @ values[friction]
        return samples.torque - explained, columns

    def _inertial(self, values: Array) -> tuple[Array, Array]:
        """Pinocchio's parameters (10 n,) of all links, and how they change with the first of `values`, (10 n, p')."""
        first = self.slots["coulomb"].start
        inertias, slopes = list(self._inertias), np.zeros((10 * self.arm.n, first))
        if "shift_x" in self.slots:
            x, y = (values[self.slots[kind]] for kind in ("shift_x", "shift_y"))
            for link, inertia in enumerate(inertias):
                here = np.array([x[link], y[link], 0.0])
                for axis, kind in enumerate(("shift_x", "shift_y")):
                    step = _DIFFERENCE * np.eye(3)[axis]
                    ends = (_shifted(inertia, here + sign * step).toDynamicParameters() for sign in (1.0, -1.0))
                    slope = np.subtract(*ends) / (2.0 * _DIFFERENCE)
                    slopes[10 * link : 10 * link + 10, self.slots[kind].start + link] = slope
                inertias[link] = _shifted(inertia, here)
        found = np.concatenate([inertia.toDynamicParameters() for inertia in inertias])
        if "tool" in self.slots:
            last = slice(10 * (self.arm.n - 1), None)
            mass, *moment = values[self.slots["tool"]]
            found[last] += _body(mass, np.array(moment), self._tensor)
            slopes[10 * (self.arm.n - 1) : 10 * (self.arm.n - 1) + 4, self.slots["tool"]] = np.eye(4)
        return found, slopes


def _shifted(inertia: pin.Inertia, shift: Array) -> pin.Inertia:
    return pin.Inertia(inertia.mass, inertia.lever + shift, inertia.inertia)


def _body(mass: float, moment: Array, tensor: Array) -> Array:
    """Pinocchio's parameters (10,) of a mass, kg, with a first moment (3,), kg m, and its own inertia (3, 3), kg m²."""
    if mass <= 0.0:
        # Weight that is missing: that of the links is then too large, wherever it is.
        return np.concatenate([[mass], moment, np.zeros(6)])
    return pin.Inertia(mass, moment / mass, tensor).toDynamicParameters()
