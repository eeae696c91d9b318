"""The authors' planner as their code has it, as far as our law and limits let it: its cost, horizon, bounds and solver.

Theirs, too, are goals of a position only, a simulation that waits for each plan and runs the first 10 ms of it, and a
via point that is set by hand. Ours are the law (x_d is latched for these 10 ms, where their action is the error), its
gains, the bound of 0.2 rad on Δq and the limits on torque and speed. `benchmarks.factors` has their cost alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.authors_cost import AuthorsSettings
from benchmarks.factors import COSTS
from benchmarks.output import command_line, given, run_command, write_report
from contact_reach_ros.arm import Array
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.planner import ReplanningSettings
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PAPER, PlanningSettings, UnexpectedContactSettings
from contact_reach_ros.planning.solver.solver import CostFunction, FloatArray, Solution
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.goal import FREE, Goal
from contact_reach_ros.world.spheres import sphere_capacity

SIGMA = 0.2
"""σ₀ of every variable, m or rad: far beyond the bounds of Δx."""
_PAPER_SIGMA = 0.01
"""That of our setting `sampling: paper`, in whose spread the solver is told its variables' units."""
_STEP = 0.01
"""Of the authors' simulation, s: a knot, and the time between plans."""
_BOUND = 0.0075
"""γ of Δx, m."""
_VIA_TOLERANCE = 0.05
_TIMEOUT = 60.0
"""Simulated time for each goal, s."""
_REST = 1e-5
"""Spread of costs, in cm, and of variables, as a share of σ₀, at which a search ends."""

SETTINGS = AuthorsSettings(
    deadline=0.0,
    knot_duration=_STEP,
    substeps=2,
    translation_bound=_BOUND,
    sampling=PAPER,
    null_motion_weight=0.0,
    lead_change_weight=0.0,
    orientation_weight=0.0,
    detour_patience=0.0,
    **{**COSTS["paper_code"], "terminal_weight": 100.0, "contact_squared_weight": 1.6e-5},
)
"""The cost is in cm: their distance at the end has weight 1. That of contact is translated as in `benchmarks.factors`,
for a plan of 30 ms."""


class AuthorsCma:
    """CMA-ES after Hansen's tutorial with its default population, its weights, negative ones too, and its stops.

    Candidates are ranked as drawn, by the cost at the nearest point within the bounds plus a penalty of a like
    magnitude for the distance from there. A search begins at the last mean, with a fresh distribution.
    """

    def __init__(self, cost: CostFunction, spread: FloatArray, settings: PlanningSettings) -> None:
        n = len(spread)
        self.scale = SIGMA / _PAPER_SIGMA * np.array(spread, float)
        """(n,) standard deviations when a search begins, in units of the bounds."""
        self._cost = jax.jit(cost)
        self._seed, self._most = 0, settings.max_steps
        self.population = 4 + math.floor(3.0 * math.log(n))
        parents = self.population // 2
        raw = math.log((self.population + 1) / 2) - np.log(np.arange(1, self.population + 1))
        positive, negative = raw[:parents], raw[parents:]
        self._mu, low = positive.sum() ** 2 / (positive**2).sum(), negative.sum() ** 2 / (negative**2).sum()
        mu = self._mu
        self._c1 = 2.0 / ((n + 1.3) ** 2 + mu)
        self._cmu = min(1.0 - self._c1, 2.0 * (mu - 2.0 + 1.0 / mu) / ((n + 2.0) ** 2 + mu))
        scale = min(
            1.0 + self._c1 / self._cmu, 1.0 + 2.0 * low / (mu + 2.0), (1.0 - self._c1 - self._cmu) / (n * self._cmu)
        )
        self._weights = np.where(raw >= 0.0, raw / raw[raw > 0.0].sum(), scale * raw / -raw[raw < 0.0].sum())
        self._c_sigma = (mu + 2.0) / (n + mu + 5.0)
        self._d_sigma = 1.0 + 2.0 * max(0.0, math.sqrt((mu - 1.0) / (n + 1.0)) - 1.0) + self._c_sigma
        self._cc = (4.0 + mu / n) / (n + 4.0 + 2.0 * mu / n)
        self._length = math.sqrt(n) * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n))
        self._parents = parents

    def reseed(self, seed: int) -> None:
        """Draw other random numbers from now on."""
        self._seed = seed

    def solve(
        self, problem: Any, start: FloatArray, start_cost: float, number: int, until: float = math.inf
    ) -> Solution:
        """As `Solver.solve`, without a deadline."""
        mean, scale = np.array(start, float), self.scale
        n, random = len(mean), np.random.default_rng((self._seed, number))
        sigma, covariance = 1.0, np.eye(n)
        path_sigma, path, costs = np.zeros(n), np.zeros(n), [start_cost]
        spans: list[float] = []
        weights, best, reason = self._weights, np.clip(mean, -1.0, 1.0), "max_steps"
        for step in range(1, self._most + 1):
            values, axes = np.linalg.eigh(covariance)
            roots = np.sqrt(np.maximum(values, 1e-14))
            steps = (random.standard_normal((self.population, n)) * roots) @ axes.T
            points = mean + sigma * scale * steps
            inside = np.clip(points, -1.0, 1.0)
            found = np.asarray(self._cost(problem, inside.T.astype(np.float32)), float)
            ranked = np.where(np.isfinite(found), found, 1e6)
            # In m and rad.
            outside = np.linalg.norm((points - inside) * SIGMA / scale, axis=1)
            ranked = ranked + _like(ranked, outside) * outside
            order = np.argsort(ranked)
            steps, spans = steps[order], [*spans, float(np.ptp(ranked))]
            move = weights[: self._parents] @ steps[: self._parents]
            mean = mean + sigma * scale * move
            whitened = axes @ ((axes.T @ move) / roots)
            keep = 1.0 - self._c_sigma
            path_sigma = keep * path_sigma + math.sqrt(self._c_sigma * (2.0 - self._c_sigma) * self._mu) * whitened
            length = float(np.linalg.norm(path_sigma))
            sigma *= math.exp(min(self._c_sigma / self._d_sigma * (length / self._length - 1.0), 1.0))
            is_slow = length / math.sqrt(1.0 - keep ** (2 * (step + 1))) < (1.4 + 2.0 / (n + 1.0)) * self._length
            path = (1.0 - self._cc) * path + is_slow * math.sqrt(self._cc * (2.0 - self._cc) * self._mu) * move
            lengths = np.linalg.norm((steps @ axes) / roots, axis=1) ** 2
            signed = np.where(weights >= 0.0, weights, weights * n / (lengths + 1e-8))
            lost = (1 - is_slow) * self._cc * (2.0 - self._cc)
            kept = 1.0 + self._c1 * lost - self._c1 - self._cmu * weights.sum()
            covariance = kept * covariance + self._c1 * np.outer(path, path) + self._cmu * (steps.T * signed) @ steps
            if max(spans[-10:]) < _REST or (sigma * np.sqrt(np.diag(covariance)) < _REST).all():
                reason = "stagnated"
                break
        best = np.clip(mean, -1.0, 1.0)
        pair = np.stack([best, np.clip(start, -1.0, 1.0)], axis=1).astype(np.float32)
        last, first = np.asarray(self._cost(problem, pair), float)
        if not last <= first:
            best, last = pair[:, 1].astype(float), first
        return Solution(best, float(last), step, reason, (*costs, float(last)))


