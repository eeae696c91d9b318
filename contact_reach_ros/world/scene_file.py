"""Scene files, the package's and the users'; each may be based on another."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import Arm, Array, checked_array, quaternion_from_rotation
from contact_reach_ros.arm.tool import NO_TOOL, Tool
from contact_reach_ros.errors import ContactReachError, InputError, SceneError, SettingsError
from contact_reach_ros.resources import share_directory
from contact_reach_ros.settings import Settings, read_yaml, setting, unknown_key
from contact_reach_ros.world.goal import FREE, HOLD
from contact_reach_ros.world.obstacle import (
    BallSettings,
    BoxSettings,
    Obstacle,
    ObstacleSettings,
    WallSettings,
    bodies,
)
from contact_reach_ros.world.rigid import Block, Environment, Plane, RigidBody
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings
from contact_reach_ros.world.stems import StemsSettings

_MOST_SPHERES, _MOST_FREE = 450, 200
"""Greatest numbers of a scene's spheres, and of those that can move; with more, the simulation would not keep its step
of 1 ms: at these limits a step takes up to 0.35 ms in contact."""
_STEP = 0.001
"""Step of the simulation, s."""
_ENDINGS = (".yaml", ".yml")


@dataclass(frozen=True)
class TargetSettings(Settings):
    """The box in which targets are drawn, and the start of episodes."""

    minimum: tuple[float, ...] = setting((0.2, -0.3, 0.0), "lower corner", unit="m", minimum=-1.5, maximum=1.5)
    maximum: tuple[float, ...] = setting((0.6, 0.3, 0.5), "upper corner", unit="m", minimum=-1.5, maximum=1.5)
    min_distance: float = setting(0.2, "least distance from the start", unit="m", minimum=0.0, maximum=1.5)
    start: tuple[float, ...] | None = setting(
        None,
        "joint angles at the start, within the arm's limits; null for its home posture",
        unit="rad",
        per_joint=True,
    )
    reach: float = setting(
        0.0,
        "reach of the arm that `start` and all lengths but `position` and `center` are for; other arms have them in "
        "proportion; 0 for as they are",
        unit="m",
        minimum=0.0,
        maximum=5.0,
    )
    start_position: tuple[float, ...] | None = setting(
        None,
        "where the tip of other arms starts, the axis of the last joint along x",
        unit="m",
        minimum=-1.5,
        maximum=1.5,
        optional_length=3,
    )
    position: tuple[float, ...] | None = setting(
        None, "the target, instead of one drawn in the box", unit="m", minimum=-1.5, maximum=1.5, optional_length=3
    )
    orientation: str = setting(HOLD, "orientation of the tip there: that of the start, or any", choices=(HOLD, FREE))

    def start_of(self, arm: Arm) -> Array:
        """Joint angles at the start (n,), rad.

        Raises
        ------
        SettingsError
            If their number is not that of the arm's joints, or one is outside its limits.
        """
        if self.start is None:
            return np.array(arm.home)
        start = np.array(self.resolve(arm).start)
        for name, angle, lower, upper in zip(arm.joint_names, start, arm.lower, arm.upper, strict=True):
            if not lower <= angle <= upper:
                raise SettingsError(f"target: start = {self.start}: expected {name} in [{lower:.3f}, {upper:.3f}] rad")
        return start


KINDS: dict[str, type[ObstacleSettings]] = {
    kind.KIND: kind for kind in (BallSettings, BoxSettings, WallSettings, StemsSettings)
}
"""Kinds of obstacles by the key of their section; a scene lists its obstacles in this order."""
SECTIONS: dict[str, type[Settings]] = {"target": TargetSettings, "tool": Tool, **KINDS, "mismatch": MismatchSettings}
"""Sections that a scene file may have, besides `BASE`, `OBSTACLES` and `ENVIRONMENT`."""
OBSTACLES, KIND_KEY = "obstacles", "kind"
"""Key of a list of obstacles, and the key by which each of them names its kind."""
ENVIRONMENT = "environment"
"""Key of the rigid bodies, each with a name of its own."""
PLANE_KEYS, BLOCK_KEYS = ("point", "normal"), ("center", "size", "angles")
"""Keys of a rigid body: `angles` are roll, pitch and yaw about the axes of the base, rad, the others `Plane`'s and
`Block`'s."""
BASE = "base"
"""Key of the scene that a file changes."""


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene's YAML file, its base included."""

    name: str
    target: TargetSettings
    obstacles: tuple[ObstacleSettings, ...] = ()
    mismatch: MismatchSettings = NO_MISMATCH
    source: str = field(default="", compare=False)
    """Path of the file, for messages; empty without a file."""
    environment: Environment = ()
    """Rigid bodies: floor, table and the like."""
    tool: Tool = NO_TOOL
    """What an arm without a tool carries in this scene."""

    def equipped(self, arm: Arm) -> Arm:
        """The arm with the scene's tool, unless it has one of its own."""
        return arm if arm.bare else arm.with_tool(self.tool)


