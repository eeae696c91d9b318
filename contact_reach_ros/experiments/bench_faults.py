"""`contact-reach bench faults`: episodes in which things go wrong at random, and what becomes of them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.baselines.method import ReferenceMethod
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.settings import ImpedanceSettings, SupervisionSettings
from contact_reach_ros.experiments.episode import EpisodeOptions, EpisodeResult, run_episode
from contact_reach_ros.experiments.fault_checks import (
    LASTING_FORCE,
    TRANSIENT_FORCE,
    end_of,
    force_violations,
    speed_share,
    torque_violations,
)
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.plant.drive import WatchdogSettings
from contact_reach_ros.plant.fault_kinds import Schedule
from contact_reach_ros.plant.fault_schedules import parse_faults
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.free_path import free_path
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.overlap import overlap_depths, path_segments
from contact_reach_ros.scenes.scene import Scene
from contact_reach_ros.scenes.spheres import sphere_capacity

Array = NDArray[np.float64]

SCENES = ("free", "ball")
"""Taken in turns."""
SMALL_PLANNER = PlanningSettings(population=32, elite=8, line_search_points=16, max_steps=3, deadline=0.0)
"""What goes wrong does not depend on how good the plans are."""
_PERIOD = 0.08
_TIMEOUT = 5.0
_LINGER = 1.0
_LATEST = 2.0
"""Latest begin of a fault, s."""
_HOLD_LIMIT = 1.0
_RADIUS = 0.05
"""Of an obstacle, m."""
_CLEARANCE = 0.02
"""Of an obstacle from the arm when it appears, m."""
_FAULTS = 1
"""Tells the random numbers of the faults from those of the scene."""

Draw = Callable[[np.random.Generator, Scene], str]


def _uniform(low: float, high: float) -> Callable[[np.random.Generator], float]:
    return lambda random: float(random.uniform(low, high))


def _log(low: float, high: float) -> Callable[[np.random.Generator], float]:
    return lambda random: float(np.exp(random.uniform(np.log(low), np.log(high))))


def _joint(random: np.random.Generator) -> str:
    return str(random.choice(iiwa14.JOINT_NAMES))


def _direction(random: np.random.Generator) -> Array:
    drawn = random.standard_normal(3)
    return drawn / np.linalg.norm(drawn)


def _push(random: np.random.Generator, _: Scene) -> str:
    x, y, z = random.uniform(5.0, 150.0) * _direction(random)
    link = random.choice(iiwa14.LINK_NAMES[2:])
    return f'push link={link} force="{x:.1f} {y:.1f} {z:.1f}" for={random.uniform(0.02, 0.5):.3f}'


def _obstacle(random: np.random.Generator, scene: Scene) -> str:
    """Somewhere on the way of the hand, but not in the arm where it starts."""
    model = RobotModel()
    path = free_path(model, scene.start, scene.target)
    starts, ends = path_segments(scene.start[None])
    if path is not None:
        for _ in range(50):
            place, _ = model.flange_pose(path[int(random.uniform(0.3, 1.0) * (len(path) - 1))])
            place = place + random.uniform(0.0, 0.08) * _direction(random)
            if overlap_depths(starts, ends, place[None], _RADIUS).max() < -_CLEARANCE:
                position = " ".join(f"{value:.3f}" for value in place)
                # From the beginning: later it might appear inside the arm, as nothing real does.
                return f'obstacle position="{position}" radius={_RADIUS} stiffness={_log(500, 20000)(random):.0f} at=0'
    return "friction factor=2"


DRAWS: dict[str, Draw] = {
    "drop_commands": lambda random, _: f"drop_commands share={random.uniform(0.1, 1.0):.2f}",
    "delay_commands": lambda random, _: f"delay_commands delay={_log(0.001, 0.1)(random):.4f}",
    "duplicate_commands": lambda random, _: f"duplicate_commands after={random.uniform(0.0, 0.1):.3f}",
    "nan_commands": lambda random, _: f"nan_commands share={random.uniform(0.01, 1.0):.2f}",
    "drop_states": lambda random, _: f"drop_states share={random.uniform(0.1, 1.0):.2f}",
    "delay_states": lambda random, _: f"delay_states delay={_log(0.001, 0.1)(random):.4f}",
    "duplicate_states": lambda random, _: f"duplicate_states after={random.uniform(0.0, 0.05):.3f}",
    "nan_states": lambda random, _: (
        f"nan_states share={random.uniform(0.01, 1.0):.2f} "
        f"field={random.choice(['position', 'velocity', 'effort'])} joint={_joint(random)}"
    ),
    "velocity_noise": lambda random, _: f"velocity_noise deviation={_log(0.01, 2.0)(random):.3f}",
    "stuck_encoder": lambda random, _: (
        f"stuck_encoder joint={_joint(random)} velocity={random.choice(['zero', 'true'])}"
    ),
    "torque_sensor": lambda random, _: (
        f"torque_sensor joint={_joint(random)} gain={random.choice([-1, 0, 1])} bias={random.uniform(-40, 40):.1f}"
    ),
    "payload": lambda random, _: f"payload mass={random.uniform(0.2, 10.0):.2f}",
    "friction": lambda random, _: f"friction factor={_log(0.1, 20.0)(random):.2f}",
    "foam": lambda random, _: f"foam factor={_log(0.3, 5.0)(random):.2f}",
    "obstacle": _obstacle,
    "push": _push,
    "clock_jump": lambda random, _: f"clock_jump step={random.choice([-1, 1]) * _log(0.002, 20.0)(random):.3f}",
    "planner_silent": lambda *_: "planner_silent",
    "observer_silent": lambda *_: "observer_silent",
    "controller_silent": lambda *_: "controller_silent",
    "late_plans": lambda random, _: f"late_plans delay={random.uniform(0.02, 0.6):.3f}",
}
"""How the keys of each kind are drawn, except when it begins and how long it lasts."""


def random_schedule(scene: Scene, seed: int) -> Schedule:
    """One to three different faults."""
    random = np.random.default_rng((seed, _FAULTS))
    kinds = random.choice(list(DRAWS), size=random.integers(1, 4), replace=False)
    parts = []
    for kind in kinds:
        text = DRAWS[str(kind)](random, scene)
        if " at=" not in text:
            text += f" at={random.uniform(0.0, _LATEST):.3f}"
        if " for=" not in text and random.random() < 0.5:
            text += f" for={_log(0.005, 2.0)(random):.3f}"
        parts.append(text)
    return parse_faults("; ".join(parts))


@dataclass(frozen=True)
class FaultEpisode:
    """One random episode: what went wrong, what became of it, and what may not have been."""

    seed: int
    scene: str
    schedule: Schedule
    result: EpisodeResult
    violations: list[str]

    def record(self) -> dict[str, Any]:
        """As JSON has it."""
        forces = self.result.contact_forces
        return {
            "seed": self.seed,
            "scene": self.scene,
            "faults": "; ".join(fault.text() for fault in self.schedule),
            "end": end_of(self.result).value,
            "reasons": self.result.reasons,
            "contact_force": float(forces.max()) if len(forces) else 0.0,
            "speed_share": speed_share(self.result),
            "violations": self.violations,
        }


class RandomFaults:
    """Runs random episodes; planners are compiled once for each kind of scene."""

    def __init__(self) -> None:
        self._planners: dict[str, RecedingHorizonPlanner] = {}
        self._controller = ControllerSettings(supervision=SupervisionSettings(hold_limit=_HOLD_LIMIT))

    def run(self, seed: int) -> FaultEpisode:
        """The episode of a seed, which says everything about it."""
        file = read_scene(SCENES[seed % len(SCENES)])
        scene = make_scene(file, seed)
        if file.name not in self._planners:
            self._planners[file.name] = RecedingHorizonPlanner(
                SMALL_PLANNER, ImpedanceSettings(), load_budget().permitted_force, sphere_capacity(file)
            )
        planner = self._planners[file.name]
        planner.reseed(seed)
        schedule = random_schedule(scene, seed)
        options = EpisodeOptions(
            period=_PERIOD,
            settle=0.6,
            timeout=_TIMEOUT,
            linger=_LINGER,
            faults=schedule,
            watchdog=WatchdogSettings(),
            budget=load_budget(),
            noise_seed=seed,
        )
        result = run_episode(scene, ReferenceMethod(planner, self._controller), options)
        violations = torque_violations(result, self._controller.limits) + force_violations(result)
        return FaultEpisode(seed, file.name, schedule, result, violations)


def bench_faults(episodes: int, seed: int, file: Path | None) -> dict[str, Any]:
    """Run episodes with the seeds from `seed` on, print what became of them and write JSON to `file`."""
    runs = RandomFaults()
    records = []
    for number in range(seed, seed + episodes):
        record = runs.run(number).record()
        records.append(record)
        wrong = f"; VIOLATED: {'; '.join(record['violations'])}" if record["violations"] else ""
        print(f"{number} {record['scene']}: {record['faults']}: {record['end']}{wrong}", flush=True)
    ends = Counter(record["end"] for record in records)
    by_kind: dict[str, Counter[str]] = {}
    for record in records:
        for fault in _kinds(record["faults"]):
            by_kind.setdefault(fault, Counter())[record["end"]] += 1
    report: dict[str, Any] = {
        "episodes": episodes,
        "ends": dict(ends),
        "shares": {end: count / max(episodes, 1) for end, count in ends.items()},
        "largest_force": max((record["contact_force"] for record in records), default=0.0),
        "bounds": {"transient_force": TRANSIENT_FORCE, "lasting_force": LASTING_FORCE},
        "violations": [record["seed"] for record in records if record["violations"]],
        "too_fast": [record["seed"] for record in records if record["speed_share"] > 1.0],
        "by_kind": {kind: dict(counts) for kind, counts in sorted(by_kind.items())},
        "machine": machine(),
        "records": records,
    }
    print(f"{episodes} episodes: " + ", ".join(f"{end} {count}" for end, count in ends.most_common()))
    print(f"largest contact force {report['largest_force']:.0f} N")
    print(f"a joint faster than its limit, seeds: {_listed(report['too_fast'])}")
    print(f"torques or contact forces beyond their bounds, seeds: {_listed(report['violations'])}")
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")
    return report


def _kinds(faults: str) -> list[str]:
    return [fault.KIND for fault in parse_faults(faults)]


def _listed(seeds: list[int]) -> str:
    return ", ".join(map(str, seeds)) or "none"
