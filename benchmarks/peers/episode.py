"""Episodes in the plant of this package, with its method and with the planners of other projects."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

import numpy as np

from benchmarks.episode import STILL, run_episode
from benchmarks.grid import PATIENCE, Record, Setup, concrete_scene, episode_seeds, prepared
from benchmarks.paper import METHOD
from benchmarks.peers.model import episode_settings, servo_gains
from contact_reach_ros.arm import Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalProgress
from contact_reach_ros.planning.plan import Plan, PlanningCore, Request
from contact_reach_ros.simulation.plant import TICK, TICK_NS, Actuation, Plant
from contact_reach_ros.simulation.settings import JointSettings
from contact_reach_ros.world.goal import FREE, TOLERANCE, Goal, Target
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import SceneFile

_PLAN_TICKS = 40
"""From a state to the effect of its plan, and to the next plan."""
_RUNNER = Path(__file__).with_name("runner.py")


class Planner:
    """Another project's planner in a process of its own."""

    def __init__(self, python: Path, method: str) -> None:
        """Start it under an interpreter; `method` as in `runner.py`."""
        self.name = method
        self._process = subprocess.Popen(
            [python, _RUNNER, method],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": ""},
        )

    def begin(self, settings: dict[str, Any]) -> None:
        """Begin an episode with `episode_settings`."""
        self._send(settings)

    def plan(self, now: float, data: Any) -> dict[str, Any]:
        """Times, s, of `knots` (N, n), rad, and `cpu_s` of the search, for the state in MuJoCo's data."""
        self._send({"time": now, "qpos": data.qpos.tolist(), "qvel": data.qvel.tolist()})
        assert self._process.stdout is not None
        answer = self._process.stdout.readline()
        if not answer:
            raise ContactReachError(f"planner {self.name}: its process ended; expected a plan, see its error above")
        return cast(dict[str, Any], json.loads(answer))

    def _send(self, message: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(message) + "\n")
        self._process.stdin.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._process.terminate()
        self._process.wait()


def run_peer(scene: Scene, planner: Planner, setup: Setup) -> Record:
    """One episode: servos follow the planner's knots, interpolated, and carry the arm's weight."""
    planner.begin(episode_settings(scene, setup.planning, setup.budget.permitted_force))
    plant, arm = Plant(scene, JointSettings()), slice(0, scene.arm.n)
    plant.set_actuation(Actuation.COMMANDED)
    stiffness, damping = servo_gains(scene.arm)
    data, progress, target = plant.data, GoalProgress(Goal(scene.target, FREE)), Target(scene.target)
    times, knots, coming = np.zeros(1), scene.start[None], None
    positions, joints, forces, cpu = [plant.tip_position], [], [], []
    while plant.time < setup.timeout and progress.state.phase is not GoalPhase.SETTLED:
        if plant.steps % _PLAN_TICKS == 0:
            if coming is not None:
                times, knots = np.array(coming["times"]), np.array(coming["knots"])
            coming = planner.plan(plant.time, data)
            cpu.append(coming["cpu_s"])
        reference = np.array([np.interp(plant.time, times, column) for column in knots.T])
        plant.step(stiffness * (reference - data.qpos[arm]) - damping * data.qvel[arm] + data.qfrc_bias[arm])
        positions.append(plant.tip_position)
        joints.append(plant.joint_positions)
        forces.append(float(plant.contact_forces().max()))
        speed = float(np.linalg.norm(positions[-1] - positions[-2])) / TICK
        progress.update(target, positions[-1], np.eye(3), speed, plant.steps * TICK_NS)
        patience = round(PATIENCE / TICK)
        if len(joints) % patience == 0 and np.ptp(joints[-patience:], axis=0).max() < STILL:
            break
    settled = progress.state.phase is GoalPhase.SETTLED
    return _record(planner.name, scene, plant.time if settled else None, np.array(positions), np.array(forces), cpu)


def run_method(file: SceneFile, target: int, setup: Setup) -> Record:
    """One episode of this package's method."""
    scene = concrete_scene(file, load_arm(setup.arm), target)
    method = prepared(METHOD, file, setup)
    solver_seed, noise_seed = episode_seeds(target, 0)
    timed = _Timed(method.planner)
    method = dataclasses.replace(method, planner=cast(PlanningCore, timed))
    method.reseed(solver_seed)
    options = setup.options(METHOD, FREE, _PLAN_TICKS * TICK, noise_seed)
    result = run_episode(scene, method, options)
    time_s = result.time if result.reached else None
    positions = np.vstack([result.start_position, result.positions])
    return _record(METHOD, scene, time_s, positions, result.contact_forces, timed.cpu)


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


def _record(
    method: str, scene: Scene, time_s: float | None, positions: Array, forces: Array, cpu: list[float]
) -> Record:
    distances = np.linalg.norm(positions - scene.target, axis=1)
    there = np.flatnonzero(distances <= TOLERANCE)
    return {
        "scene": scene.name,
        "target": scene.seed,
        "method": method,
        "time": time_s,
        "peak_force": float(forces.max()),
        "top_speed": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).max()) / TICK,
        "entry_time": float(there[0]) * TICK if len(there) else None,
        "end_error": float(distances[-1]),
        "plans": len(cpu),
        "plan_cpu_s": float(np.median(cpu)),
    }
