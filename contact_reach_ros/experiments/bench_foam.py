"""`contact-reach bench foam`: whether the walls give way as the planner thinks, and what simulating them costs."""

from __future__ import annotations

import itertools
import json
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SceneError
from contact_reach_ros.plant.plant import TICK, Actuation, Plant
from contact_reach_ros.plant.press import press_in_model, press_in_plant
from contact_reach_ros.plant.settings import JointSettings, MismatchSettings, SensorSettings
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.free_path import free_path
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.scene import Scene, read_scene
from contact_reach_ros.scenes.spheres import obstacle_spheres, rest_positions
from contact_reach_ros.timing import Histogram
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

FORCE = 10.0
"""What a node is pressed with, N."""
_PRESS_TICKS = 1000
_RISE = 1.0 - 1.0 / np.e

_PATH_S = 4.0
_HOLD_S = 1.0
_STIFFNESS = 800.0
_DAMPING = 40.0


def bench_foam(name: str, seed: int, file: Path | None) -> dict[str, object]:
    """Press nodes of the scene's upper wall, push the arm through, print tables and write JSON to `file`.

    Raises
    ------
    SceneError
        If the scene has no walls, or cannot be made.
    """
    scene = make_scene(read_scene(name), seed)
    if not scene.walls:
        raise SceneError(f"scene '{name}' has no walls; expected one that has, such as 'wall'")
    presses = [press(scene, *node) for node in _surface_nodes(scene)]
    print(f"a node pressed with {FORCE:g} N: displacement and time to {100 * _RISE:.0f} % of it, plant and planner")
    for row in presses:
        print(
            f"  node {row['node']!s:12} plant {row['plant_mm']:6.1f} mm {row['plant_ms']:4.0f} ms   planner "
            f"{row['planner_mm']:6.1f} mm {row['planner_ms']:4.0f} ms   ratio {row['ratio']:.2f}, "
            f"{row['time_ratio']:.2f}"
        )
    steps = time_steps(scene)
    print("CPU time of one step of 1 ms while the arm pushes along its free path, us")
    print("  " + "  ".join(f"{key} {value:.0f}" for key, value in steps.items()))
    report: dict[str, object] = {"press": presses, "step_us": steps}
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")
    return report


def press(scene: Scene, x: int, y: int, z: int) -> dict[str, object]:
    """Press one node of the upper wall, given by its place in the lattice, along x."""
    wall = scene.walls[-1]
    node = len(rest_positions(scene)) - len(wall.rest) + int(np.ravel_multi_index((x, y, z), wall.settings.nodes))
    force = np.array([FORCE, 0.0, 0.0])
    plant = Plant(scene, SensorSettings(), JointSettings(), MismatchSettings())
    spheres = obstacle_spheres(scene, rest_positions(scene))
    times: Array = TICK * np.arange(1, _PRESS_TICKS + 1, dtype=np.float64)
    ways = (
        press_in_plant(plant, node, force, _PRESS_TICKS)[:, 0],
        press_in_model(spheres, node, force, times)[:, 0],
    )
    plant_mm, planner_mm = (1000.0 * float(way[-1]) for way in ways)
    plant_ms, planner_ms = (1000.0 * TICK * (1 + int(np.searchsorted(way, _RISE * way[-1]))) for way in ways)
    return {
        "node": [x, y, z],
        "plant_mm": plant_mm,
        "planner_mm": planner_mm,
        "ratio": plant_mm / planner_mm,
        "plant_ms": plant_ms,
        "planner_ms": planner_ms,
        "time_ratio": plant_ms / planner_ms,
    }


def time_steps(scene: Scene) -> dict[str, float]:
    """CPU time of the plant's steps in contact, µs, while the arm is pulled along its free path; contacts at most."""
    model = RobotModel()
    path = free_path(model, scene.start, scene.target)
    if path is None:
        raise SceneError(f"scene '{scene.name}': its target cannot be reached on a straight line")
    plant = Plant(scene, SensorSettings(), JointSettings(), MismatchSettings())
    plant.set_actuation(Actuation.COMMANDED)
    times, contacts = Histogram(), 0
    for tick in range(round((_PATH_S + _HOLD_S) / TICK)):
        wanted = path[min(int(tick * TICK / _PATH_S * len(path)), len(path) - 1)]
        q, v = plant.data.qpos[: len(wanted)], plant.data.qvel[: len(wanted)]
        torque = model.gravity_at(q) + _STIFFNESS * (wanted - q) - _DAMPING * v
        began_ns = time.thread_time_ns()
        plant.step(torque)
        took_ns = time.thread_time_ns() - began_ns
        if plant.data.ncon > 0:
            times.add(took_ns)
            contacts = max(contacts, int(plant.data.ncon))
    return {**times.summary(), "max": 1e6 * times.maximum_ns / NANOSECONDS, "contacts": float(contacts)}


def _surface_nodes(scene: Scene) -> list[tuple[int, int, int]]:
    """Middle, quarter and end of the wall, front and back, at the gap and next to the fixture."""
    along_x, along_y, along_z = scene.walls[-1].settings.nodes
    places = ((0, along_x - 1), (along_y // 2, along_y // 4, 0), sorted({0, along_z - 2}))
    return [(x, y, z) for x, y, z in itertools.product(*places)]
