"""`contact-reach bench model`: the planner's transfer model against the simulated robot, which it knows nothing of.

Both start from the same states and follow the same actions under the same control law. The simulated robot is MuJoCo at
1 ms with its own contacts and the controller's own law; joint friction, sensor noise and torque ramps are left out.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.baselines.method import ReferenceMethod
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments.episode import EpisodeOptions, run_episode
from contact_reach_ros.experiments.model_cases import Case, Motion, draw_contact, draw_free, simulate
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.cost import Problem, Rollout, Weights
from contact_reach_ros.planning.objectives import action_bounds, make_objective
from contact_reach_ros.planning.obstacles import ObstacleReader, clearances
from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.runtime import configure_jax
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.transfer.pipeline import N_ACTION
from contact_reach_ros.plant.plant import Plant
from contact_reach_ros.resources import cache_directory
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.scene import BallSettings, SceneFile
from contact_reach_ros.scenes.spheres import obstacle_spheres, sphere_capacity

Array = NDArray[np.float64]

SUBSTEPS = (2, 3, 4, 5, 6, 8)
MAX_SPEED = 1.5 * max(iiwa14.VELOCITY_LIMITS)
"""Faster motions, rad/s, are reported apart, like those that pass a singularity or hit a stop: arms don't do that."""
MIN_FORCE = 1.0
"""Contacts below this are not compared, N."""

WALL = "wall"
CAPACITIES = (6, 8, 12, 16, 24, 40)


def predict(cases: Sequence[Case], substeps: int) -> Rollout:
    """The transfer model on all cases at once, with as many substeps per knot; one sphere each, or none in all."""
    settings = PlanningSettings(substeps=substeps)
    objective = make_objective(settings, ImpedanceSettings())
    return jax.tree.map(np.asarray, jax.jit(objective.roll_out)(_problem(cases), _stacked([c.actions for c in cases])))


def _problem(cases: Sequence[Case]) -> Problem:
    obstacles = None
    if cases[0].ball is not None:
        reader = ObstacleReader(1)
        each = [reader.read(case.q, case.spheres)[0] for case in cases]
        obstacles = each[0]
        assert obstacles is not None
        centers = single(np.concatenate([one.center for one in each if one is not None], axis=-1))
        obstacles = obstacles._replace(center=centers, rest=centers)
    return Problem(
        q=_stacked([case.q for case in cases]),
        v=_stacked([case.v for case in cases]),
        obstacles=obstacles,
        goal_position=single(np.zeros((3, 1))),
        goal_rotation=single(np.eye(3)[:, :, None]),
        weights=Weights.of(PlanningSettings(), 0.0),
    )


def _stacked(values: Sequence[Array]) -> jax.Array:
    return single(np.stack(values, axis=-1))


@dataclass(frozen=True, eq=False)
class MotionErrors:
    """Largest errors over the horizon of each case."""

    position: Array
    """(N,), m."""
    rotation: Array
    """(N,), rad."""
    common: NDArray[np.bool_]
    """(N,) whether the motion is one that an arm makes: see `is_common`."""

    def commonly(self) -> MotionErrors:
        """Those of common motions."""
        return MotionErrors(self.position[self.common], self.rotation[self.common], self.common[self.common])


def is_common(motion: Motion) -> bool:
    """Whether no joint exceeds `MAX_SPEED` or hits its stop, and the controller need not bound Λ."""
    singular = motion.eigenvalue < ImpedanceSettings().singularity_floor
    return motion.speed <= MAX_SPEED and motion.margin > 0.0 and not singular


def motion_errors(rollout: Rollout, motions: Sequence[Motion]) -> MotionErrors:
    """Flange of the transfer model against that of the simulation."""
    positions = np.moveaxis(np.asarray(rollout.pose.position, float)[1:], -1, 0)
    rotations = np.moveaxis(np.asarray(rollout.pose.rotation, float)[1:], -1, 0)
    offset = positions - np.array([motion.positions for motion in motions])
    turn = rotations @ np.swapaxes([motion.rotations for motion in motions], 2, 3)
    # ‖R − I‖ / √2 = 2 sin(angle / 2), which also holds for matrices that are slightly off orthonormal.
    chord = np.linalg.norm(turn - np.eye(3), axis=(2, 3)) / np.sqrt(2.0)
    return MotionErrors(
        position=np.linalg.norm(offset, axis=2).max(axis=1),
        rotation=2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)).max(axis=1),
        common=np.array([is_common(motion) for motion in motions]),
    )


