"""Your own cost term: the tip approaches its goal from above.

A term is a function that names the setting for its weight. The weight is no part of the compiled program, so both runs
below share one, which takes up to a minute to compile the first time.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import contact_reach_ros as cr
from contact_reach_ros.planning.terms import Context, term
from contact_reach_ros.settings import setting


@term("from_above_weight")
def from_above(context: Context) -> jax.Array:
    """Distance of the tip below a cone that stands on the goal with its tip, m, (H, B)."""
    offset = context.position[:, 1:] - context.goal_position
    return jnp.maximum(jnp.sqrt(offset[0] ** 2 + offset[1] ** 2 + 1e-8) - offset[2], 0.0)


@dataclass(frozen=True)
class Settings(cr.PlanningSettings):
    """Settings of the planner with the weight of the new term, whose name is that of the function."""

    from_above_weight: float = setting(0.0, "tip below a cone on the goal", unit="1/m", minimum=0.0, maximum=10.0)


target = np.array([0.5, 0.3, 0.3])
for weight in (0.0, 1.0):
    scene = cr.load_scene("ball", arm=cr.load_arm("iiwa14"), seed=0, target=target)
    stack = cr.Stack(scene, planning=Settings(from_above_weight=weight))
    path: list[np.ndarray] = []
    result = stack.run(cr.Goal(scene.target), watch=lambda _, stack=stack, path=path: path.append(stack.tip_position))
    highest = max(position[2] for position in path) - target[2]
    outcome = f"reached after {result.duration:.2f} s" if result.reached else result.stop_reason or "not reached"
    print(f"weight {weight:g}: {outcome}, at most {1000 * highest:.0f} mm above the goal")
