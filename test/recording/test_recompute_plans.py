"""Bags whose plans cannot be made again."""

from types import SimpleNamespace

import numpy as np
import pytest

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording import recompute_plans
from contact_reach_ros.recording.recompute_plans import RecordedPlans


def test_a_bag_of_an_earlier_version_is_refused_and_says_what_to_do(monkeypatch):
    """Without `approach` its planner's weight of contact is unknown: plans would differ without a reason to be seen."""
    solutions = {1: {"plan": np.ones(1), "best": np.zeros(39)}}
    monkeypatch.setattr(recompute_plans, "_read_plans", lambda _: ({1: {"plan": "1"}}, {1: 0}, solutions))
    bag = SimpleNamespace(summary=SimpleNamespace(path="old_bag"))
    inputs = SimpleNamespace(bag=bag, intakes={"planner": []}, settings={"planner": {}})
    with pytest.raises(BagError, match=r"old_bag.*earlier version.*use that version"):
        RecordedPlans(inputs)
