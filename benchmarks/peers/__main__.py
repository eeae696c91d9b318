"""judo and plain `mujoco.rollout` beside this package: the same arm, scenes, candidates, horizon and bound on speed.

The first run makes `.venv-peers` with judo and its MuJoCo. Closed loop in simulated time, in which each plan takes
40 ms; what the plans cost is CPU time. Each episode is a line of the file as soon as it has ended: the same command
goes on with what is missing.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.factors import read
from benchmarks.grid import Record, Setup, concrete_scene
from benchmarks.output import command_line, given, run_command, say, table
from benchmarks.paper import METHOD
from benchmarks.peers.episode import Planner, run_method, run_peer
from benchmarks.statistics import estimate
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.world.scene_file import read_scene

PEERS = {"judo": "judo 0.1.0, CEM", "rollout": "mujoco.rollout 3.6, predictive sampling"}
"""What `runner.py` knows, and its name in the table."""
PACKAGES = ("judo-rai==0.1.0", "mujoco==3.6.0")
VENV = Path(".venv-peers")
SCENES = ("ball", "wall")
SEED = 20
"""First target; those from 100 on were used to choose the peers' settings."""
TIMEOUT = 20.0
"""Simulated time to settle, s."""


def make_environment(folder: Path, packages: Sequence[str] = PACKAGES) -> Path:
    """Make an environment with the peers unless it is there, and return its interpreter.

    Raises `SettingsError` if the packages cannot be installed.
    """
    python = folder.absolute() / "bin" / "python"
    stamp = folder / ".installed"
    if stamp.is_file():
        return python
    say(f"Installing {' '.join(packages)} into {folder} ...")
    try:
        subprocess.run([sys.executable, "-m", "venv", "--clear", "--without-pip", folder], check=True)
        pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
        subprocess.run([*pip, "--disable-pip-version-check", *packages], check=True)
    except subprocess.CalledProcessError as error:
        raise SettingsError(
            f"{folder}: {' '.join(packages)} could not be installed (see pip's message above); expected Python 3.10 to "
            "3.13 and a package index that has them: try again with a connection"
        ) from error
    stamp.touch()
    return python


def bench_peers(file: Path, targets: int = 10, scenes: Sequence[str] = SCENES) -> list[Record]:
    """Run the episodes that `file` lacks, target by target, and print the tables of what it has.

    Raises
    ------
    SettingsError
        As `make_environment`, and for scenes that are not of `SCENES`.
    """
    if unknown := [name for name in scenes if name not in SCENES]:
        raise SettingsError(f"--scenes {' '.join(unknown)}: expected some of {', '.join(SCENES)}")
    python = make_environment(VENV)
    setup = Setup.of("shipped", load_budget(), timeout=TIMEOUT)
    done = read(file)
    known = {(each["scene"], each["target"], each["method"]) for each in done}
    file.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        planners = {name: stack.enter_context(Planner(python, name)) for name in PEERS}
        for target in range(SEED, SEED + targets):
            for scene in map(read_scene, scenes):
                for method in (METHOD, *PEERS):
                    if (scene.name, target, method) in known:
                        continue
                    if method == METHOD:
                        record = run_method(scene, target, setup)
                    else:
                        concrete = concrete_scene(scene, load_arm(setup.arm), target)
                        record = run_peer(concrete, planners[method], setup)
                    with file.open("a") as stream:
                        stream.write(json.dumps(record) + "\n")
                    done.append(record)
                    say(f"{scene.name} {target} {method}: {record['time']} s, {record['peak_force']:.2f} N")
    print(peers_table(done))
    return done


def peers_table(records: Sequence[Record]) -> str:
    """One row for each scene and method, of the targets that all methods have had in the scene."""
    rows = []
    for scene in dict.fromkeys(each["scene"] for each in records):
        seen = [
            {each["target"] for each in records if (each["scene"], each["method"]) == (scene, method)}
            for method in (METHOD, *PEERS)
        ]
        common = set.intersection(*seen)
        for method in (METHOD, *PEERS):
            own = [
                each
                for each in records
                if (each["scene"], each["method"]) == (scene, method) and each["target"] in common
            ]
            if own:
                rows.append([scene, PEERS.get(method, f"**{method}**"), *_figures(own)])
    header = ["scene", "planner", "plan, ms CPU", "plans/s on a core", "settled", "first there", "time, s"]
    return table([*header, "peak force, N", "highest tip speed, m/s"], rows)


def _figures(own: Sequence[Record]) -> list[str]:
    plan = float(np.median([each["plan_cpu_s"] for each in own]))
    times = [each["time"] for each in own if each["time"] is not None]
    there = [each for each in own if each["entry_time"] is not None]
    counts = [f"{len(times)}/{len(own)}", f"{len(there)}/{len(own)}"]
    return [
        f"{1e3 * plan:.0f}",
        f"{1.0 / plan:.0f}",
        *counts,
        _mean(times),
        _mean([each["peak_force"] for each in own]),
        f"{max(each['top_speed'] for each in own):.2f}",
    ]


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
