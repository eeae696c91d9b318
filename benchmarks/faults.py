"""Episodes with random faults, held against bounds on force, torque and speed."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.baselines.method import Method
from benchmarks.baselines.scripted import ScriptedPlanner
from benchmarks.episode import EpisodeOptions, run_episode
from benchmarks.fault_checks import BOUNDS, LINGER, bounds_used, end_of, violations
from benchmarks.fault_draws import random_faults
from benchmarks.faulty_robot import Fault
from benchmarks.grid import Setup, prepared
from benchmarks.output import Report, command_line, given, machine, run_command, say, table, write_report
from benchmarks.paper import METHOD
from benchmarks.workers import run_each
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.settings import ControllerSettings, SupervisionSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.scene_file import read_scene

SCENES = ("free", "ball")
"""Taken in turns."""
RATES = (1000, 500, 200)
"""Of drivers' joint states, Hz, drawn."""
PLANNERS = ("small", "scripted")
"""The real one with a small budget, or one that leads the arm along its path whatever stands in the way; drawn."""
SMALL_PLANNER = PlanningSettings(population=32, max_steps=2, deadline=0.0)
"""Faults do not depend on how good the plans are."""
_WORKSPACE_MINIMUM = (-2.0, -2.0, -0.05)
"""m: the floor of the scenes is 0.1 m below the base, and the hand goes down to it before its centre does."""
_PERIOD = 0.08
_TIMEOUT = 5.0
_NEAREST = 3
"""Seeds that are listed for each bound."""
_DRIVER = 2
"""Separates the random numbers of driver and planner from those of scene (seed alone) and faults (seed, 1)."""


def fault_setup() -> Setup:
    """What all episodes have in common: everything as shipped, but for the planner's budget, and the scenes' floor."""
    controller = ControllerSettings(supervision=SupervisionSettings(workspace_minimum=_WORKSPACE_MINIMUM))
    return Setup(planning=SMALL_PLANNER, controller=controller, budget=load_budget())


def run_with_faults(seed: int, setup: Setup, faults: Sequence[Fault] | None = None) -> Report:
    """Run the episode of a seed, with its faults unless others are given; reports the end and the use of each bound."""
    random = np.random.default_rng((seed, _DRIVER))
    rate, planner = int(random.choice(RATES)), str(random.choice(PLANNERS))
    file, arm = read_scene(SCENES[seed % len(SCENES)]), load_arm(setup.arm)
    scene = make_scene(file, arm, seed)
    faults = random_faults(scene, seed) if faults is None else tuple(faults)
    options = EpisodeOptions(
        period=_PERIOD,
        rate=rate,
        settle=0.6,
        timeout=_TIMEOUT,
        linger=LINGER,
        faults=faults,
        budget=setup.budget,
        noise_seed=seed,
    )
    if planner == "scripted":
        method = Method(ScriptedPlanner(scene), setup.controller)
    else:
        # With room for a ball also where there is none: one program for all scenes.
        method = prepared(METHOD, read_scene("ball"), setup)
    method.reseed(seed)
    result = run_episode(scene, method, options)
    used = bounds_used(result, setup.controller.limits, arm, faults)
    return {
        "seed": seed,
        "scene": file.name,
        "rate": rate,
        "planner": planner,
        "faults": "; ".join(map(str, faults)),
        "end": end_of(result).value,
        "end_speed": result.end_speed,
        "reasons": result.reasons,
        "used": used,
        "violations": violations(used),
    }


def bench_faults(
    episodes: int = 200,
    seed: int = 0,
    workers: int | None = None,
    file: Path | None = None,
) -> Report:
    """Run episodes with the seeds from `seed` on, print how they ended and write JSON to `file`.

    Parameters
    ----------
    workers
        Processes, by default one per core.

    Raises
    ------
    SettingsError
        If an option is out of range.
    """
    for name, number, least in (("episodes", episodes, 1), ("seed", seed, 0)):
        if number < least:
            raise SettingsError(f"--{name} {number}: expected at least {least}")
    run = functools.partial(run_with_faults, setup=fault_setup())
    records = []
    for record in run_each(run, range(seed, seed + episodes), workers):
        records.append(record)
        say(_line(record))
    report = summary(sorted(records, key=lambda record: record["seed"]))
    print(text_of(report))
    write_report(report, file)
    return report


def summary(records: Sequence[Report]) -> Report:
    """The report on finished episodes: ends, violations of each bound, and the seeds that came nearest to it."""
    ends = Counter(record["end"] for record in records)
    bounds: Report = {}
    for bound in BOUNDS:
        shares = sorted(((record["used"][bound], record["seed"]) for record in records), reverse=True)
        bounds[bound] = {
            "violations": sum(bool(violations({bound: share})) for share, _ in shares),
            "nearest": [{"seed": seed, "share": share} for share, seed in shares[:_NEAREST]],
        }
    return {
        "bench": "faults",
        "episodes": len(records),
        "ends": dict(ends.most_common()),
        "bounds": bounds,
        "violations": [record["seed"] for record in records if record["violations"]],
        "machine": machine(),
        "records": list(records),
    }


def text_of(report: Report) -> str:
    """The summary for people."""
    ends = ", ".join(f"{end} {count}" for end, count in report["ends"].items())
    rows = [
        (
            bound,
            str(found["violations"]),
            ", ".join(f"{near['seed']} ({near['share']:.3f})" for near in found["nearest"]),
        )
        for bound, found in report["bounds"].items()
    ]
    return f"{report['episodes']} episodes: {ends}\n" + table(("bound", "violations", "nearest: seed (share)"), rows)


def _line(record: Report) -> str:
    wrong = f"; VIOLATED: {'; '.join(record['violations'])}" if record["violations"] else ""
    what = f"{record['seed']} {record['scene']}, {record['planner']}, {record['rate']} Hz: {record['faults']}"
    return f"{what}: {record['end']}{wrong}"


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns 1 if a bound was exceeded."""
    parser = command_line(__doc__, spread=True)
    parser.add_argument("--episodes", type=int, help="how many (default: 200)")
    parser.add_argument("--seed", type=int, help="of the first episode (default: 0)")
    return 1 if bench_faults(**given(parser, arguments))["violations"] else 0


if __name__ == "__main__":
    run_command(main)
