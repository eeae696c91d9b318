"""The planner's transfer model against MuJoCo, and against Brax: the plans of closed-loop runs, rolled out by each.

Every model starts from the state for which the plan was made, with the references in force then, and follows the plan's
actions. MuJoCo's is the simulated robot at 1 ms under the controller's own law with its limits, without joint friction.
The plans are made without a weight on permitted contact, so that the arm leans on what it may touch.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pinocchio as pin

from benchmarks.output import command_line, given, percentiles, run_command, say, table, write_report
from benchmarks.recorded_plans import RecordedPlan, record_plans
from contact_reach_ros.arm import Array
from contact_reach_ros.arm.kinematics import AXIS
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.constants import body_of, make_constants
from contact_reach_ros.control.kernels import tracking_torque
from contact_reach_ros.control.references import Reference, Way
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import ReferenceSpace
from contact_reach_ros.planning.settings import PIPELINES, PlanningSettings
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.simulation.plant import TICK, Actuation, Plant
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import rest_positions

OURS, MUJOCO = "closed_loop", "MuJoCo"


@dataclass(frozen=True, eq=False)
class Motion:
    """How an arm moves under a plan.

    Attributes
    ----------
    positions, rotations
        (H, 3), m, and (H, 3, 3) of the tip at the ends of the knots.
    joints
        (H, n), rad.
    forces
        (H, L) largest force on each contact link within the knot, N.
    """

    positions: Array
    rotations: Array
    joints: Array
    forces: Array

    @property
    def force(self) -> float:
        """Largest on a link within the horizon, N."""
        return float(self.forces.max())


def simulate(
    scene: Scene,
    v: Array,
    actions: Array,
    before: Reference | None = None,
    spheres: Array | None = None,
    gains: ImpedanceSettings | None = None,
    constants: Array | None = None,
) -> Motion:
    """The simulated robot from the start of a scene with the speeds `v` (n,), under the actions (H, 6 + n).

    The actions are latched as the controller latches them.

    Parameters
    ----------
    before
        Reference in force at the start; by default that of a hold.
    spheres
        (K, 3) positions of the obstacles' spheres at the start, m; by default at rest.
    gains
        Of the law and its references; by default the package's.
    constants
        Of the controller; by default those of the gains, with the package's limits.
    """
    arm = scene.arm
    plant = Plant(scene, friction=(0.0, 0.0))
    plant.set_actuation(Actuation.COMMANDED)
    if spheres is not None:
        movable = ~np.concatenate([np.zeros(0, bool), *(obstacle.fixed for obstacle in scene.obstacles)])
        plant.data.qpos[arm.n :] = (spheres - rest_positions(scene))[movable].ravel()
    data = plant.data
    data.qvel[: arm.n] = v
    gains = (gains or ImpedanceSettings()).resolve(arm)
    model, sent = RobotModel(arm), None
    constants = make_constants(arm, gains) if constants is None else constants
    body, found = body_of(model), np.zeros(7)
    before = before or Reference(*model.tip_pose(scene.start), scene.start)
    motion: list[tuple[Array, Array, Array, Array]] = []
    for action in actions:
        q, v = data.qpos[: arm.n], data.qvel[: arm.n]
        ahead = q + 0.5 * gains.reference_ramp * v
        position, rotation = model.tip_pose(ahead)
        # The two rotations that turn one axis are in the tip's axes.
        turn = rotation @ action[3:6] if gains.task == AXIS else action[3:6]
        knot = Reference(position + action[:3], pin.exp3(turn) @ rotation, ahead + action[6:])
        force = np.zeros(len(plant.arm.contact_links))
        for tick in range(round(PlanningSettings().knot_duration / TICK)):
            share = min(1.0, tick * TICK / gains.reference_ramp) if gains.reference_ramp else 1.0
            reference = Way(before, knot).at(share)
            model.update(q, v)
            last = model.bias if sent is None else sent
            state = model.mass_matrix, model.bias, model.gravity, model.position, model.rotation
            motion_now = model.jacobian, model.twist, model.drift
            sent = tracking_torque(constants, *state, *motion_now, *reference, *body, q, v, 1.0, last, TICK, found)
            plant.step(sent)
            force = np.maximum(force, normal_forces(plant))
        before = knot
        model.update(q, v)
        motion.append((model.position.copy(), model.rotation.copy(), q.copy(), force))
    return Motion(*map(np.array, zip(*motion, strict=True)))


def normal_forces(plant: Plant) -> Array:
    """Sum of the normal forces of the contacts on each of `plant.arm.contact_links`, (L,), N, without friction."""
    sums, force = np.zeros(len(plant.arm.contact_links)), np.zeros(6)
    for index, contact in enumerate(plant.data.contact):
        mujoco.mj_contactForce(plant.model, plant.data, index, force)
        for body in plant.model.geom_bodyid[contact.geom]:
            if (name := plant.model.body(body).name) in plant.arm.contact_links:
                sums[plant.arm.contact_links.index(name)] += force[0]
    return sums


def bench_model(
    against: Sequence[str] = (),
    scenes: Sequence[str] = ("free", "ball", "wall"),
    plans: int = 12,
    seed: int = 0,
    file: Path | None = None,
    settings: PlanningSettings | None = None,
) -> dict[str, Any]:
    """Roll out, print a table in Markdown and write JSON to `file`.

    Parameters
    ----------
    against
        Pipelines of Brax to compare with, too.
    scenes
        Names or files.
    plans
        Number of plans per scene, half of them with contact where there are that many.
    seed
        Of the runs that the plans come from.
    settings
        Of the planner; by default the paper's budget.
    """
    settings = dataclasses.replace(settings or PlanningSettings(), contact_weight=0.0, deadline=0.0)
    report: dict[str, Any] = {"plans": plans, "seed": seed, "scenes": {}}
    for name in scenes:
        recorded = record_plans(load_arm(), read_scene(name), settings, plans, seed)
        motions = {MUJOCO: [_simulated(plan) for plan in recorded]}
        for pipeline in (OURS, *against):
            began = time.perf_counter()
            motions[pipeline] = _predicted(pipeline, recorded, settings)
            say(f"{name}: {pipeline} took {time.perf_counter() - began:.0f} s, compilation included")
        report["scenes"][name] = {
            "largest_force_n": percentiles([motion.force for motion in motions[MUJOCO]]),
            "rows": [_compared(motions, one, MUJOCO) for one in (OURS, *against)]
            + [_compared(motions, OURS, one) for one in against],
        }
    print(_table(report))
    write_report(report, file)
    return report


def _predicted(pipeline: str, plans: Sequence[RecordedPlan], settings: PlanningSettings) -> list[Motion]:
    space = ReferenceSpace(load_arm(), dataclasses.replace(settings, pipeline=pipeline), ImpedanceSettings())
    roll_out = jax.jit(lambda problem, points: space.objective.roll_out(problem, space.actions(points, problem)))
    motions = []
    for plan in plans:
        rollout = jax.device_get(roll_out(plan.problem, plan.best[:, None]))
        pose = rollout.pose
        motions.append(
            Motion(
                pose.position[1:, ..., 0], pose.rotation[1:, ..., 0], rollout.q[1:, :, 0], rollout.link_force[..., 0]
            )
        )
    return motions


def _simulated(plan: RecordedPlan) -> Motion:
    scene, problem = plan.scene, jax.device_get(plan.problem)
    space = ReferenceSpace(scene.arm, PlanningSettings(horizon=len(plan.plan.positions)), ImpedanceSettings())
    actions = np.asarray(space.actions(single(plan.best[:, None]), problem), np.float64)[..., 0]
    spheres = plan.request.spheres.center
    if problem.obstacles is not None and len(spheres) == problem.obstacles.center.shape[1]:
        # As predicted for the start of the plan; of a wall the planner knows only a part there.
        spheres = np.asarray(problem.obstacles.center[..., 0].T, np.float64)
    before = None
    if problem.before is not None:
        before = Reference(*(np.asarray(part, np.float64)[..., 0] for part in problem.before))
    start = problem.q[:, 0].astype(float)
    return simulate(dataclasses.replace(scene, start=start), problem.v[:, 0].astype(float), actions, before, spheres)


def _compared(motions: dict[str, list[Motion]], one: str, other: str) -> dict[str, Any]:
    """Largest differences of each plan between two models."""
    pairs = list(zip(motions[one], motions[other], strict=True))
    return {
        "model": one,
        "against": other,
        "tip_mm": percentiles([1e3 * np.linalg.norm(a.positions - b.positions, axis=1).max() for a, b in pairs]),
        "joints_deg": percentiles([np.degrees(np.abs(a.joints - b.joints).max()) for a, b in pairs]),
        "force_n": percentiles([abs(a.force - b.force) for a, b in pairs]),
    }


def _table(report: dict[str, Any]) -> str:
    header = ["scene (force, N p50, max)", "model", "against", "tip, mm p50", "max", "joints, deg p50", "max"]
    rows = []
    for name, scene in report["scenes"].items():
        force = scene["largest_force_n"]
        for row in scene["rows"]:
            values = [row[key][size] for key in ("tip_mm", "joints_deg", "force_n") for size in ("p50", "max")]
            label = f"{name} ({force['p50']:.1f}, {force['max']:.1f})"
            rows.append([label, row["model"], row["against"], *(f"{value:.2f}" for value in values)])
    return table([*header, "force, N p50", "max"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--against", nargs="+", choices=PIPELINES[1:], help="Brax's pipelines, too (default: none)")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: free ball wall)")
    parser.add_argument("--plans", type=int, help="plans per scene (default: 12)")
    parser.add_argument("--seed", type=int, help="of the first run (default: 0)")
    bench_model(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
