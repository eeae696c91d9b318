"""judo and plain `mujoco.rollout` beside this package: the same arm, scenes, candidates, horizon and bound on speed.

The first run makes `.venv-peers` with judo and its MuJoCo. Closed loop in simulated time, in which each plan takes
40 ms; what plans cost is CPU time. Each episode is a line of the file as soon as it has ended: the same command goes on
with what is missing.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.factors import read
from benchmarks.grid import Record, Setup
from benchmarks.output import command_line, given, run_command, say, table
from benchmarks.paper import METHOD
from benchmarks.peers_episode import run_method, run_peer
from benchmarks.statistics import estimate
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.world.scene_file import read_scene

PACKAGES = ("judo-rai==0.1.0", "mujoco==3.6.0")
PLANNERS = {METHOD: f"**{METHOD}**", "judo": "judo: CEM", "rollout": "`mujoco.rollout`: predictive sampling"}
"""Names in the table; those but the method are of `peers_runner`."""
SCENES = ("ball", "wall")
SEED = 20
"""Of the first target; the peers' settings were chosen on those from 100 on."""
TIMEOUT = 20.0
"""Simulated time to settle, s."""


def make_environment(folder: Path, packages: Sequence[str] = PACKAGES) -> Path:
    """Make an environment with packages unless it is there, and return its interpreter.

    Raises `SettingsError` if they cannot be installed.
    """
    python, stamp = folder.absolute() / "bin" / "python", folder / ".installed"
    if not stamp.is_file():
        say(f"Installing {' '.join(packages)} into {folder} ...")
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python), "install", "-q"]
        try:
            subprocess.run([sys.executable, "-m", "venv", "--clear", "--without-pip", folder], check=True)
            subprocess.run([*pip, *packages], check=True)
        except subprocess.CalledProcessError as error:
            raise SettingsError(
                f"{folder}: {' '.join(packages)} could not be installed, see pip's message above; expected a package "
                "index that has them for this Python (3.10 to 3.13): try again with a connection"
            ) from error
        stamp.touch()
    return python


def bench_peers(file: Path, targets: int = 10, scenes: Sequence[str] = SCENES) -> list[Record]:
    """Run the episodes that `file` lacks, target by target, and print the table of what it has.

    Raises
    ------
    SettingsError
        As `make_environment`, and for scenes that are not of `SCENES`.
    """
    if unknown := [name for name in scenes if name not in SCENES]:
        raise SettingsError(f"--scenes {' '.join(unknown)}: expected some of {', '.join(SCENES)}")
    python = make_environment(Path(".venv-peers"))
    setup = Setup.of("shipped", load_budget(), timeout=TIMEOUT)
    done = read(file)
    known = {(each["target"], each["scene"], each["method"]) for each in done}
    file.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        started: dict[str, subprocess.Popen[str]] = {}
        for name in (name for name in PLANNERS if name != METHOD):
            command: list[str | Path] = [python, Path(__file__).with_name("peers_runner.py"), name]
            pipe, environment = subprocess.PIPE, {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": ""}
            started[name] = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)
            stack.enter_context(started[name])
        for target, scene, method in itertools.product(range(SEED, SEED + targets), scenes, PLANNERS):
            if (target, scene, method) in known:
                continue
            if method == METHOD:
                record = run_method(read_scene(scene), target, setup)
            else:
                record = run_peer(read_scene(scene), target, setup, method, started[method])
            with file.open("a") as stream:
                stream.write(json.dumps(record) + "\n")
            done.append(record)
            say(f"{scene} {target} {method}: {record['time']} s, {record['peak_force']:.2f} N")
    print(peers_table(done))
    return done


def peers_table(records: Sequence[Record]) -> str:
    """A row in Markdown for each scene and planner, of the targets that every planner has had in the scene."""
    rows = []
    for scene in dict.fromkeys(each["scene"] for each in records):
        found = {(each["method"], each["target"]): each for each in records if each["scene"] == scene}
        targets = {target for _, target in found if all((name, target) in found for name in PLANNERS)}
        for name, title in PLANNERS.items() if targets else ():
            own = [found[name, target] for target in sorted(targets)]
            plan = float(np.median([each["plan_cpu_s"] for each in own]))
            times = [each["time"] for each in own if each["time"] is not None]
            there = sum(each["entry_time"] is not None for each in own)
            row = [scene, title, f"{1e3 * plan:.0f}", f"{1.0 / plan:.0f}", f"{there}/{len(own)}"]
            row += [f"{len(times)}/{len(own)}", _mean(times), _mean([each["peak_force"] for each in own])]
            rows.append([*row, f"{max(each['top_speed'] for each in own):.2f}"])
    header = ["scene", "planner", "plan, ms of CPU: p50", "plans/s on a core", "there", "settled"]
    return table([*header, "time, s", "peak force, N", "top speed of the tip, m/s"], rows)


def _mean(values: Sequence[float]) -> str:
    mean, low, high = estimate(values)
    return f"{mean:.2f} [{low:.2f}, {high:.2f}]" if len(values) > 1 else "–"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--targets", type=int, help="in each scene (default: 10)")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="ball, wall (default: both)")
    options = given(parser, arguments)
    bench_peers(options.pop("file", Path("benchmarks/results/peers.jsonl")), **options)


if __name__ == "__main__":
    run_command(main)
