"""Bytes that are no messages."""

from collections.abc import Iterator

import numpy as np

_HEADER = b"\0\1\0\0"


def garbage(message: bytes) -> Iterator[bytes]:
    """Nothing, a serialised message cut off at many places, and random bytes with and without a message's header."""
    yield b""
    yield _HEADER + b"\xff\xff\xff\x7f"
    for end in range(1, len(message) - 8, max(1, len(message) // 40)):
        yield message[:end]
    random = np.random.default_rng(0)
    for size in range(1, 200, 7):
        yield random.bytes(size)
        yield _HEADER + random.bytes(size)
