"""Plans that no planner made."""

from typing import Any

import numpy as np

from contact_reach_ros.planning.plan import Plan


def make_plan(positions: np.ndarray, rotations: np.ndarray, postures: np.ndarray, **others: Any) -> Plan:
    """A plan with these references, (H, 3), (H, 3, 3) and (H, 7); what it does not tell is zero."""
    knots = len(positions)
    nothing = {
        "number": 1,
        "effect_ns": 0,
        "knot_duration_s": 0.1,
        "predicted_q": np.zeros((knots + 1, 7)),
        "predicted_positions": np.zeros((knots + 1, 3)),
        "predicted_contact_forces": np.zeros((knots, 6)),
        "cost": 0.0,
        "cost_terms": {},
        "steps": 1,
        "stop_reason": "stagnated",
        "solve_s": 0.0,
    }
    return Plan(positions=positions, rotations=rotations, postures=postures, **{**nothing, **others})
