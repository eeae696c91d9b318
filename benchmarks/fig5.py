"""The paper's Fig. 5: the contact force over time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.baselines.methods import METHODS
from benchmarks.episode import run_episode
from benchmarks.episode_result import EpisodeResult
from benchmarks.grid import Setup, concrete_scene, episode_seeds, prepared
from benchmarks.metrics import measure
from benchmarks.output import Report, command_line, given, machine, run_command, say, table, write_report
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.world.scene_file import read_scene

_DIGITS = 4


@dataclass(frozen=True)
class Fig5:
    """What is run.

    Attributes
    ----------
    methods
        Some of `METHODS`.
    scene
        Name or YAML file.
    seed
        Of target and obstacles; with repeat 0 of a table, it seeds solver and noise.
    latency
        Of the plans, s: a constant, so that the figure does not depend on the machine.

    Raises
    ------
    SettingsError
        If a method is unknown, or a value is out of range.
    """

    methods: tuple[str, ...] = ("contact_reach", "reference_posture")
    scene: str = "wall"
    seed: int = 0
    latency: float = 0.04

    def __post_init__(self) -> None:
        for method in self.methods:
            if method not in METHODS:
                raise SettingsError(f"--methods '{method}' is unknown; expected one of {', '.join(METHODS)}")
        if self.seed < 0:
            raise SettingsError(f"--seed {self.seed}: expected at least 0")
        if not 0.001 <= self.latency <= 1.0:
            raise SettingsError(f"--latency {self.latency:g}: expected 0.001 to 1 s")


def bench_fig5(bench: Fig5, file: Path | None, setup: Setup | None = None) -> Report:
    """Run every method with the orientation of the start held, print a table and write JSON to `file`.

    The JSON holds the force on the body that is pressed hardest, N, after each tick; `benchmarks.pictures` draws it.

    Raises
    ------
    SceneError
        If the scene cannot be made.
    """
    setup = setup or Setup(budget=load_budget())
    scene_file = read_scene(bench.scene)
    scene = concrete_scene(scene_file, load_arm(setup.arm), bench.seed)
    solver_seed, noise_seed = episode_seeds(bench.seed, repeat=0)
    permitted = setup.budget.permitted_force
    report: Report = {
        "bench": "fig5",
        "options": dataclasses.asdict(bench),
        "machine": machine(),
        "permitted_force_N": permitted,
        "tick_s": TICK,
        "methods": {},
    }
    for name in bench.methods:
        method = prepared(name, scene_file, setup)
        method.reseed(solver_seed)
        result = run_episode(scene, method, setup.options(name, "hold", bench.latency, noise_seed))
        metrics = measure(result, scene.target, setup.planning, setup.controller.impedance, permitted)
        report["methods"][name] = {
            "outcome": outcome(result),
            "episode": dataclasses.asdict(metrics),
            "profile_N": np.round(result.contact_forces, _DIGITS).tolist(),
        }
        say(f"{scene.name}, {name}: {outcome(result)}")
    write_report(report, file)
    rows = [
        [name, found["outcome"], f"{found['episode']['contact_impulse']:.2f}"]
        for name, found in report["methods"].items()
    ]
    print(table(["method", "time, largest force", "impulse [N s]"], rows))
    return report


def outcome(result: EpisodeResult) -> str:
    """Time and largest force in a few words."""
    if result.failure:
        return "no path found"
    force = f"{result.contact_forces.max(initial=0.0):.1f} N"
    if result.reached:
        return f"{result.time:.2f} s, {force}"
    return f"{'stopped' if result.stop_reason else 'not reached'}, {force}"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scene", help="a name or a YAML file (default: wall)")
    methods = "as for table1 (default: contact_reach reference_posture)"
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help=methods)
    parser.add_argument("--seed", type=int, help="of the target and the obstacles (default: 0)")
    parser.add_argument("--latency", type=float, metavar="SECONDS", help="time of a plan (default: 0.04)")
    options = given(parser, arguments)
    file = options.pop("file", None)
    bench_fig5(Fig5(**options), file)


if __name__ == "__main__":
    run_command(main)
