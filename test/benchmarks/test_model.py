"""The transfer model against the simulated robot's own contacts, and real plans against Brax and MuJoCo."""

import json

import jax
import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST

from benchmarks.model import MUJOCO, OURS, bench_model, simulate
from contact_reach_ros.control.constants import make_constants
from contact_reach_ros.control.kernels import Constant
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import knot_bounds, make_objective
from contact_reach_ros.planning.obstacles import ObstacleReader
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Problem, term_weights
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.world.collision import capsule_segments, clearances
from contact_reach_ros.world.obstacle import BallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

SETTINGS = PlanningSettings()
FEW = PlanningSettings(population=32, max_steps=4, substeps=4)
CONTACTS = 40
GAP = 0.001
"""Between a ball and the link that moves towards it, m."""


def draw_contact(random) -> tuple[Scene, np.ndarray]:
    """The arm near home with a smooth ball just off a middle link, where the posture change leads that link."""
    bounds, settings = np.tile(knot_bounds(ARM, SETTINGS), (SETTINGS.horizon, 1)), BallSettings(friction=0.0)
    while True:
        q, actions = HOME + random.uniform(-0.4, 0.4, ARM.n), random.uniform(-0.8, 0.8, bounds.shape) * bounds
        link, share = int(random.integers(1, len(ARM.capsules) - 1)), random.uniform()
        starts, ends = capsule_segments(ARM, q)
        axis = ends[link] - starts[link]
        later, later_ends = capsule_segments(ARM, q + 0.1 * actions[:, 6:].sum(axis=0))
        direction = (1.0 - share) * (later - starts)[link] + share * (later_ends - ends)[link]
        direction -= axis * (direction @ axis) / (axis @ axis)
        distance = ARM.capsules[link].radius + settings.radius + GAP
        center = starts[link] + share * axis + distance * direction / np.linalg.norm(direction)
        scene = Scene("contact", ARM, 0, q, np.zeros(3), settings.at(center))
        # Not in the arm, which may be wider elsewhere.
        if clearances(ARM, q, obstacle_spheres(scene, rest_positions(scene)))[0] > 0.5 * GAP:
            return scene, actions


def predicted_forces(scenes: list[Scene], actions: list[np.ndarray]) -> np.ndarray:
    """Largest force on a link within the horizon by the transfer model, N, of all scenes at once."""
    reader = ObstacleReader(ARM, 1)
    each = [reader.read(scene.start, obstacle_spheres(scene, rest_positions(scene))) for scene in scenes]
    centers = single(np.concatenate([one.center for one in each], axis=-1))
    q = single(np.stack([scene.start for scene in scenes], axis=-1))
    problem = Problem(
        q,
        np.zeros_like(q),
        each[0]._replace(center=centers, rest=centers),
        single(np.zeros((3, 1))),
        single(np.eye(3)[:, :, None]),
        term_weights(SETTINGS),
        0.0,
    )
    objective = make_objective(ARM, SETTINGS, ImpedanceSettings())
    rollout = jax.jit(objective.roll_out)(problem, single(np.stack(actions, axis=-1)))
    return np.asarray(rollout.link_force).max(axis=(0, 1))


@pytest.mark.slow
def test_contact_forces_agree_with_the_simulation_s_own_contacts():
    random = np.random.default_rng(1)
    scenes, actions = zip(*(draw_contact(random) for _ in range(CONTACTS)), strict=True)
    ours = predicted_forces(scenes, actions)
    constants = make_constants(ARM)
    # The model has the cap on joint speeds alone.
    constants[[Constant.TIP_FORCE, Constant.BODY_SPEED, Constant.IMPACT_ENERGY]] = 1e9
    theirs = np.array(
        [simulate(*each, constants=constants).force for each in zip(scenes, [REST] * CONTACTS, actions, strict=True)]
    )
    error = (ours / theirs - 1.0)[theirs >= 1.0]
    assert len(error) >= 20
    assert np.median(np.abs(error)) <= 0.05
    assert np.mean(np.abs(error) <= 0.15) >= 0.85
    assert abs(np.mean(error)) <= 0.05


@pytest.mark.slow
def test_brax_and_mujoco_agree_with_the_plans(tmp_path, capsys):
    file = tmp_path / "report.json"
    bench_model(["generalized"], ("ball",), plans=4, file=file, settings=FEW)
    report = json.loads(file.read_text())["scenes"]["ball"]
    rows = {(row["model"], row["against"]): row for row in report["rows"]}
    assert set(rows) == {(OURS, MUJOCO), ("generalized", MUJOCO), (OURS, "generalized")}
    assert report["largest_force_n"]["max"] > 1.0
    assert all(0.0 < row["tip_mm"]["max"] < 2.0 for row in rows.values())
    assert rows[OURS, MUJOCO]["force_n"]["p50"] < 0.3
    # Another model would be noticed.
    assert rows["generalized", MUJOCO]["tip_mm"]["p50"] != rows[OURS, MUJOCO]["tip_mm"]["p50"]
    assert "| ball (" in capsys.readouterr().out
