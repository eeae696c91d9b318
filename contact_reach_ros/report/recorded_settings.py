"""Settings of the nodes as a bag records them."""

from __future__ import annotations

from typing import Any

from contact_reach_ros.bags.signals import EpisodeSignals
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Settings


def recorded_section(
    signals: EpisodeSignals, node: str, prefix: str, default: Settings, notes: list[str] | None = None
) -> Any:
    """The section `prefix` of a node's settings, of the kind of `default`, which stands in where the bag lacks it.

    Why it does is appended to `notes`.
    """
    notes = [] if notes is None else notes
    kind = type(default)
    recorded = signals.settings.get(node, {})
    values = {
        entry.name: recorded[f"{prefix}.{entry.name}"]
        for entry in kind.declared()
        if f"{prefix}.{entry.name}" in recorded
    }
    if not values:
        notes.append(f"the bag lacks the {prefix} of the {node}: that of the package is assumed")
        return default
    try:
        return kind.from_mapping(values, f"settings of the {node}")
    except SettingsError as error:
        notes.append(f"the {prefix} of the {node} cannot be used: {error}")
        return default
