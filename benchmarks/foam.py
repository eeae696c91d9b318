"""Whether the walls give way as the planner expects."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np
import scipy.optimize

from benchmarks.output import command_line, given, run_command, write_report
from benchmarks.press import press_in_model, press_in_plant
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import InputError, SceneError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.plant import TICK, Plant
from contact_reach_ros.simulation.settings import JointSettings, SensorSettings
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.obstacle_kinds import WallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

AGREEMENT = 0.2
"""How far displacements of planner and plant may be apart, as a share of the planner's."""
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


def bench_foam(
    scene: str = "wall", seed: int = 0, force: float = 10.0, fit: bool = False, file: Path | None = None
) -> dict[str, object]:
    """Press nodes of the scene's upper wall, print a table and write JSON to `file`.

    Parameters
    ----------
    scene, seed
        Name or YAML file of the scene, and its seed.
    force
        What nodes are pressed with, N.
    fit
        Whether to find the planner's stiffness that agrees best with the plant's, too.

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
    if fit:
        report["fit"] = _print_fit(walls, force, presses)
    write_report(report, file)
    return report


def press(scene: Scene, newtons: float, x: int, y: int, z: int) -> Press:
    """Press one node of the upper wall, given by its place in the lattice, along x."""
    node, force = _number(scene, (x, y, z)), np.array([newtons, 0.0, 0.0])
    plant = Plant(scene, SensorSettings(), JointSettings())
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


def fit_scale(scene: Scene, newtons: float, presses: list[Press]) -> float:
    """Factor on the springs of the planner's mesh with which it gives way most nearly as the plant did.

    Least squares of the logarithms of the displacements' ratios, so that twice and half as far are as wrong as each
    other.
    """
    plant_mm = np.log([row["plant_mm"] for row in presses])

    def misses(log_scale: Array) -> Array:
        spheres = _planner_spheres(scene, float(np.exp(log_scale[0])))
        ways = [_model_mm(spheres, _number(scene, row["node"]), newtons) for row in presses]
        return np.log(ways) - plant_mm

    (known,) = (entry for entry in WallSettings.declared() if entry.name == "planner_stiffness_scale")
    bounds = np.log([known.minimum or 0.0, known.maximum or np.inf])
    now = np.log(_upper_wall(scene).material.planner_scale)
    return float(np.exp(scipy.optimize.least_squares(misses, [now], bounds=bounds).x[0]))


def _print_fit(scene: Scene, newtons: float, presses: list[Press]) -> dict[str, float]:
    material = _upper_wall(scene).material
    scale = fit_scale(scene, newtons, presses)
    spheres = _planner_spheres(scene, scale)
    fitted = [row["plant_mm"] / _model_mm(spheres, _number(scene, row["node"]), newtons) for row in presses]
    in_use = material.planner_scale
    error, left = (
        float(np.abs(np.subtract(ratios, 1.0)).max()) for ratios in ([row["ratio"] for row in presses], fitted)
    )
    print(f"the planner's springs, edge_stiffness = {material.edge_stiffness:g} N/m times planner_stiffness_scale")
    for label, value, off in (("in use", in_use, error), ("fitted", scale, left)):
        print(f"  {label}  {value:.3f}, displacements off by {100 * off:.0f} % at most")
    verdict = "agrees" if left <= AGREEMENT else "does not agree"
    print(f"  the fitted mesh {verdict} within {100 * AGREEMENT:.0f} %; in the scene's file:")
    print(f"wall:\n  planner_stiffness_scale: {scale:.3f}")
    return {"in_use": in_use, "error": error, "fitted": scale, "error_fitted": left}


def _planner_spheres(scene: Scene, scale: float) -> Spheres:
    """The mesh at rest as a planner would see it with this scale."""
    walls = tuple(
        dataclasses.replace(wall, material=dataclasses.replace(wall.material, planner_scale=scale))
        for wall in scene.obstacles
    )
    return obstacle_spheres(dataclasses.replace(scene, obstacles=walls), rest_positions(scene))


def _model_mm(spheres: Spheres, node: int, newtons: float) -> float:
    way = press_in_model(spheres, node, np.array([newtons, 0.0, 0.0]), np.array([TICK * _PRESS_TICKS]))
    return 1000.0 * float(way[0, 0])


def _number(scene: Scene, node: tuple[int, int, int]) -> int:
    """Number of a node of the upper wall among all spheres."""
    wall = _upper_wall(scene)
    return len(rest_positions(scene)) - len(wall.rest) + int(np.ravel_multi_index(node, wall.lattice))


def _upper_wall(scene: Scene) -> Obstacle:
    return scene.obstacles[-1]


def _surface_nodes(scene: Scene) -> list[tuple[int, int, int]]:
    """Middle, quarter and end of the wall, front and back, at the gap and next to the fixture."""
    along_x, along_y, along_z = _upper_wall(scene).lattice
    places = ((0, along_x - 1), (along_y // 2, along_y // 4, 0), sorted({0, along_z - 2}))
    return [(x, y, z) for x, y, z in itertools.product(*places)]


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scene", help="scene with walls: a name or a YAML file (default: wall)")
    parser.add_argument("--seed", type=int, help="seed of the scene (default: 0)")
    parser.add_argument("--force", type=float, help="that nodes are pressed with, N (default: 10)")
    parser.add_argument("--fit", action="store_true", help="find the planner's stiffness that agrees best")
    bench_foam(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
