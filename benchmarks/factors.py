"""Which difference from the authors' code makes what: cost, delay of plans and detours apart.

The costs are crossed with delays and detours in the authors' slalom and our wall, and compared alone, with delay and
detours as shipped, in the other scenes. Everything else is as shipped, but goals are of a position only, as theirs; the
slalom has no via point: finding the way is part of the task. Episodes run in simulated time with a fixed number of
solver steps. Each is a line of the file as soon as it has ended: the same command goes on with what is missing.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.authors_cost import AuthorsSettings
from benchmarks.grid import DEADLINE_STEPS, Cell, EpisodeTask, Record, Setup, run_cell
from benchmarks.output import command_line, given, run_command, say, table
from benchmarks.paper import METHOD
from benchmarks.statistics import Estimate, estimate
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.planner import ReplanningSettings
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.scene_file import SceneFile, read_scene

_ALL_CONTACT_FREE = {"contact_limit_weight": 0.0, "contact_weight": 0.0, "contact_patience": 0.0}
COSTS: dict[str, dict[str, Any]] = {
    "shipped": {},
    "hinge": {"contact_weight": 0.0, "contact_patience": 0.0},
    "linear": {"contact_limit_weight": 0.0, "contact_weight": 5.0, "contact_patience": 0.0},
    "paper_code": {
        **_ALL_CONTACT_FREE,
        "goal_weight": 0.0,
        "progress_weight": 0.0,
        "terminal_weight": 3.0,
        "contact_squared_weight": 5e-6,
    },
}
"""Settings of the planner by cost. The authors charge contact velocities of bodies with unit inertias. Their weight of
10 is translated so that an arm that is blocked, pressing as hard as γ lets it, pays the same share of what a plan could
gain: 0.23. A metre at the end of a plan costs as much as one at each of the three knots of the others."""
DELAYS = (0.0, 0.04, 0.47)
"""Time from a state to the effect of its plan, s; plans begin every 30 ms, or as the last one takes effect."""
SHIPPED = ("shipped", 0.04, True)
CROSSED, ALONE = ("slalom", "wall"), ("authors_ball", "ball", "plant")
TIMEOUT, SLOW_TIMEOUT = 30.0, 90.0
"""Simulated time to reach the goal, s, and where plans take 0.47 s."""
TIMEOUTS = {"slalom": 60.0}
"""Where the way takes longer."""
_LEAST_DELAY = 0.001
_SPREAD = (0.03, 0.1, 0.1)
"""How far the targets in scenes with a given one are from it at most, m: that of target 0 is the given one."""


class Factors(NamedTuple):
    """One combination of the factors."""

    cost: str
    delay: float
    detours: bool

    def setup(self, scene: str) -> Setup:
        """Its settings in a scene."""
        kind = AuthorsSettings if self.cost == "paper_code" else PlanningSettings
        planning = kind(deadline=0.0, max_steps=DEADLINE_STEPS, **COSTS[self.cost])
        if not self.detours:
            planning = dataclasses.replace(planning, detour_patience=0.0)
        latency = max(self.delay, _LEAST_DELAY)
        is_slow = self.delay > SHIPPED[1]
        replanning = ReplanningSettings(period=self.delay if is_slow else ReplanningSettings().period, latency=latency)
        timeout = SLOW_TIMEOUT if is_slow else TIMEOUTS.get(scene, TIMEOUT)
        return Setup(planning=planning, replanning=replanning, budget=load_budget(), timeout=timeout)


@functools.cache
def scene_of(name: str, target: int) -> SceneFile:
    """The scene of a target; where a file gives the target, others are drawn around it."""
    file = read_scene(name)
    if file.target.position is None or target == 0:
        return file
    shift = np.random.default_rng(target).uniform(-1.0, 1.0, 3) * _SPREAD
    position = tuple((np.array(file.target.position) + shift).tolist())
    return dataclasses.replace(file, target=dataclasses.replace(file.target, position=position))


def episodes(targets: int) -> Iterator[tuple[str, int, Factors]]:
    """Scene, target and factors of each episode, target by target."""
    crossed = [Factors(*each) for each in itertools.product(COSTS, DELAYS, (False, True))]
    alone = [Factors(cost, *SHIPPED[1:]) for cost in COSTS]
    for target in range(targets):
        for scene, combinations in [(name, crossed) for name in CROSSED] + [(name, alone) for name in ALONE]:
            yield from ((scene, target, each) for each in combinations)


def run_episode_of(scene: str, target: int, factors: Factors) -> Record:
    """The record of one episode."""
    cell = Cell(scene, "free", METHOD, target)
    setup = factors.setup(scene)
    record = run_cell(EpisodeTask(cell, scene_of(scene, target), setup.latency(METHOD), setup))
    return {**record, **factors._asdict(), "timeout": setup.timeout}


def bench_factors(
    file: Path, targets: int = 10, minutes: float = float("inf"), scenes: Sequence[str] = (*CROSSED, *ALONE)
) -> list[Record]:
    """Run the episodes that `file` lacks, and print the tables of what it has.

    Parameters
    ----------
    file
        A line of JSON for each episode; it is made or extended.
    targets
        Number of targets in each scene.
    minutes
        Time after which no other episode begins.
    scenes
        Which of them.
    """
    end = time.monotonic() + 60.0 * minutes
    done = read(file)
    known = {(each["scene"], each["target"], Factors(each["cost"], each["delay"], each["detours"])) for each in done}
    file.parent.mkdir(parents=True, exist_ok=True)
    for scene, target, factors in episodes(targets):
        if scene not in scenes or (scene, target, factors) in known or time.monotonic() > end:
            continue
        record = run_episode_of(scene, target, factors)
        with file.open("a") as stream:
            stream.write(json.dumps(record) + "\n")
        done.append(record)
        say(f"{scene} {target} {factors}: {record['success']}, {record['time']} s, {record['max_contact_force']} N")
    print(effects_tables(done))
    return done


def read(file: Path) -> list[Record]:
    """The episodes of a file; none if there is no such file."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []


