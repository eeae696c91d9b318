"""What nodes report of their settings, read from any object with the fields of the message."""

from __future__ import annotations

import json
from typing import Any


def read_settings(status: Any) -> dict[str, Any]:
    """The values of a message on topic `settings`; one that is no JSON stays text."""
    values: dict[str, Any] = {}
    for entry in status.values:
        try:
            values[entry.key] = json.loads(entry.value)
        except ValueError:
            values[entry.key] = entry.value
    return values