def force_errors(rollout: Rollout, motions: Sequence[Motion]) -> tuple[Array, Array]:
    """Forces (M,), N, of the simulation where it says at least 1 N, and the relative errors (M,) of the model's.

    One value per case: the largest force on a link over the horizon.
    """
    predicted = np.moveaxis(np.asarray(rollout.link_force, float), -1, 0).max(axis=(1, 2))
    true = np.array([motion.forces.max() for motion in motions])
    compared = (true >= MIN_FORCE) & np.array([is_common(motion) for motion in motions])
    return true[compared], predicted[compared] / true[compared] - 1.0


def bench_model(states: int, seed: int, file: Path | None, progress: Callable[[str], None] = print) -> dict:
    """Compare, print three tables in Markdown and write JSON to `file`."""
    configure_jax(cache_directory() / "jax")
    random = np.random.default_rng(seed)
    free = draw_free(random, states)
    progress(f"{states} free motions of {PlanningSettings().horizon} knots in MuJoCo ...")
    truth = [simulate(case) for case in free]
    report: dict = {"states": states, "seed": seed, "free": {}, "contact": {}}
    progress("")
    progress(f"Flange over 0.3 s; motions up to {MAX_SPEED:.2f} rad/s away from singularities and stops, and all\n")
    progress("| substeps | motions | mm p50 | p95 | max | deg p50 | p95 | max | all: mm p95 | max | deg p95 | max |")
    progress("|" + "---|" * 12)
    for substeps in SUBSTEPS:
        every = motion_errors(predict(free, substeps), truth)
        common = every.commonly()
        row: dict[str, Any] = {
            "motions": len(common.position),
            "position_mm": _summary(1e3 * common.position),
            "rotation_deg": _summary(np.degrees(common.rotation)),
            "all_position_mm": _summary(1e3 * every.position),
            "all_rotation_deg": _summary(np.degrees(every.rotation)),
        }
        report["free"][substeps] = row
        cells = [row["position_mm"], row["rotation_deg"]]
        numbers = [f"{cell[key]:.2f}" for cell in cells for key in ("p50", "p95", "max")]
        numbers += [
            f"{row[name][key]:.2f}" for name in ("all_position_mm", "all_rotation_deg") for key in ("p95", "max")
        ]
        progress(f"| {substeps} | {row['motions']} | " + " | ".join(numbers) + " |")
    settings = BallSettings(friction=0.0)
    pushed = draw_contact(random, states, settings)
    progress(f"\n{states} motions against a ball of {settings.contact_stiffness:g} N/m in MuJoCo ...")
    truth = [simulate(case) for case in pushed]
    progress(f"\nLargest force on a link over 0.3 s, where MuJoCo has {MIN_FORCE:g} N or more\n")
    progress("| substeps | contacts | N p50 | N max | error p50 | p95 | max | mean | within 15 % |")
    progress("|" + "---|" * 9)
    for substeps in SUBSTEPS:
        force, error = force_errors(predict(pushed, substeps), truth)
        row = {
            "contacts": len(force),
            "force_n": _summary(force),
            "relative_error": _summary(np.abs(error)),
            "bias": float(np.mean(error)),
            "within_15_percent": float(np.mean(np.abs(error) <= 0.15)),
        }
        report["contact"][substeps] = row
        errors = " | ".join(f"{100 * row['relative_error'][key]:.1f} %" for key in ("p50", "p95", "max"))
        progress(
            f"| {substeps} | {len(force)} | {np.median(force):.1f} | {force.max():.1f} | {errors} | "
            f"{100 * row['bias']:+.1f} % | {100 * row['within_15_percent']:.0f} % |"
        )
    progress(f"\nScene '{WALL}' with the nearest spheres only, against the nearest {CAPACITIES[-1]}\n")
    progress("| spheres | the last one is away, mm | flange, mm max | force, N p50 | p95 | max |")
    progress("|" + "---|" * 6)
    report["nearest"] = culling_errors(read_scene(WALL), CAPACITIES, max(states // 10, 1), seed)
    for capacity, row in report["nearest"].items():
        lost = " | ".join(f"{row['force_n'][key]:.2f}" for key in ("p50", "p95", "max"))
        progress(f"| {capacity} | {row['last_distance_mm']:.0f} | {row['flange_mm']:.2f} | {lost} |")
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")
    return report


def _summary(values: Array) -> dict[str, float]:
    return {"p50": float(np.median(values)), "p95": float(np.percentile(values, 95)), "max": float(values.max())}


def culling_errors(
    scene_file: SceneFile, capacities: Sequence[int], actions: int, seed: int
) -> dict[int, dict[str, Any]]:
    """What is lost by looking at the nearest spheres only, against as many as the last of the capacities.

    From states along an episode in the scene, each with random `actions`: largest differences of the flange, m, and of
    the largest force on a link, N.
    """
    random = np.random.default_rng(seed)
    states = _states_in_contact(scene_file, seed)
    settings = PlanningSettings()
    bounds = action_bounds(settings).reshape(settings.horizon, N_ACTION, 1)
    samples = random.uniform(-1.0, 1.0, (len(states), settings.horizon, N_ACTION, actions)) * bounds
    flanges: dict[int, Array] = {}
    forces: dict[int, Array] = {}
    distances: dict[int, Array] = {}
    objective = make_objective(settings, ImpedanceSettings())
    for capacity in capacities:
        reader = ObstacleReader(capacity)
        roll_out = jax.jit(objective.roll_out)
        rollouts = []
        for (q, v, spheres), drawn in zip(states, samples, strict=True):
            problem = Problem(
                q=single(q[:, None]),
                v=single(v[:, None]),
                obstacles=reader.read(q, spheres)[0],
                goal_position=single(np.zeros((3, 1))),
                goal_rotation=single(np.eye(3)[:, :, None]),
                weights=Weights.of(settings, 0.0),
            )
            rollouts.append(jax.tree.map(np.asarray, roll_out(problem, single(drawn))))
        flanges[capacity] = np.array([rollout.pose.position for rollout in rollouts])
        forces[capacity] = np.array([rollout.link_force.max(axis=(0, 1)) for rollout in rollouts])
        distances[capacity] = np.array([np.sort(clearances(q, spheres))[capacity - 1] for q, _, spheres in states])
    most = capacities[-1]
    return {
        capacity: {
            "last_distance_mm": 1e3 * float(distances[capacity].min()),
            "flange_mm": 1e3 * float(np.linalg.norm(flanges[capacity] - flanges[most], axis=2).max()),
            "force_n": _summary(np.abs(forces[capacity] - forces[most]).ravel()),
            "largest_force_n": float(forces[most].max()),
        }
        for capacity in capacities
    }


def _states_in_contact(scene_file: SceneFile, seed: int) -> list[tuple[Array, Array, Spheres]]:
    """Joint angles, speeds and spheres every 0.2 s of an episode while something touches the arm."""
    scene = make_scene(scene_file, seed)
    states: list[tuple[Array, Array, Spheres]] = []

    def watch(tick: int, plant: Plant) -> None:
        if tick % 200 == 0 and plant.data.ncon > 0:
            q, v = plant.data.qpos[: iiwa14.N_JOINTS].copy(), plant.data.qvel[: iiwa14.N_JOINTS].copy()
            states.append((q, v, obstacle_spheres(scene, plant.obstacle_positions())))

    settings = PlanningSettings(deadline=0.0)
    permitted = load_budget("").permitted_force
    planner = RecedingHorizonPlanner(settings, ImpedanceSettings(), permitted, sphere_capacity(scene_file))
    run_episode(scene, ReferenceMethod(planner, ControllerSettings()), EpisodeOptions(), watch)
    return states
