"""Whether the walls give way as the planner expects."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np

from benchmarks.output import command_line, given, run_command, write_report
from benchmarks.press import lattice, press_in_model, press_in_plant
from contact_reach_ros.arm import Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import InputError, SceneError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.plant import TICK, Plant
from contact_reach_ros.world.obstacle import Obstacle, WallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

MAX_FORCE = 100.0
"""To press nodes with, N."""
_PRESS_TICKS = 1000
_RISE = 1.0 - math.exp(-1.0)


class Press(TypedDict):
    """How far a pressed node gave way, and how fast: time until 63 % of it."""

    node: tuple[int, int, int]
    plant_mm: float
    planner_mm: float
    ratio: float
    plant_ms: float
    planner_ms: float
    time_ratio: float


def bench_foam(scene: str = "wall", seed: int = 0, force: float = 10.0, file: Path | None = None) -> dict[str, object]:
    """Press nodes of the scene's upper wall, print a table and write JSON to `file`.

    Parameters
    ----------
    scene, seed
        Name or YAML file of the scene, and its seed.
    force
        What nodes are pressed with, N.

    Raises
    ------
    InputError
        If the force is not above zero and at most `MAX_FORCE`.
    SceneError
        If the scene has no walls, or cannot be made.
    """
    if not 0.0 < force <= MAX_FORCE:
        raise InputError(f"force = {force:g} N: expected a number above 0, at most {MAX_FORCE:g}")
    walls = make_scene(read_scene(scene), load_arm(), seed)
    if not any(obstacle.kind == WallSettings.KIND for obstacle in walls.obstacles):
        raise SceneError(f"scene '{scene}' has no walls; expected one that has, such as 'wall'")
    presses = [press(walls, force, *node) for node in _surface_nodes(walls)]
    print(f"a node pressed with {force:g} N: displacement and time to {100 * _RISE:.0f} % of it, plant and planner")
    for row in presses:
        print(
            f"  node {row['node']!s:12} plant {row['plant_mm']:6.1f} mm {row['plant_ms']:4.0f} ms   planner "
            f"{row['planner_mm']:6.1f} mm {row['planner_ms']:4.0f} ms   ratio {row['ratio']:.2f}, "
            f"{row['time_ratio']:.2f}"
        )
    report: dict[str, object] = {"force_N": force, "press": presses}
    write_report(report, file)
    return report


def press(scene: Scene, newtons: float, x: int, y: int, z: int) -> Press:
    """Press one node of the upper wall, given by its place in the lattice, along x."""
    node, force = _number(scene, (x, y, z)), np.array([newtons, 0.0, 0.0])
    plant = Plant(scene)
    spheres = obstacle_spheres(scene, rest_positions(scene))
    times: Array = TICK * np.arange(1, _PRESS_TICKS + 1, dtype=np.float64)
    ways = (
        press_in_plant(plant, node, force, _PRESS_TICKS)[:, 0],
        press_in_model(spheres, node, force, times)[:, 0],
    )
    plant_mm, planner_mm = (1000.0 * float(way[-1]) for way in ways)
    plant_ms, planner_ms = (1000.0 * TICK * (1 + int(np.searchsorted(way, _RISE * way[-1]))) for way in ways)
    return {
        "node": (x, y, z),
        "plant_mm": plant_mm,
        "planner_mm": planner_mm,
        "ratio": plant_mm / planner_mm,
        "plant_ms": plant_ms,
        "planner_ms": planner_ms,
        "time_ratio": plant_ms / planner_ms,
    }


def _number(scene: Scene, node: tuple[int, int, int]) -> int:
    """Number of a node of the upper wall among all spheres."""
    wall = _upper_wall(scene)
    return len(rest_positions(scene)) - len(wall.rest) + int(np.ravel_multi_index(node, lattice(wall)))


def _upper_wall(scene: Scene) -> Obstacle:
    return scene.obstacles[-1]


def _surface_nodes(scene: Scene) -> list[tuple[int, int, int]]:
    """Middle, quarter and end of the wall, front and back, at the gap and next to the fixture."""
    along_x, along_y, along_z = lattice(_upper_wall(scene))
    places = ((0, along_x - 1), (along_y // 2, along_y // 4, 0), sorted({0, along_z - 2}))
    return [(x, y, z) for x, y, z in itertools.product(*places)]


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scene", help="scene with walls: a name or a YAML file (default: wall)")
    parser.add_argument("--seed", type=int, help="seed of the scene (default: 0)")
    parser.add_argument("--force", type=float, help="that nodes are pressed with, N (default: 10)")
    bench_foam(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
