"""`contact-reach bench model`: the planner's transfer model against the simulated robot, which it knows nothing of.

Both start from the same states and follow the same actions under the same control law. The simulated robot is MuJoCo at
1 ms with its own contacts and the controller's own law; joint friction, sensor noise and torque ramps are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arms import load_arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments.episode import EpisodeOptions, run_episode
from contact_reach_ros.experiments.grid import Setup, prepared
from contact_reach_ros.experiments.model_cases import Case, Motion, draw_contact, draw_free, simulate
from contact_reach_ros.experiments.output import percentiles, say, write_report
from contact_reach_ros.experiments.paper import METHOD
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.objectives import knot_bounds, make_objective
from contact_reach_ros.planning.obstacles import ObstacleReader, clearances
from contact_reach_ros.planning.problem import Problem, Rollout
from contact_reach_ros.planning.runtime import configure_jax
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import term_weights
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.resources import cache_directory
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.generate import make_scene
from contact_reach_ros.world.kinds.ball import BallSettings
from contact_reach_ros.world.scene import SceneFile
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres

SUBSTEPS = (2, 3, 4, 5, 6, 8)
MAX_SPEED_SHARE = 1.5
"""Motions that exceed the highest speed limit by this factor are reported apart, like those that pass a singularity or
hit a stop: arms don't do that."""
MIN_FORCE = 1.0
"""Contacts below this are not compared, N."""

WALL = "wall"
CAPACITIES = (6, 8, 12, 16, 24, 40)


def predict(cases: Sequence[Case], substeps: int) -> Rollout:
    """The transfer model on all cases at once, with as many substeps per knot; one sphere each, or none in all."""
    settings = PlanningSettings(substeps=substeps)
    objective = make_objective(cases[0].arm, settings, ImpedanceSettings())
    return jax.tree.map(np.asarray, jax.jit(objective.roll_out)(_problem(cases), _stacked([c.actions for c in cases])))


def _problem(cases: Sequence[Case]) -> Problem:
    obstacles = None
    if cases[0].ball is not None:
        reader = ObstacleReader(cases[0].arm, 1)
        each = [reader.read(case.q, case.spheres)[0] for case in cases]
        obstacles = each[0]
        assert obstacles is not None
        centers = single(np.concatenate([one.center for one in each if one is not None], axis=-1))
        obstacles = obstacles._replace(center=centers, rest=centers)
    return _without_goal(_stacked([case.q for case in cases]), _stacked([case.v for case in cases]), obstacles)


def _without_goal(q: jax.Array, v: jax.Array, obstacles: Obstacles | None) -> Problem:
    """A problem to roll out only."""
    position, rotation = single(np.zeros((3, 1))), single(np.eye(3)[:, :, None])
    settings = PlanningSettings()
    return Problem(q, v, obstacles, position, rotation, term_weights(settings), 0.0, settings.joint_limit_margin)


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
    """Whether no joint is too fast for an arm or hits its stop, and the controller need not bound Λ."""
    singular = motion.eigenvalue < ImpedanceSettings().singularity_floor
    return motion.speed_share <= MAX_SPEED_SHARE and motion.margin > 0.0 and not singular


def motion_errors(rollout: Rollout, motions: Sequence[Motion]) -> MotionErrors:
    """Tip of the transfer model against that of the simulation."""
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
    """Forces (M,), N, of the simulation where they are at least 1 N, and the relative errors (M,) of the model's.

    One value per case: the largest force on a link over the horizon.
    """
    predicted = np.moveaxis(np.asarray(rollout.link_force, float), -1, 0).max(axis=(1, 2))
    true = np.array([motion.forces.max() for motion in motions])
    compared = (true >= MIN_FORCE) & np.array([is_common(motion) for motion in motions])
    return true[compared], predicted[compared] / true[compared] - 1.0


