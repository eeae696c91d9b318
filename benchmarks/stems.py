"""Whether the stems of a plant give way as the planner expects: force against deflection over random pushes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.output import command_line, given, percentiles, run_command, write_report
from benchmarks.press import stiffness_matrix
from contact_reach_ros.arm import Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SceneError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

_DEPTHS = 0.005, 0.06
"""Least and greatest deflection that is aimed at, m."""
_STRONGEST = 15.0
"""Force at most, N: a plan keeps below 10."""
_SLANT = 0.5
"""Greatest angle of a push from across the stem, rad."""
_ACROSS = 0.1
"""Angle up to which a push counts as across, rad."""
_STEPS = 300


def bench_stems(scene: str = "plant", seed: int = 0, pushes: int = 200, file: Path | None = None) -> dict[str, object]:
    """Push nodes of a plant, print the errors of the planner's force and write JSON to `file`.

    Parameters
    ----------
    scene, seed
        Name or YAML file of the scene, and its seed.
    pushes
        Number of pushes at random nodes, in random directions and to random depths.

    Raises
    ------
    SceneError
        If the scene has no plant, or cannot be made.
    """
    made = make_scene(read_scene(scene), load_arm(), seed)
    if not made.obstacles or made.obstacles[-1].bending is None:
        raise SceneError(f"scene '{scene}' has no plant; expected one that has, such as 'plant'")
    random = np.random.default_rng(seed)
    rows = [_push(made, random) for _ in range(pushes)]
    forces, expected, depths, slants = np.array(rows).T
    errors = 100.0 * np.abs(expected / forces - 1.0)
    across = slants < _ACROSS
    parts = {"across the stem, up to 30 mm": across & (depths <= 0.03), "beyond": across & (depths > 0.03)}
    parts |= {f"up to {_SLANT:g} rad from across": ~across, "all": depths > 0.0}
    for name, part in ((name, part) for name, part in parts.items() if part.any()):
        found = percentiles(errors[part])
        text = ", ".join(f"{key} {value:.1f} %" for key, value in found.items())
        print(f"{name}: {part.sum()} pushes with {forces[part].min():.2f} to {forces[part].max():.1f} N, error {text}")
    report: dict[str, object] = {"force_N": forces.tolist(), "planner_N": expected.tolist(), "depth_m": depths.tolist()}
    write_report(report, file)
    return report


def _push(scene: Scene, random: np.random.Generator) -> tuple[float, float, float, float]:
    """A push: force, that of the planner's model at this deflection, N, the deflection, m, and the slant, rad."""
    plant, body = scene.obstacles[-1], Plant(scene)
    stiffness = stiffness_matrix(obstacle_spheres(scene, rest_positions(scene)))
    first = len(stiffness) - len(plant.rest)
    assert plant.bending is not None
    stem = plant.bending.stems[int(random.integers(len(plant.bending.stems)))]
    node = int(random.choice(stem[1:]))
    along = plant.rest[node] - plant.rest[0]
    direction = _across(along / np.linalg.norm(along), random)
    compliance = float(np.linalg.inv(stiffness)[first + node, first + node])
    force = min(random.uniform(*_DEPTHS) / compliance, _STRONGEST)
    push(body, f"{plant.kind}_{len(scene.obstacles) - 1}_{node}", force * direction, _STEPS)
    depth = float((body.obstacle_positions()[first + node] - plant.rest[node]) @ direction)
    slant = abs(float(np.arcsin(direction @ along / np.linalg.norm(along))))
    return force, depth / compliance, depth, slant


def push(plant: Plant, site: str, force: Array, steps: int) -> None:
    """Push the end of a link, where a site is, with a constant force (3,), N, for a number of steps."""
    model, data = plant.model, plant.data
    body, place = model.body(site).id, model.site(site).id
    for _ in range(steps):
        lever = data.site_xpos[place] - data.xipos[body]
        data.xfrc_applied[body] = [*force, *np.cross(lever, force)]
        plant.step()


def _across(along: Array, random: np.random.Generator) -> Array:
    """A direction (3,) across a stem, or up to `_SLANT` from that."""
    direction = np.cross(along, random.standard_normal(3))
    slant = random.uniform(-_SLANT, _SLANT)
    across: Array = np.cos(slant) * direction / np.linalg.norm(direction) + np.sin(slant) * along
    return across


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scene", help="scene with a plant: a name or a YAML file (default: plant)")
    parser.add_argument("--seed", type=int, help="of the scene and the pushes (default: 0)")
    parser.add_argument("--pushes", type=int, help="number of pushes (default: 200)")
    bench_stems(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