FIGURES: dict[str, Callable[[Record], float]] = {
    "success, %": lambda record: 100.0 * record["success"],
    "settled, %": lambda record: 100.0 * record["reached"],
    "peak force, N": lambda record: record["max_contact_force"] or 0.0,
    "time, s": lambda record: record["time"] if record["time"] is not None else record["timeout"],
}
"""What the tables show; the time of a goal that was not reached is the limit."""


def effects_tables(records: Sequence[Record]) -> str:
    """Tables in Markdown: the mean of each level, and its difference from the shipped one, by scene."""
    parts = []
    for scene, own in by_scene(records).items():
        rows = [
            [factor, str(level), *[_text(effect(own, factor, level, figure)) for figure in FIGURES.values()]]
            for factor, level in levels(own)
        ]
        parts.append(f"{scene}, {len({record['target'] for record in own})} targets, {len(own)} episodes:\n")
        parts.append(table(["factor", "level", *FIGURES], rows) + "\n")
    return "\n".join(parts)


def by_scene(records: Sequence[Record]) -> dict[str, list[Record]]:
    """The episodes of the targets that have all combinations, by scene."""
    scenes = dict.fromkeys(record["scene"] for record in records)
    return {scene: complete([record for record in records if record["scene"] == scene]) for scene in scenes}


def levels(records: Sequence[Record]) -> list[tuple[str, Any]]:
    """Each level of the factors that differ, that of the shipped planner first."""
    found = []
    for factor, base in zip(Factors._fields, SHIPPED, strict=True):
        own = dict.fromkeys(record[factor] for record in records)
        found += [(factor, level) for level in sorted(own, key=lambda each: each != base)] if len(own) > 1 else []
    return found


def complete(records: Sequence[Record]) -> list[Record]:
    """The episodes of the targets that have all combinations."""
    count: dict[int, int] = {}
    for record in records:
        count[record["target"]] = count.get(record["target"], 0) + 1
    return [record for record in records if count[record["target"]] == max(count.values())]


def effect(
    records: Sequence[Record], factor: str, level: object, figure: Callable[[Record], float]
) -> tuple[Estimate, Estimate | None]:
    """Mean of a level over all other factors, and its difference from the shipped one, with intervals over targets."""

    def means(wanted: object) -> dict[int, float]:
        values: dict[int, list[float]] = {}
        for record in records:
            if record[factor] == wanted:
                values.setdefault(record["target"], []).append(figure(record))
        return {target: float(np.mean(each)) for target, each in values.items()}

    base = SHIPPED[Factors._fields.index(factor)]
    own, reference = means(level), means(base)
    mean = estimate(list(own.values()))
    return mean, None if level == base else estimate([own[target] - reference[target] for target in own])


def _text(found: tuple[Estimate, Estimate | None]) -> str:
    mean, difference = found
    text = f"{mean.mean:.2f}"
    return (
        text if difference is None else f"{text}, {difference.mean:+.2f} [{difference.low:.2f}, {difference.high:.2f}]"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--targets", type=int, help="in each scene (default: 10)")
    parser.add_argument("--minutes", type=float, help="after which no other episode begins (default: no limit)")
    parser.add_argument("--scenes", nargs="+", choices=(*CROSSED, *ALONE), help="(default: all)")
    options = given(parser, arguments)
    bench_factors(options.pop("file", Path("benchmarks/results/factors.jsonl")), **options)


if __name__ == "__main__":
    run_command(main)