def anywhere(file: SceneFile) -> tuple[Obstacle, ...]:
    """The obstacles of a scene file, in arbitrary places: for their shapes and materials only."""
    return bodies(file.obstacles, [np.zeros(3)] * len(file.obstacles))


def scene_names() -> list[str]:
    """The scenes that come with the package."""
    return sorted(file.stem for file in _package_directory().glob("*.yaml"))


def scene_file(name: str, folder: Path = Path()) -> Path:
    """Path of a scene by its name, or by its path, which may be relative to `folder`; it may not exist."""
    return folder / name if name.endswith(_ENDINGS) else _package_directory() / f"{name}.yaml"


def read_scene(name: str) -> SceneFile:
    """Read a scene by its name, or by the path of a YAML file, and check what depends on neither arm nor seed.

    Raises
    ------
    SceneError
        If there is no such scene, its bases form a circle, or its obstacles cannot be simulated: a mesh too fine, foam
        too stiff for its mass. The message gives the numbers.
    SettingsError
        If a file has an unknown section or key, a value out of range, or a lower bound above its upper one.
    """
    file = _existing(name, Path(), f"scene '{name}'")
    sections = _read(file, [])
    scene = SceneFile(
        file.stem,
        sections.get("target", TargetSettings()),
        (*(sections[kind] for kind in KINDS if kind in sections), *sections.get(OBSTACLES, ())),
        sections.get("mismatch", NO_MISMATCH),
        str(file),
        tuple(body for body in sections.get(ENVIRONMENT, {}).values() if body is not None),
        sections.get("tool", NO_TOOL),
    )
    try:
        _check(scene)
    except ContactReachError as error:
        raise type(error)(f"{file}: {error}") from error
    return scene


def check_stable(obstacle: Obstacle) -> None:
    """Refuse springs and contact that are unstable in a simulation in steps of 1 ms.

    Semi-implicit Euler steps are stable up to 4 m / dt²; half of it leaves room for hardening and mismatch. The
    eigenvalues of a mesh are at most twice the stiffness of all edges of one node (Gershgorin).

    Raises
    ------
    SceneError
        If they are too stiff; the message gives the greatest stiffness.
    """
    material, edges = obstacle.material, np.bincount(obstacle.edges.ravel(), minlength=1).max()
    stiffness = 2.0 * edges * material.edge_stiffness + material.stiffness + material.contact_stiffness
    limit = 2.0 * material.mass / _STEP**2
    if stiffness > limit:
        raise SceneError(
            f"{obstacle.kind}: springs and contact of {stiffness:g} N/m in all on {material.mass:g} kg; the simulation "
            f"in steps of 1 ms is stable up to {limit:g} N/m: use softer foam or more mass"
        )


def _package_directory() -> Path:
    return share_directory() / "config" / "scenes"


def _existing(name: str, folder: Path, what: str) -> Path:
    """As `scene_file`; raises `SceneError` if there is no such file, and `what` begins the message."""
    file = scene_file(name, folder)
    # Not Path.is_file, which raises for a name that is too long.
    if os.path.isfile(file):
        return file
    names = ", ".join(scene_names())
    if name.endswith(_ENDINGS):
        raise SceneError(f"{what}: no such file; expected the path of a YAML file, or one of {names}")
    hint = "; the path of a file ends in .yaml or .yml" if os.sep in name else ""
    raise SceneError(f"{what} is unknown; expected one of {names}, or a YAML file{hint}")


def _read(file: Path, above: Sequence[Path]) -> dict[str, Any]:
    """Settings by section, those of the file's base with the file's changes; `above` are the files based on it."""
    content = read_yaml(file)
    base = content.pop(BASE, None)
    found = {} if base is None else _read_base(file, base, above)
    for key, values in content.items():
        found[key] = _section(file, str(key), values, found.get(key))
    return found


