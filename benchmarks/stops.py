"""How fast and how far an arm sinks in a compliant stop when its model does not fit it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.output import Report, command_line, given, machine, percentiles, run_command, say, table, write_report
from benchmarks.workers import run_each
from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.supervisor import STOP_TIME
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.simulation.robot import STOP_AFTER, SimulatedRobot
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.collision import nearest
from contact_reach_ros.world.rigid import Plane
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene

SCENES = ("ball_mismatch",)
"""`wall_mismatch` has the same mismatch."""
WATCHED = 5.0
"""Time after the stop, s."""
SPEED, TRAVEL, BRAKED = 0.02, 0.01, STOP_TIME + STOP_AFTER
"""Wanted of the fastest joint, rad/s, of the tip, m, and of the time until the drive's brakes close, s."""

_HELD = 1.5
"""Before the stop, s: the arm is handed over, and the observer's baseline has taken what the model lacks."""
_FROM_LIMITS = 0.1
"""Least distance of a posture from the joint limits, rad."""
_CLEARANCE = 0.02
"""Of a posture from the floor and from the arm itself, m."""
_FLOOR = (Plane("floor", (0.0, 0.0, 0.0)),)


def random_posture(arm: Arm, seed: int) -> Array:
    """Joint angles (n,), rad, anywhere within the limits where the arm touches neither the floor nor itself."""
    random = np.random.default_rng(seed)
    while True:
        q = random.uniform(np.array(arm.lower) + _FROM_LIMITS, np.array(arm.upper) - _FROM_LIMITS)
        if nearest(arm, q[None], _FLOOR)[0].distance > _CLEARANCE:
            return q


def stop_at_rest(case: tuple[str, int]) -> Report:
    """Hold the arm of a scene's mismatch in the posture of a seed, stop it, and watch it."""
    name, seed = case
    arm = load_arm()
    scene = Scene(name, arm, seed, random_posture(arm, seed), np.zeros(3), mismatch=read_scene(name).mismatch)
    robot = SimulatedRobot(scene, noise_seed=seed)
    stack = Stack(scene, robot=robot, seed=seed)
    stack.settle(_HELD)
    early = stack.stop_reason
    stack.stop()
    model, plant = stack.controller.model, robot.plant
    start, _ = model.tip_pose(plant.data.qpos[: arm.n])
    began, speed, travel, braked = plant.time, 0.0, 0.0, float("nan")
    while plant.time < began + WATCHED:
        stack.step()
        if math.isnan(braked) and robot.stop_reason:
            braked = plant.time - began
        speed = max(speed, float(np.abs(plant.data.qvel[: arm.n]).max()))
        travel = max(travel, float(np.linalg.norm(model.tip_pose(plant.data.qpos[: arm.n])[0] - start)))
    return {
        "scene": name,
        "seed": seed,
        "speed": speed,
        "travel": travel,
        "braked": braked,
        "mode": stack.controller.mode.value,
        "stopped early": early,
        "reason": stack.stop_reason,
    }


def bench_stops(
    postures: int = 200,
    scenes: Sequence[str] = SCENES,
    workers: int | None = None,
    file: Path | None = None,
) -> Report:
    """Stop the arm in random postures of each scene, print a table and write JSON to `file`.

    `workers`: processes, by default one per core.

    Raises
    ------
    SettingsError
        If there is not at least one posture.
    """
    if postures < 1:
        raise SettingsError(f"--postures {postures}: expected at least 1")
    cases = [(name, seed) for name in scenes for seed in range(postures)]
    records = []
    for record in run_each(stop_at_rest, cases, workers):
        records.append(record)
        if len(records) % 20 == 0:
            say(f"{len(records)} of {len(cases)} stops")
    report: Report = {"bench": "stops", "machine": machine(), "records": records}
    rows = []
    for name in scenes:
        own = [record for record in records if record["scene"] == name]
        speeds, travels, times = ([record[key] for record in own] for key in ("speed", "travel", "braked"))
        pairs = zip(speeds, travels, times, strict=True)
        within = sum(speed <= SPEED and travel <= TRAVEL and time <= BRAKED for speed, travel, time in pairs)
        report[name] = {
            "speed_rad_s": percentiles(speeds),
            "travel_m": percentiles(travels),
            "braked_s": percentiles(times),
            "within": within,
            "modes": dict(Counter(record["mode"] for record in own)),
        }
        rows.append(
            (name, f"{within} of {postures}", _text(speeds, 1000.0), _text(travels, 1000.0), _text(times, 1000.0))
        )
    columns = ("speed", "mrad/s"), ("travel", "mm"), ("brakes close after", "ms")
    header = ("scene", "within bounds", *(f"{name} p50, p95, max ({unit})" for name, unit in columns))
    wanted = f"{1000 * SPEED:g} mrad/s, {1000 * TRAVEL:g} mm, brakes within {1000 * BRAKED:g} ms"
    print(f"{WATCHED:g} s after a stop; wanted {wanted}\n{table(header, rows)}")
    write_report(report, file)
    return report


def _text(values: Sequence[float], scale: float) -> str:
    return ", ".join(f"{scale * value:.1f}" for value in percentiles(values).values())


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__, spread=True)
    parser.add_argument("--postures", type=int, help="random postures of each scene (default: 200)")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="whose mismatch it has (default: ball_mismatch)")
    bench_stops(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
