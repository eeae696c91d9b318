"""Joints of messages by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import InputError


class JointOrder:
    """Picks the arm's joints out of messages whose order may be any, and may change."""

    def __init__(self, names: Sequence[str]) -> None:
        """`names`: the wanted joints in the wanted order."""
        self._names = list(names)
        self._seen: list[str] | None = None
        self._indices: list[int] | None = None

    def indices(self, names: list[str], topic: str) -> list[int] | None:
        """Where the wanted joints stand among `names`; None if they stand there in order.

        Raises `InputError` if joints are missing; topic, field and the missing names are given.
        """
        if names != self._seen:
            missing = [name for name in self._names if name not in names]
            if missing:
                raise InputError(
                    f"{topic}: field name lacks {', '.join(missing)}; expected all of {', '.join(self._names)}"
                )
            self._indices = None if names == self._names else [names.index(name) for name in self._names]
            self._seen = list(names)
        return self._indices

    def pick(self, message: Any, field: str, topic: str) -> Array:
        """One field of a JointState, (n,), in the wanted order.

        Raises `InputError` if joints are missing or the field has not one value for each name.
        """
        indices = self.indices(message.name, topic)
        values = np.array(getattr(message, field), dtype=float)
        if len(values) != len(message.name):
            raise InputError(
                f"{topic}: {field} has {len(values)} values; expected one for each of {len(message.name)} names"
            )
        return values if indices is None else values[indices]
