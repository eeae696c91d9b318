"""Arithmetic on arrays whose last axis is the candidates, in short chains that compile well."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

_PI_HIGH = 3.140625
"""π as the sum of two numbers, of which multiples of the first are exact."""
_PI_LOW = np.pi - _PI_HIGH

_COSINE = [(-1) ** n / math.factorial(2 * n) for n in reversed(range(7))]
_SINE = [(-1) ** n / math.factorial(2 * n + 1) for n in reversed(range(7))]
"""Coefficients of the squares of an angle, the highest first; enough for π/2."""


def single(values: ArrayLike) -> jax.Array:
    """Values in single precision, as an argument of compiled programs.

    They stay in numpy, which the programs take directly: turning each into a JAX array costs more than many programs.
    """
    return cast(jax.Array, np.asarray(values, dtype=np.float32))


@jax.custom_jvp
def cosine_and_sine(angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Cosine and sine of an angle, rad, to 2e-7 up to 100 rad.

    A function of the C library would be called for each number. This is the series about the nearest multiple of π,
    with the same factor for both.
    """
    turns = jnp.round(angle * (1.0 / np.pi))
    rest = angle - turns * _PI_HIGH - turns * _PI_LOW
    sign = 1.0 - 2.0 * (turns - 2.0 * jnp.floor(0.5 * turns))
    square = rest * rest
    return sign * _series(_COSINE, square), sign * rest * _series(_SINE, square)


def _series(terms: Sequence[float], x: jax.Array) -> jax.Array:
    """The polynomial of x with these coefficients, the highest first."""
    total = terms[0] * x + terms[1]
    for term in terms[2:]:
        total = total * x + term
    return total


@cosine_and_sine.defjvp
def _turned(primals: tuple, tangents: tuple) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    cosine, sine = cosine_and_sine(*primals)
    return (cosine, sine), (-sine * tangents[0], cosine * tangents[0])


def cross(a: Sequence[jax.Array] | jax.Array, b: Sequence[jax.Array] | jax.Array) -> jax.Array:
    """Cross product of (3, ...) arrays along the first axis."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def dot(a: Sequence[jax.Array] | jax.Array, b: Sequence[jax.Array] | jax.Array) -> jax.Array:
    """Scalar product of (3, ...) arrays along the first axis."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def combine(vectors: Sequence[jax.Array], weights: Sequence[np.ndarray] | np.ndarray) -> jax.Array:
    """Σ weights[k] * vectors[k] with constant weights, of which zeros and ones cost nothing."""
    total = jnp.zeros_like(vectors[0])
    for vector, weight in zip(vectors, weights, strict=True):
        if np.any(weight):
            total = total + (vector if np.all(weight == 1.0) else vector * weight)
    return total


def per_link(values: np.ndarray) -> list[np.ndarray]:
    """Constants (L, 3) as three weights (L, 1) for `combine` with vectors (3, L, B)."""
    return [values[:, axis, None] for axis in range(3)]


def pick(array: jax.Array, rows: np.ndarray) -> jax.Array:
    """Rows (C, R, B) of an array (C, L, B), by their constant indices (R,)."""
    if _are_neighbours(rows):
        return array[:, rows[0] : rows[-1] + 1]
    return jnp.concatenate([array[:, row : row + 1] for row in rows], axis=1)


def collect(array: jax.Array, rows: np.ndarray, count: int) -> jax.Array:
    """Sums (C, `count`, B) of an array (C, R, B) over its rows, grouped by the constant indices `rows` (R,)."""
    nothing = jnp.zeros_like(array[:, :1])
    if _are_neighbours(rows):
        before, behind = [nothing] * int(rows[0]), [nothing] * (count - 1 - int(rows[-1]))
        return jnp.concatenate([*before, array, *behind], axis=1) if before or behind else array
    sums = []
    for row in range(count):
        parts = [array[:, index : index + 1] for index in np.flatnonzero(rows == row)]
        sums.append(sum(parts[1:], start=parts[0]) if parts else nothing)
    return jnp.concatenate(sums, axis=1)


def _are_neighbours(rows: np.ndarray) -> bool:
    """Whether the rows follow one another, so that one slice holds them."""
    return bool((np.diff(rows) == 1).all())


def sum_over(array: jax.Array, axis: int) -> jax.Array:
    """Sum over a short axis as a chain of additions, which fuses where a reduction would not."""
    slices = [jax.lax.index_in_dim(array, index, axis, keepdims=False) for index in range(array.shape[axis])]
    total = slices[0]
    for part in slices[1:]:
        total = total + part
    return total


def suffix_sum(array: jax.Array) -> jax.Array:
    """Sums (C, L, B) -> (C, L, B) over the links from each one to the last."""
    return prefix_sum(array[:, ::-1])[:, ::-1]


def prefix_sum(array: jax.Array) -> jax.Array:
    """Sums (C, L, B) -> (C, L, B) over the links from the first to each one."""
    return jnp.stack(list(itertools.accumulate(array[:, link] for link in range(array.shape[1]))), axis=1)


def rotate(rotation_vector: jax.Array, columns: jax.Array) -> jax.Array:
    """exp(w) R for rotation vectors (3, B), rad, and rotation matrices (3, 3, B) indexed [row, column]."""
    square = dot(rotation_vector, rotation_vector) + 1e-12  # keeps the derivative at zero finite
    angle = jnp.sqrt(square)
    cosine, sine = cosine_and_sine(angle)
    sine, cosine = sine / angle, (1.0 - cosine) / square
    rotated = []
    for column in (columns[:, 0], columns[:, 1], columns[:, 2]):
        turned = cross(rotation_vector, column)
        rotated.append(column + sine * turned + cosine * cross(rotation_vector, turned))
    return jnp.stack(rotated, axis=1)
