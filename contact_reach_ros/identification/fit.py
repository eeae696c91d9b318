"""Least squares of tool, links, friction and offsets, with intervals that know that neighbouring samples err alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy import stats

from contact_reach_ros.arm import Arm, Array, tensor_matrix
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.errors import InputError
from contact_reach_ros.identification.recording import Samples

CONFIDENCE = 0.95
"""Of the intervals."""

_ROUNDS = 6
"""Of linearising and weighting; both have settled by then."""
_LEAST_EFFECT = 0.01
"""A combination of parameters, each by its scale, that changes the torques by less is not identifiable, Nm rms."""
_SHARE = 0.2
"""Of a parameter that lies in such combinations, from which on it is not identifiable itself."""
_BLOCK_S = 50
"""Samples whose errors may be alike: those of a second."""
_LEAST_NOISE = 1e-4
"""Of a joint's torque, Nm: its rows do not weigh more."""
_TOOL_SCALES = {"tool mass": 1.0, "tool moment x": 0.1, "tool moment y": 0.1, "tool moment z": 0.1}
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
        joints = [name.rpartition("_")[2] for name in arm.joint_names]
        if tool is not None:
            rows = [("tool", name, scale) for name, scale in _TOOL_SCALES.items()]
        else:
            shifts = [(axis, joint) for axis in "xy" for joint in joints]
            rows = [(f"shift_{axis}", f"center {axis} of the link at {joint}", _SHIFT_SCALE) for axis, joint in shifts]
        rows += [(kind, f"{kind} {joint}", 1.0) for kind in ("coulomb", "viscous", "offset") for joint in joints]
        kinds, self.names, scales = zip(*rows, strict=True)
        self.scales = np.array(scales)
        self.slots = {kind: slice(kinds.index(kind), kinds.index(kind) + kinds.count(kind)) for kind in kinds}

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


@dataclass(frozen=True, eq=False)
class Fit:
    """Values of the parameters.

    Attributes
    ----------
    parameters
        What they are.
    values
        (p,), zero where they are not identifiable.
    covariance
        (p, p) of the values.
    freedom
        Number of independent samples beyond the number of parameters, for intervals.
    known
        (p,) whether they are identifiable from the motion.
    unknown
        Combinations of parameters that are not, in words.
    """

    parameters: Parameters
    values: Array
    covariance: Array
    freedom: float
    known: np.ndarray
    unknown: tuple[str, ...]

    @property
    def half_widths(self) -> Array:
        """Half of the confidence interval of each value, (p,); NaN where it is not identifiable."""
        factor = stats.t.ppf(0.5 + 0.5 * CONFIDENCE, max(self.freedom, 1.0))
        return np.where(self.known, factor * np.sqrt(np.diag(self.covariance)), np.nan)

    def of(self, kind: str) -> tuple[Array, Array, np.ndarray]:
        """Values, half widths and whether they are known, of one kind of parameters."""
        slots = self.parameters.slots[kind]
        return self.values[slots], self.half_widths[slots], self.known[slots]


def fit(parameters: Parameters, motion: Samples) -> Fit:
    """Fit the parameters to a motion, without the rows of joints that hardly move: what friction does there is unknown.

    Raises `InputError` if no joint moves, or nothing is identifiable.
    """
    regressor, moves, blocks = parameters.regressor(motion), motion.moves, _blocks(motion)
    if not moves.any():
        raise InputError("no joint moves fast enough for its friction: expected a motion of all joints")
    count, n = moves.shape
    values, noise = np.zeros(len(parameters.names)), np.ones(n)
    for _ in range(_ROUNDS):
        errors, columns = parameters.rows(motion, *regressor, values)
        errors, columns = errors * moves, columns * moves[:, :, None]
        scaled = columns * parameters.scales
        basis, unknown = _split(scaled.reshape(count * n, -1), count)
        weighted = (scaled @ basis) / noise[:, None]
        targets = errors / noise
        # Steps along the combinations that are known; along the others the values stay zero.
        flat = weighted.reshape(count * n, -1)
        inverse = np.linalg.inv(flat.T @ flat)
        step = basis @ (inverse @ (flat.T @ targets.ravel()))
        values = values + parameters.scales * step
        remaining = errors - columns @ (parameters.scales * step)
        rms = np.sqrt((remaining**2).sum(axis=0) / np.maximum(moves.sum(axis=0), 1))
        noise = np.maximum(rms, _LEAST_NOISE)
    scores = np.einsum("cni,cn->ci", weighted, remaining / noise)
    inner, freedom = _covariance(inverse, scores, blocks)
    scaled_basis = parameters.scales[:, None] * basis
    lies = np.linalg.norm(unknown, axis=1) if unknown.shape[1] else np.zeros(len(values))
    known = lies < _SHARE
    return Fit(
        parameters,
        np.where(known, values, 0.0),
        scaled_basis @ inner @ scaled_basis.T,
        freedom,
        known,
        tuple(_in_words(direction, parameters.names) for direction in unknown.T),
    )


def _blocks(motion: Samples) -> np.ndarray:
    """Number (N,) of the block of each sample."""
    found, start = [], 0
    for length in np.unique(motion.piece, return_counts=True)[1].tolist():
        found.append(start + np.arange(length) // _BLOCK_S)
        start = int(found[-1][-1]) + 1
    return np.concatenate(found)


def _split(scaled: Array, count: int) -> tuple[Array, Array]:
    """Combinations of the scaled parameters with an effect on the torques, and those without.

    Both are orthonormal, (p, k) and (p, p - k).
    """
    squares, directions = np.linalg.eigh(scaled.T @ scaled)
    effects = np.sqrt(np.maximum(squares, 0.0) / count)
    has_effect = effects >= _LEAST_EFFECT
    return directions[:, has_effect], directions[:, ~has_effect]


def _covariance(bread: Array, scores: Array, blocks: np.ndarray) -> tuple[Array, float]:
    """Covariance of the least-squares values whose scores (N, k) are correlated within blocks, and its freedom.

    The sandwich of block sums, which also knows noise that depends on the motion; with few blocks it is too small by
    the share of the freedom that the fit has used up. `bread` is the inverse (k, k) of the squared columns.
    """
    count = int(blocks[-1]) + 1
    sums = np.zeros((count, scores.shape[1]))
    np.add.at(sums, blocks, scores)
    freedom = count - scores.shape[1]
    if freedom < 2:
        raise InputError(f"the motion lasts {count} s, too short for {scores.shape[1]} parameters: record a longer one")
    return bread @ (sums.T @ sums) @ bread * count / freedom, float(freedom)


def _in_words(direction: Array, names: Sequence[str]) -> str:
    """The parameters that a combination consists of, the largest share first."""
    order = np.argsort(-np.abs(direction))
    return ", ".join(names[index] for index in order if abs(direction[index]) > _SHARE)
