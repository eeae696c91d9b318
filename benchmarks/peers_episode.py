"""Episodes in the plant of this package, with its method and with the planners of other projects."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import time
from typing import Any, cast

import numpy as np

from benchmarks.episode import STILL, run_episode
from benchmarks.grid import PATIENCE, Record, Setup, concrete_scene, episode_seeds, prepared
from benchmarks.paper import METHOD
from benchmarks.peers_model import episode_settings, servo_gains
from contact_reach_ros.arm import Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalProgress
from contact_reach_ros.planning.plan import Plan, PlanningCore, Request
from contact_reach_ros.simulation.plant import TICK, TICK_NS, Actuation, Plant
from contact_reach_ros.world.goal import FREE, TOLERANCE, Goal, Target
from contact_reach_ros.world.scene_file import SceneFile

_PLAN_TICKS = 40
"""From a state to the effect of its plan, and to the next plan."""


def run_peer(file: SceneFile, target: int, setup: Setup, method: str, planner: subprocess.Popen[str]) -> Record:
    """One episode of a planner of `peers_runner`: servos that carry the arm's weight follow its knots, interpolated."""
    scene = concrete_scene(file, load_arm(setup.arm), target)
    _send(planner, episode_settings(scene, setup.planning, setup.budget.permitted_force))
    plant, arm, patience = Plant(scene), slice(0, scene.arm.n), round(PATIENCE / TICK)
    plant.set_actuation(Actuation.COMMANDED)
    stiffness, damping = servo_gains(scene.arm)
    data, progress, pose = plant.data, GoalProgress(Goal(scene.target, FREE)), Target(scene.target)
    plan: dict[str, Any] = {"times": [0.0], "knots": scene.start[None]}
    coming = plan
    positions, joints, forces, cpu = [plant.tip_position], [], [], []
    while plant.time < setup.timeout and progress.state.phase is not GoalPhase.SETTLED:
        if plant.steps % _PLAN_TICKS == 0:
            plan = coming
            _send(planner, {"time": plant.time, "qpos": data.qpos.tolist(), "qvel": data.qvel.tolist()})
            coming = _answer(planner, method)
            cpu.append(coming["cpu_s"])
        reference = [np.interp(plant.time, plan["times"], column) for column in np.transpose(plan["knots"])]
        plant.step(stiffness * (reference - data.qpos[arm]) - damping * data.qvel[arm] + data.qfrc_bias[arm])
        positions.append(plant.tip_position)
        joints.append(plant.joint_positions)
        forces.append(float(plant.contact_forces().max()))
        speed = float(np.linalg.norm(positions[-1] - positions[-2])) / TICK
        progress.update(pose, positions[-1], np.eye(3), speed, plant.steps * TICK_NS)
        if len(joints) % patience == 0 and np.ptp(joints[-patience:], axis=0).max() < STILL:
            break
    settled = plant.time if progress.state.phase is GoalPhase.SETTLED else None
    return _record(file, target, method, settled, np.array(positions) - scene.target, max(forces), cpu)


def run_method(file: SceneFile, target: int, setup: Setup) -> Record:
    """One episode of this package's method."""
    method = prepared(METHOD, file, setup)
    timed = _Timed(method.planner)
    method = dataclasses.replace(method, planner=cast(PlanningCore, timed))
    solver_seed, noise_seed = episode_seeds(target, 0)
    method.reseed(solver_seed)
    scene, options = concrete_scene(file, load_arm(setup.arm), target), setup.options(METHOD, FREE, 0.04, noise_seed)
    result = run_episode(scene, method, options)
    offsets = np.vstack([result.start_position, result.positions]) - scene.target
    settled = result.time if result.reached else None
    return _record(file, target, METHOD, settled, offsets, float(result.contact_forces.max()), timed.cpu)


class _Timed:
    """A planning core that keeps the CPU time of each plan, s."""

    def __init__(self, core: PlanningCore) -> None:
        self._core, self.cpu = core, list[float]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._core, name)

    def plan(self, request: Request) -> Plan:
        begin = time.process_time()
        plan = self._core.plan(request)
        self.cpu.append(time.process_time() - begin)
        return plan


def _send(planner: subprocess.Popen[str], message: dict[str, Any]) -> None:
    assert planner.stdin is not None
    planner.stdin.write(json.dumps(message) + "\n")
    planner.stdin.flush()


def _answer(planner: subprocess.Popen[str], method: str) -> dict[str, Any]:
    assert planner.stdout is not None
    if line := planner.stdout.readline():
        return cast(dict[str, Any], json.loads(line))
    raise ContactReachError(f"planner {method}: its process ended; expected a plan, see its message above")


def _record(
    file: SceneFile, target: int, method: str, settled: float | None, offsets: Array, force: float, cpu: list[float]
) -> Record:
    """Figures of an episode with the tip's `offsets` (T, 3) from the target, m."""
    there = np.flatnonzero(np.linalg.norm(offsets, axis=1) <= TOLERANCE)
    return {
        "scene": file.name,
        "target": target,
        "method": method,
        "time": settled,
        "peak_force": force,
        "top_speed": float(np.linalg.norm(np.diff(offsets, axis=0), axis=1).max()) / TICK,
        "entry_time": float(there[0]) * TICK if len(there) else None,
        "plan_cpu_s": float(np.median(cpu)),
    }
