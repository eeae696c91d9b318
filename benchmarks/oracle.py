"""What a random scene asks for, before any method is run in it: no contact, contact within ε, or more than that.

Postures at the goal come from inverse kinematics, paths between the start and all of them from RRT-Connect (Kuffner and
LaValle, 2000) in joint space. Along a path no link may press harder than a limit: zero for a free way, ε for a tolerant
one. The force is that of an arm at rest, from how deep it is in soft bodies that stay where they are; the arm meets no
rigid body and not itself. Free ways are searched for longer than tolerant ones, so that few scenes count as in need of
contact that are not.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baselines.rrt_star import path_length
from benchmarks.clutter_scenes import clutter_scene
from benchmarks.output import command_line, given, run_command, say, table
from benchmarks.workers import run_each
from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.paths import Statics, connect
from contact_reach_ros.resources import write_text
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

GOAL_SEEDS = 2048
"""From which inverse kinematics looks for postures at the goal, a quarter of them near the start."""
MARGIN = 0.005
"""Distance of the postures from the joints' limits, rad."""
SEARCHES = {"free": 6, "tolerant": 3}
"""RRT-Connect from scratch, until one finds a path."""
ITERATIONS = 400
"""Of each."""

_MAX_GOALS = 60
_NEAR_START = 0.6
_STREAM = 31


class Kind(Enum):
    """What a scene asks for."""

    FREE = "free"
    """There is a way without contact."""
    CONTACT = "contact"
    """There is a way within ε, and none without contact was found."""
    BEYOND = "beyond"
    """No posture at the goal keeps within ε."""
    UNDECIDED = "undecided"
    """There are such postures, and no way to them was found."""


@dataclass(frozen=True)
class Verdict:
    """What the oracle found in a scene.

    Attributes
    ----------
    seed
        Of the scene.
    kind
        What it asks for.
    free_goals, tolerant_goals
        Postures at the goal without contact, and within ε.
    least_force
        Of all postures at the goal, N; NaN without one.
    path_force
        Largest along the path that was found, N; NaN without one.
    path_length
        Of it, rad.
    """

    seed: int
    kind: Kind
    free_goals: int
    tolerant_goals: int
    least_force: float
    path_force: float = float("nan")
    path_length: float = float("nan")


def classify(arm: Arm, scene: Scene, permitted_force: float) -> Verdict:
    """What a scene asks for; the same for the same scene, on any machine."""
    random = np.random.default_rng((_STREAM, scene.seed))
    target = scene.goal.resolve(arm, RobotModel(arm).tip_pose(scene.start)[1])
    spheres = obstacle_spheres(scene, rest_positions(scene))
    statics = Statics(arm, spheres, scene.start, target)
    near = scene.start + _NEAR_START * random.standard_normal((GOAL_SEEDS // 4, arm.n))
    seeds = np.concatenate([near, random.uniform(arm.lower, arm.upper, (GOAL_SEEDS - len(near), arm.n))])
    goals = solve_ik(arm, target.position, target.rotation, seeds, MARGIN)
    goals = goals[statics.free(goals)] if len(goals) else goals
    forces = statics.forces(goals) if len(goals) else np.zeros(0)
    order = np.argsort(np.linalg.norm(goals - scene.start, axis=1), kind="stable")
    within = {name: [i for i in order if forces[i] <= limit] for name, limit in _limits(permitted_force).items()}
    least = float(forces.min()) if len(forces) else float("nan")
    found = Verdict(scene.seed, Kind.UNDECIDED, len(within["free"]), len(within["tolerant"]), least)
    if not within["tolerant"]:
        return dataclasses.replace(found, kind=Kind.BEYOND)
    for kind, (name, limit) in zip((Kind.FREE, Kind.CONTACT), _limits(permitted_force).items(), strict=True):
        if not within[name]:
            continue
        chosen = goals[[*within[name][: _MAX_GOALS // 2], *random.permutation(within[name])[: _MAX_GOALS // 2]]]
        for _ in range(SEARCHES[name]):
            path, _ = connect(statics, chosen, limit, MARGIN, ITERATIONS, random)
            if path is not None:
                peak = max(statics.reach(a, b, np.inf)[1] for a, b in itertools.pairwise(path))
                return dataclasses.replace(found, kind=kind, path_force=peak, path_length=path_length(path))
    return found


def seeds_of(kind: str, seed: int, scenes: int) -> list[int]:
    """The first `scenes` seeds, from `seed` on, whose scenes are of a kind; a scene takes up to a second."""
    verdicts = map(_classify_seed, itertools.count(seed))
    return [each.seed for each in itertools.islice((each for each in verdicts if each.kind is Kind(kind)), scenes)]


def _classify_seed(seed: int) -> Verdict:
    arm = load_arm()
    return classify(arm, make_scene(clutter_scene(arm, seed), arm, seed), load_budget().permitted_force)


def _limits(permitted_force: float) -> dict[str, float]:
    return {"free": 0.0, "tolerant": permitted_force}


def sorted_out(file: Path, kind: str, scenes: int) -> list[int]:
    """The first `scenes` seeds of a kind in a file of `bench_oracle`.

    Raises `SettingsError` if it cannot be read or has fewer.
    """
    try:
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        found = sorted(line["seed"] for line in lines if line["kind"] == kind)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SettingsError(f"--oracle {file}: {error}; expected what benchmarks.oracle --json wrote") from error
    if len(found) < scenes:
        raise SettingsError(f"--oracle {file} has {len(found)} scenes of kind {kind}; expected {scenes}: sort out more")
    return found[:scenes]


def bench_oracle(
    seed: int = 0, scenes: int = 100, file: Path | None = None, workers: int | None = None
) -> list[dict[str, Any]]:
    """Classify scenes of the clutter, print how many are of each kind, and write a line for each to `file`.

    Raises `SettingsError` if an option is out of range.
    """
    if seed < 0 or scenes < 1:
        raise SettingsError(f"--seed {seed} --scenes {scenes}: expected at least 0 and 1")
    done: list[dict[str, Any]] = []
    for verdict in run_each(_classify_seed, range(seed, seed + scenes), workers):
        done.append({**vars(verdict), "kind": verdict.kind.value})
        say(f"{verdict.seed}: {verdict}")
    done.sort(key=lambda each: each["seed"])
    if file is not None:
        write_text(file, "".join(json.dumps(each) + "\n" for each in done))
    print(kinds_table(done))
    return done


def kinds_table(verdicts: Sequence[dict[str, Any]]) -> str:
    """How many scenes are of each kind, and their seeds."""
    counts = Counter(each["kind"] for each in verdicts)
    seeds = {kind: " ".join(str(each["seed"]) for each in verdicts if each["kind"] == kind) for kind in counts}
    rows = [[kind.value, str(counts[kind.value]), seeds.get(kind.value, "")] for kind in Kind]
    return table(["kind", "scenes", "seeds"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__, spread=True)
    parser.add_argument("--seed", type=int, help="of the first scene; below 10000 for tuning (default: 0)")
    parser.add_argument("--scenes", type=int, help="how many (default: 100)")
    bench_oracle(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
