"""The package's array type, and conversion of values into read-only arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import InputError

Array = NDArray[np.float64]
"""Double precision; docstrings give shape, unit and frame."""


def checked_array(name: str, values: object, shape: tuple[int, ...]) -> Array:
    """Return a read-only copy of `values` with the expected shape.

    Raises `InputError` if the shape differs or a value is not finite; the message starts with `name`.
    """
    array = np.array(values, dtype=float)
    if array.shape != shape:
        raise InputError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite values, got {array.ravel().tolist()}")
    array.setflags(write=False)
    return array
