"""The transfer model against the simulated robot: both agree, from random states and along real plans."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from arm_simulation import ARM

from benchmarks.model import MUJOCO, OURS, Motion, bench_model, simulate
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.settings import SINGULARITY_FLOOR, ImpedanceSettings
from contact_reach_ros.planning.cost import knot_bounds, make_objective
from contact_reach_ros.planning.obstacles import ObstacleReader
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Problem, term_weights
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.scenes.placing import MIN_MOBILITY
from contact_reach_ros.world.collision import clearances
from contact_reach_ros.world.obstacle import BallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

SETTINGS = PlanningSettings()
FEW = PlanningSettings(population=32, line_search_points=32, max_steps=4, substeps=4)
STATES, CONTACTS = 80, 60
LIMIT_MARGIN, START_SPEED = 0.3, 0.2
"""rad; rad/s."""
GAP = 0.001
"""Between a ball and the link that moves towards it, m."""
MAX_SPEED_SHARE = 1.5
"""No arm moves faster than this share of its highest speed limit."""


@dataclasses.dataclass
class Case:
    """A scene to start from with the speeds `v` (n,) and actions (H, 6 + n)."""

    scene: Scene
    v: np.ndarray
    actions: np.ndarray

    @property
    def spheres(self):
        return obstacle_spheres(self.scene, rest_positions(self.scene))


def draw_free(random) -> Case:
    """A state away from singularities and joint limits, actions anywhere within their bounds."""
    bounds = np.tile(knot_bounds(ARM, SETTINGS), (SETTINGS.horizon, 1))
    model, mobility = RobotModel(ARM), 0.0
    while mobility < MIN_MOBILITY:
        q = random.uniform(np.array(ARM.lower) + LIMIT_MARGIN, np.array(ARM.upper) - LIMIT_MARGIN)
        model.update(q, np.zeros(ARM.n))
        mobility = model.smallest_mobility()
    v = random.normal(0.0, START_SPEED, ARM.n)
    return Case(Scene("free", ARM, 0, q, np.zeros(3)), v, random.uniform(-1.0, 1.0, bounds.shape) * bounds)


def draw_contact(random, settings: BallSettings) -> Case:
    """Such a state at rest, with a ball just off a middle link, where the posture change leads that link."""
    while True:
        case = draw_free(random)
        capsule = ARM.capsules[int(random.integers(1, len(ARM.capsules) - 1))]
        along = np.asarray(capsule.start) + random.uniform() * np.subtract(capsule.end, capsule.start)

        def point(q, capsule=capsule, along=along):
            rotations, origins = link_frames(ARM, q)
            rotation = rotations[capsule.link - 1]
            return origins[capsule.link - 1] + rotation @ along, rotation @ np.subtract(capsule.end, capsule.start)

        here, axis = point(case.scene.start)
        direction = point(case.scene.start + 0.1 * case.actions[:, 6:].sum(axis=0))[0] - here
        direction -= axis * (direction @ axis) / (axis @ axis)
        length = float(np.linalg.norm(direction))
        if length < 1e-3:
            continue
        balls = settings.at(here + (capsule.radius + settings.radius + GAP) * direction / length)
        case = Case(dataclasses.replace(case.scene, obstacles=balls), np.zeros(ARM.n), case.actions)
        # Not in the arm, which may be wider elsewhere.
        if clearances(ARM, case.scene.start, case.spheres)[0] > 0.5 * GAP:
            return case


def stacked(values):
    return single(np.stack(values, axis=-1))


def predict(cases: list[Case]) -> list[Motion]:
    """The transfer model on all cases at once."""
    obstacles = None
    if cases[0].scene.obstacles:
        reader = ObstacleReader(ARM, 1)
        each = [reader.read(case.scene.start, case.spheres) for case in cases]
        centers = single(np.concatenate([one.center for one in each], axis=-1))
        obstacles = each[0]._replace(center=centers, rest=centers)
    q, v = stacked([case.scene.start for case in cases]), stacked([case.v for case in cases])
    goal = single(np.zeros((3, 1))), single(np.eye(3)[:, :, None])
    problem = Problem(q, v, obstacles, *goal, term_weights(SETTINGS), 0.0)
    objective = make_objective(ARM, SETTINGS, ImpedanceSettings())
    rollout = jax.device_get(jax.jit(objective.roll_out)(problem, stacked([case.actions for case in cases])))
    parts = rollout.pose.position[1:], rollout.pose.rotation[1:], rollout.q[1:], rollout.link_force
    return [Motion(*(part[..., index] for part in parts)) for index in range(len(cases))]


def simulated(case: Case) -> tuple[Motion, bool]:
    """The simulated motion, and whether arms move like this: not too fast, off their stops and singularities."""
    speeds, margins, mobilities = [], [], []

    def watch(model, q, v):
        speeds.append(np.abs(v).max())
        margins.append(np.minimum(ARM.upper - q, q - ARM.lower).min())
        if len(speeds) % 10 == 1:
            mobilities.append(model.smallest_mobility())

    motion = simulate(case.scene, case.v, case.actions, watch=watch)
    is_slow = max(speeds) <= MAX_SPEED_SHARE * max(ARM.velocity_limits)
    return motion, is_slow and min(margins) > 0.0 and min(mobilities) >= SINGULARITY_FLOOR


def compared(cases: list[Case]) -> list[tuple[Motion, Motion, bool]]:
    """The motions that the model predicts, those of the simulation, and whether arms move like these."""
    return [(ours, *simulated(case)) for ours, case in zip(predict(cases), cases, strict=True)]


def test_free_motion_agrees_to_a_millimetre_and_half_a_degree():
    random = np.random.default_rng(0)
    pairs = compared([draw_free(random) for _ in range(STATES)])

    def away(ours, theirs):
        return float(np.linalg.norm(ours.positions - theirs.positions, axis=1).max())

    common = [(ours, theirs) for ours, theirs, is_common in pairs if is_common]
    assert len(common) >= 50
    assert max(away(*pair) for pair in common) <= 1e-3
    # What no arm could follow is not far off either, as a rule.
    assert np.percentile([away(ours, theirs) for ours, theirs, _ in pairs], 90) <= 1e-3
    for ours, theirs in common:
        # ‖R − I‖ / √2 is the angle, nearly.
        turn = ours.rotations @ np.swapaxes(theirs.rotations, 1, 2)
        assert np.linalg.norm(turn - np.eye(3), axis=(1, 2)).max() / np.sqrt(2.0) <= np.radians(0.5)


def test_contact_forces_agree_with_the_simulation_s_own_contacts():
    random = np.random.default_rng(1)
    pairs = compared([draw_contact(random, BallSettings(friction=0.0)) for _ in range(CONTACTS)])
    # Of the largest force on a link.
    error = np.array(
        [ours.force / theirs.force - 1.0 for ours, theirs, is_common in pairs if is_common and theirs.force >= 1.0]
    )
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
