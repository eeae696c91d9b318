"""Your own solver: plain MPPI (model predictive path integral) in place of Algorithm 1.

A solver minimises a cost over the box [-1, 1]ⁿ, from a start that the planner chooses.
"""

import math

import jax
import jax.numpy as jnp

import contact_reach_ros as cr
from contact_reach_ros.planning.solver.solver import Solution


class Mppi:
    """Moves the mean to the average of random points, each weighted by exp(-cost / temperature)."""

    def __init__(self, cost, spread, settings: cr.PlanningSettings, temperature: float = 0.01) -> None:
        def step(problem, mean, key):
            normal = jax.random.normal(key, (len(spread), settings.population)).at[:, 0].set(0.0)
            points = jnp.clip(mean[:, None] + spread[:, None] * normal, -1.0, 1.0)
            costs = jnp.nan_to_num(cost(problem, points), nan=jnp.inf)
            return points @ jax.nn.softmax(-costs / temperature), points[:, costs.argmin()], costs.min()

        self._step, self._seed, self.max_steps = jax.jit(step), 0, settings.max_steps

    def reseed(self, seed: int) -> None:
        self._seed = seed

    def solve(self, problem, start, start_cost: float, number: int, until: float = math.inf) -> Solution:
        mean = best = jnp.asarray(start, jnp.float32)
        key, costs = jax.random.fold_in(jax.random.key(self._seed), number), [start_cost]
        for step in range(self.max_steps):
            mean, point, cost = self._step(problem, mean, jax.random.fold_in(key, step))
            best = point if cost < costs[-1] else best
            costs.append(min(costs[-1], float(cost)))
        return Solution(jax.device_get(best), costs[-1], self.max_steps, "max_steps", tuple(costs))


scene = cr.load_scene("ball", arm=cr.load_arm("iiwa14"), seed=0)
planner = cr.make_planner(scene.arm, 1, planning=cr.PlanningSettings(max_steps=10), solver=Mppi)
result = cr.Stack(scene, planner=planner).run(cr.Goal(scene.target))
print(f"reached: {result.reached}, {result.duration:.2f} s, {result.plans} plans, {result.max_contact_force:.1f} N")
