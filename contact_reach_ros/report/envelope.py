"""Thinning out curves for a picture so that no peak is lost."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arrays import Array

BINS = 1500
"""Stretches that a long curve is cut into; a screen has about as many columns."""


def samples_per_bin(count: int) -> int:
    """How many samples of a curve share a bin: 1 for a curve that is drawn as it is."""
    return 1 if count <= 2 * BINS else -(-count // BINS)


def envelope(time: Array, values: Array) -> tuple[Array, Array]:
    """The least and the greatest value of each bin, where they occurred and in their order.

    Parameters
    ----------
    time
        (n,).
    values
        (n,); NaN where there is none.

    Returns
    -------
    time, values
        At most two per bin; the curve as it is when it is short. A bin without any value is a gap.
    """
    size = samples_per_bin(len(time))
    if size == 1:
        return time, values
    bins = -(-len(time) // size)
    padded = np.full(bins * size, np.nan)
    padded[: len(values)] = values
    rows = padded.reshape(bins, size)
    empty = np.isnan(rows).all(axis=1)
    least = np.argmin(np.where(np.isnan(rows), np.inf, rows), axis=1)
    greatest = np.argmax(np.where(np.isnan(rows), -np.inf, rows), axis=1)
    least[empty] = greatest[empty] = 0
    picked = np.sort(np.stack([least, greatest], axis=1), axis=1)
    # Where both are the same sample it is drawn twice, which nobody sees.
    index = np.minimum(picked + size * np.arange(bins)[:, None], len(time) - 1).ravel()
    thinned = values[index]
    thinned[np.repeat(empty, 2)] = np.nan
    return time[index], thinned
