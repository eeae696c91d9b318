"""Least squares of the torques, with intervals that know that neighbouring samples err alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import InputError
from contact_reach_ros.identification.parameters import Parameters
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


def fit(parameters: Parameters, motions: Sequence[Samples]) -> Fit:
    """Fit the parameters to motions; rows of joints that hardly move are left out: what friction does there is unknown.

    Raises `InputError` if no joint moves, or nothing is identifiable.
    """
    regressors = [parameters.regressor(motion) for motion in motions]
    moves = np.concatenate([motion.moves for motion in motions])
    blocks = _blocks(motions)
    if not moves.any():
        raise InputError("no joint moves fast enough for its friction: expected a motion of all joints")
    count, n = moves.shape
    values, noise = np.zeros(len(parameters.names)), np.ones(n)
    for _ in range(_ROUNDS):
        pairs = [
            parameters.rows(motion, *regressor, values) for motion, regressor in zip(motions, regressors, strict=True)
        ]
        errors, columns = (np.concatenate(each) for each in zip(*pairs, strict=True))
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


def _blocks(motions: Sequence[Samples]) -> np.ndarray:
    """Number (N,) of the block of each sample."""
    found, start = [], 0
    for motion in motions:
        for piece in np.unique(motion.piece):
            length = int((motion.piece == piece).sum())
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
