"""Whether a goal is taken."""

from __future__ import annotations

from collections.abc import Mapping

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.goal_state import describe
from contact_reach_ros.planning.goal_progress import GoalState
from contact_reach_ros.ros.stopping import Outcome

_FOLLOWED = "plans accepted"
_REFUSED = (f"refused {topics.REFERENCE_POSE.contents}", "refused plans")


def judge_goal(state: GoalState | None, before: Mapping[str, str], now: Mapping[str, str]) -> Outcome | None:
    """Judge whether a goal is taken, by its state and the controller's diagnostics from before it was sent and after.

    None while that is open.
    """
    if state is None:
        return None
    if state.phase.is_over:
        return Outcome(False, f"the planner did not take the goal: {describe(state)}")

    def more(*keys: str) -> bool:
        return any(int(now.get(key, 0)) > int(before.get(key, 0)) for key in keys)

    if more(_FOLLOWED):
        return Outcome(True, "the goal is taken: the controller follows the plans for it")
    if more(*_REFUSED):
        reasons = [text for key, text in now.items() if key.replace("last refusal of", "refused") in _REFUSED]
        return Outcome(False, f"the controller refuses the plans for the goal: {'; '.join(reasons)}")
    return None