def _like(costs: Array, distances: Array) -> Array:
    """Powers of ten that bring distances to the magnitude of costs; 0 where there is no distance."""
    safe = np.where(distances > 0.0, distances, 1.0)
    return np.where(
        distances > 0.0, 10.0 ** (np.trunc(np.log10(np.maximum(costs, 1e-9))) - np.trunc(np.log10(safe))), 0.0
    )


def make_stack(scene: str, seed: int = 0) -> Stack:
    """The stack with the authors' planner in a scene."""
    made = load_scene(scene, seed=seed)
    controller = ControllerSettings(impedance=ImpedanceSettings(reference_ramp=0.0)).resolve(made.arm)
    budget = load_budget().resolve(made.arm)
    capacity = sphere_capacity(made)
    core = RecedingHorizonPlanner(made.arm, SETTINGS, controller, budget.permitted_force, capacity, AuthorsCma)
    return Stack(
        made,
        planner=core,
        controller=controller,
        budget=budget,
        replanning=ReplanningSettings(period=_STEP, latency=0.001),
        unexpected_contact=UnexpectedContactSettings(reaction="ignore"),
    )


def bench_paper_code(
    scene: str = "slalom", seed: int = 0, via: Sequence[float] | None = None, file: Path | None = None
) -> dict[str, Any]:
    """Run one episode, print what happened and write JSON to `file`.

    Parameters
    ----------
    scene, seed
        Name or YAML file of the scene, and its seed.
    via
        (3,), m: a first goal, which counts as reached at 5 cm; the authors' is (0.7, 0.15, 0.5) in the slalom.
    """
    stack = make_stack(scene, seed)
    runs: dict[str, Callable[[], Any]] = {}
    if via is not None:
        runs["via"] = lambda: stack.run(Goal(via, FREE, tolerance=_VIA_TOLERANCE), _TIMEOUT)
    runs["target"] = lambda: stack.run(stack.scene.goal, _TIMEOUT, until_settled=True)
    report: dict[str, Any] = {"scene": scene, "seed": seed}
    for name, run in runs.items():
        report[name] = run()._asdict()
        print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in report[name].items()), flush=True)
    write_report(report, file)
    return report


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scene", help="a name or a YAML file (default: slalom)")
    parser.add_argument("--seed", type=int, help="of the scene (default: 0)")
    parser.add_argument("--via", type=float, nargs=3, metavar=("X", "Y", "Z"), help="a first goal, m")
    bench_paper_code(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