def bench_model(states: int = 500, seed: int = 0, file: Path | None = None) -> dict[str, Any]:
    """Compare, print three tables in Markdown and write JSON to `file`."""
    configure_jax(cache_directory() / "jax")
    random = np.random.default_rng(seed)
    arm = load_arm()
    say(f"{states} free motions of {PlanningSettings().horizon} knots in MuJoCo ...")
    free = _compare_motions(draw_free(arm, random, states))
    ball = BallSettings(friction=0.0)
    say(f"{states} motions against a ball of {ball.contact_stiffness:g} N/m in MuJoCo ...")
    contact = _compare_forces(draw_contact(arm, random, states, ball))
    say(f"scene '{WALL}' ...")
    nearest = culling_errors(arm, read_scene(WALL), CAPACITIES, max(states // 10, 1), seed)
    fastest = MAX_SPEED_SHARE * max(arm.velocity_limits)
    print(f"Tip over 0.3 s; motions up to {fastest:.2f} rad/s away from singularities and stops, and all\n")
    _print_table(
        "| substeps | motions | mm p50 | p95 | max | deg p50 | p95 | max | all: mm p95 | max | deg p95 | max |",
        "| {key} | {motions} | {position_mm[p50]:.2f} | {position_mm[p95]:.2f} | {position_mm[max]:.2f} "
        "| {rotation_deg[p50]:.2f} | {rotation_deg[p95]:.2f} | {rotation_deg[max]:.2f} "
        "| {all_position_mm[p95]:.2f} | {all_position_mm[max]:.2f} "
        "| {all_rotation_deg[p95]:.2f} | {all_rotation_deg[max]:.2f} |",
        free,
    )
    print(f"\nLargest force on a link over 0.3 s, where MuJoCo has {MIN_FORCE:g} N or more\n")
    _print_table(
        "| substeps | contacts | N p50 | N max | error p50 | p95 | max | mean | within 15 % |",
        "| {key} | {contacts} | {force_n[p50]:.1f} | {force_n[max]:.1f} | {relative_error[p50]:.1%} "
        "| {relative_error[p95]:.1%} | {relative_error[max]:.1%} | {bias:+.1%} | {within_15_percent:.0%} |",
        contact,
    )
    print(f"\nScene '{WALL}' with the nearest spheres only, against the nearest {CAPACITIES[-1]}\n")
    _print_table(
        "| spheres | the last one is away, mm | tip, mm max | force, N p50 | p95 | max |",
        "| {key} | {last_distance_mm:.0f} | {flange_mm:.2f} | {force_n[p50]:.2f} | {force_n[p95]:.2f} "
        "| {force_n[max]:.2f} |",
        nearest,
    )
    report = {"states": states, "seed": seed, "free": free, "contact": contact, "nearest": nearest}
    write_report(report, file)
    return report


def _print_table(header: str, line: str, rows: Mapping[int, Mapping[str, Any]]) -> None:
    """Print a table in Markdown; `line` formats the values of each row and its key."""
    print(header)
    print("|" + "---|" * (header.count("|") - 1))
    for key, row in rows.items():
        print(line.format(key=key, **row))


def _compare_motions(cases: Sequence[Case]) -> dict[int, dict[str, Any]]:
    """Errors of the tip by number of substeps."""
    truth = [simulate(case) for case in cases]
    found = {}
    for substeps in SUBSTEPS:
        every = motion_errors(predict(cases, substeps), truth)
        common = every.commonly()
        found[substeps] = {
            "motions": len(common.position),
            "position_mm": percentiles(1e3 * common.position),
            "rotation_deg": percentiles(np.degrees(common.rotation)),
            "all_position_mm": percentiles(1e3 * every.position),
            "all_rotation_deg": percentiles(np.degrees(every.rotation)),
        }
    return found


def _compare_forces(cases: Sequence[Case]) -> dict[int, dict[str, Any]]:
    """Errors of the largest force on a link by number of substeps."""
    truth = [simulate(case) for case in cases]
    found = {}
    for substeps in SUBSTEPS:
        force, error = force_errors(predict(cases, substeps), truth)
        found[substeps] = {
            "contacts": len(force),
            "force_n": percentiles(force),
            "relative_error": percentiles(np.abs(error)),
            "bias": float(np.mean(error)),
            "within_15_percent": float(np.mean(np.abs(error) <= 0.15)),
        }
    return found


def culling_errors(
    arm: Arm, scene_file: SceneFile, capacities: Sequence[int], actions: int, seed: int
) -> dict[int, dict[str, Any]]:
    """What is lost by looking at the nearest spheres only, against as many as the last of the capacities.

    From states along an episode in the scene, each with random `actions`: largest differences of the tip, m, and of
    the largest force on a link, N.
    """
    random = np.random.default_rng(seed)
    states = _states_in_contact(arm, scene_file, seed)
    settings = PlanningSettings()
    bounds = np.tile(knot_bounds(arm, settings)[:, None], (settings.horizon, 1, 1))
    samples = random.uniform(-1.0, 1.0, (len(states), settings.horizon, bounds.shape[1], actions)) * bounds
    tips: dict[int, Array] = {}
    forces: dict[int, Array] = {}
    distances: dict[int, Array] = {}
    objective = make_objective(arm, settings, ImpedanceSettings())
    for capacity in capacities:
        reader = ObstacleReader(arm, capacity)
        roll_out = jax.jit(objective.roll_out)
        rollouts = []
        for (q, v, spheres), drawn in zip(states, samples, strict=True):
            problem = _without_goal(single(q[:, None]), single(v[:, None]), reader.read(q, spheres)[0])
            rollouts.append(jax.tree.map(np.asarray, roll_out(problem, single(drawn))))
        tips[capacity] = np.array([rollout.pose.position for rollout in rollouts])
        forces[capacity] = np.array([rollout.link_force.max(axis=(0, 1)) for rollout in rollouts])
        distances[capacity] = np.array([np.sort(clearances(arm, q, spheres))[capacity - 1] for q, _, spheres in states])
    most = capacities[-1]
    return {
        capacity: {
            "last_distance_mm": 1e3 * float(distances[capacity].min()),
            "flange_mm": 1e3 * float(np.linalg.norm(tips[capacity] - tips[most], axis=2).max()),
            "force_n": percentiles(np.abs(forces[capacity] - forces[most]).ravel()),
            "largest_force_n": float(forces[most].max()),
        }
        for capacity in capacities
    }


def _states_in_contact(arm: Arm, scene_file: SceneFile, seed: int) -> list[tuple[Array, Array, Spheres]]:
    """Joint angles, speeds and spheres every 0.2 s of an episode while something touches the arm."""
    scene = make_scene(scene_file, arm, seed)
    states: list[tuple[Array, Array, Spheres]] = []

    def watch(tick: int, plant: Plant) -> None:
        if tick % 200 == 0 and plant.data.ncon > 0:
            q, v = plant.data.qpos[: arm.n].copy(), plant.data.qvel[: arm.n].copy()
            states.append((q, v, obstacle_spheres(scene, plant.obstacle_positions())))

    method = prepared(METHOD, scene_file, Setup(budget=load_budget()))
    run_episode(scene, method, EpisodeOptions(), watch)
    return states