def _section(file: Path, key: str, values: Any, base: Any) -> Any:
    """One section, with what it changes of the base's, if there is one."""
    where = f"{file}: {key}"
    if key not in (ENVIRONMENT, OBSTACLES, *SECTIONS):
        raise SettingsError(unknown_key(key, [BASE, ENVIRONMENT, OBSTACLES, *SECTIONS], str(file)))
    if key == OBSTACLES:
        return _read_list(values, where)
    if not isinstance(values, dict):
        raise SettingsError(f"{where} = {values!r}; expected a mapping of keys to values")
    if key == ENVIRONMENT:
        return {**(base or {}), **_read_environment(values, where)}
    return SECTIONS[key].from_mapping({**({} if base is None else vars(base)), **values}, where)


def _read_base(file: Path, base: Any, above: Sequence[Path]) -> dict[str, Any]:
    chain, what = [*above, file], f"{file}: {BASE} = {base!r}"
    below = _existing(str(base), file.parent, what)
    if any(below.samefile(other) for other in chain):
        circle = " -> ".join(str(other) for other in [*chain, below])
        raise SceneError(f"{what} leads back to where it started: {circle}")
    return _read(below, chain)


def _read_list(entries: Any, where: str) -> tuple[ObstacleSettings, ...]:
    """The obstacles of a list; `where` begins the messages of the `SettingsError` it may raise."""
    if not isinstance(entries, list):
        raise SettingsError(f"{where} = {entries!r}; expected a list of obstacles, each with its {KIND_KEY}")
    found = []
    for number, entry in enumerate(entries):
        kind = entry.get(KIND_KEY) if isinstance(entry, dict) else None
        if not isinstance(kind, str) or kind not in KINDS:
            raise SettingsError(f"{where}[{number}]: {KIND_KEY} = {kind!r}; expected one of {', '.join(KINDS)}")
        values = {key: value for key, value in entry.items() if key != KIND_KEY}
        found.append(KINDS[kind].from_mapping(values, f"{where}[{number}]"))
    return tuple(found)


def _read_environment(section: Mapping[str, Any], where: str) -> dict[str, RigidBody | None]:
    """Rigid bodies by name; None removes one of the base. Raises `SettingsError` as `_read_list`."""
    found: dict[str, RigidBody | None] = dict.fromkeys(section)
    for name, values in section.items():
        if values is None:
            continue
        if not isinstance(values, dict):
            raise SettingsError(f"{where}: {name} = {values!r}; expected a mapping of keys to values, or null")
        known = PLANE_KEYS if set(values) <= set(PLANE_KEYS) else BLOCK_KEYS
        for key in values:
            if key not in known:
                raise SettingsError(unknown_key(str(key), known, f"{where}: {name}"))
        try:
            if known is PLANE_KEYS:
                found[name] = Plane(str(name), **values)
            else:
                angles = checked_array("angles", values.get("angles", (0.0, 0.0, 0.0)), (3,))
                turn = np.roll(quaternion_from_rotation(pin.rpy.rpyToMatrix(angles)), -1)
                found[name] = Block(str(name), values.get("center", ()), values.get("size", ()), turn)
        except InputError as error:
            raise SettingsError(f"{where}: {error}") from error
        except (TypeError, ValueError) as error:
            raise SettingsError(f"{where}: {name}: expected three numbers for each key ({error})") from error
    return found


def _check(scene: SceneFile) -> None:
    """Check what no section can check of its own values."""
    target = scene.target
    if any(low > high for low, high in zip(target.minimum, target.maximum, strict=True)):
        raise SettingsError(f"target: minimum = {target.minimum}: expected at most maximum = {target.maximum}")
    everything = anywhere(scene)
    for obstacle in everything:
        check_stable(obstacle)
    count = sum(len(obstacle.rest) for obstacle in everything)
    free = sum(int((~obstacle.fixed).sum()) for obstacle in everything)
    if count > _MOST_SPHERES or free > _MOST_FREE:
        raise SceneError(
            f"obstacles: {count} spheres and nodes, {free} of which can move; the simulation keeps 1 kHz with at most "
            f"{_MOST_SPHERES} and {_MOST_FREE}: use fewer obstacles or coarser meshes"
        )
