"""Plans that no planner made, and a core that makes some without compiling anything."""

from typing import Any

import numpy as np
from arm_simulation import ARM

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.plan import Plan, Request


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


class StayingCore:
    """Plans of one knot to stay where the arm is; keeps what it was asked, and counts its resets."""

    memory = None

    def __init__(self, failing_after: int | None = None, error: type[PlanningError] = PlanningError) -> None:
        self.asked: list[Request] = []
        self.failing_after, self.error = failing_after, error
        self.resets = 0
        self.model = RobotModel(ARM)

    def warm_up(self, progress) -> None:
        pass

    def reset(self) -> None:
        self.resets += 1

    def reseed(self, seed: int) -> None:
        pass

    def plan(self, request: Request) -> Plan:
        if len(self.asked) == self.failing_after:
            raise self.error("there is no way to the goal")
        self.asked.append(request)
        q = request.q
        position, rotation = self.model.tip_pose(q)
        return make_plan(position[None], rotation[None], q[None], effect_ns=request.effect_ns, knot_duration_s=0.2)
