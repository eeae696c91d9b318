"""Computation divided among CPU cores, each of which is a device of JAX."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_VECTOR = 8
"""Numbers in a vector register of common CPUs."""

_AXIS = "cores"
_T = TypeVar("_T")


def whole_vectors(count: int, cores: int = 1) -> int:
    """The least number of lanes, not below `count`, that gives each core whole vector registers.

    So no lane is left over for slower instructions, however many cores share the work.
    """
    return -(-count // (_VECTOR * cores)) * _VECTOR * cores


def on_each(function: Callable[..., Any], cores: int) -> Callable[..., Any]:
    """A function that every core computes, all with the same arguments and results; see `in_shares`."""
    if cores == 1:
        return function
    everything = PartitionSpec()
    return jax.shard_map(function, mesh=_mesh(cores), in_specs=everything, out_specs=everything, check_vma=False)


def for_each(values: _T, cores: int) -> _T:
    """The values, copied to every core at once instead of in each call of a program."""
    if cores == 1:
        return values
    if all(isinstance(leaf, jax.Array) and len(leaf.devices()) == cores for leaf in jax.tree.leaves(values)):
        return values
    # Arrays of NumPy go to all cores in one call; those of a core would go one after the other.
    copied: _T = _copy(cores)(jax.tree.map(np.asarray, values))
    return copied


@functools.cache
def _copy(cores: int) -> Callable[[Any], Any]:
    return jax.jit(lambda values: values, out_shardings=NamedSharding(_mesh(cores), PartitionSpec()))


def in_shares(function: Callable[[jax.Array], jax.Array], columns: jax.Array, cores: int) -> jax.Array:
    """Results (B,) for columns (N, B), of which every core computes a share; within a function of `on_each`."""
    if cores == 1:
        return function(columns)
    count = columns.shape[1]
    lanes = whole_vectors(count, cores)
    padded = jnp.pad(columns, ((0, 0), (0, lanes - count)))
    first = jax.lax.axis_index(_AXIS) * (lanes // cores)
    own = jax.lax.dynamic_slice_in_dim(padded, first, lanes // cores, axis=1)
    return jax.lax.all_gather(function(own), _AXIS, tiled=True)[:count]


def _mesh(cores: int) -> Mesh:
    return Mesh(np.array(jax.devices()[:cores]), (_AXIS,))
