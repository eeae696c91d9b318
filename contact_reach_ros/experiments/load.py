"""What `experiments/load_publisher.py` publishes, and how many of its messages a bag lacks."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from contact_reach_ros.bags.reader import BagReader

NAMESPACE = "/bench"
LOADED = ("joint_states", "effort_controller/commands", "external_torque", "external_wrench", "sim/contacts")
"""Topics of the load, below `NAMESPACE`."""


def count_lost(bag: Path, ticks: int) -> int:
    """How many messages are missing where each topic had `ticks`; one that came twice makes up for none.

    Raises
    ------
    BagError
        If the bag cannot be read.
    """
    reader = BagReader(bag)
    arrived: defaultdict[str, set[int]] = defaultdict(set)
    for raw in reader.raw_messages([f"{NAMESPACE}/{name}" for name in LOADED]):
        arrived[raw.topic].add(raw.sequence)
    return ticks * len(LOADED) - sum(map(len, arrived.values()))
