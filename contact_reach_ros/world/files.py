"""Scene files, the package's and the users'; each may be based on another."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.errors import ContactReachError, SceneError, SettingsError
from contact_reach_ros.resources import share_directory
from contact_reach_ros.settings import Settings, read_yaml, unknown_key
from contact_reach_ros.world.environment import read_environment
from contact_reach_ros.world.kinds import KINDS
from contact_reach_ros.world.kinds.lattice import MAX_FREE_NODES, MAX_NODES
from contact_reach_ros.world.obstacle import ObstacleSettings
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings, SceneFile, TargetSettings
from contact_reach_ros.world.spheres import anywhere

SECTIONS: dict[str, type[Settings]] = {"target": TargetSettings, **KINDS, "mismatch": MismatchSettings}
"""Sections that a scene file may have, besides `BASE`, `OBSTACLES` and `ENVIRONMENT`."""

OBSTACLES = "obstacles"
"""Key of a list of obstacles, each with the keys of its kind's section and the `KIND_KEY`."""

KIND_KEY = "kind"

ENVIRONMENT = "environment"
"""Key of the rigid bodies, each with a name of its own."""

BASE = "base"
"""Key of the scene that a file changes."""

_ENDINGS = (".yaml", ".yml")


def scene_names() -> list[str]:
    """The scenes that come with the package."""
    return sorted(file.stem for file in _package_directory().glob("*.yaml"))


def matching_scene_names() -> list[str]:
    """The package's scenes whose simulated robot and foam match the planner's models."""
    return [name for name in scene_names() if read_scene(name).mismatch == NO_MISMATCH]


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
    file = scene_file(name)
    # Not Path.is_file, which raises for a name that is too long.
    if not os.path.isfile(file):
        raise SceneError(_no_scene(name, f"scene '{name}'"))
    sections = _read_sections(file, [])
    environment = read_environment(sections.pop(ENVIRONMENT, {}), f"{file}: {ENVIRONMENT}")
    listed = _read_list(sections.pop(OBSTACLES, []), f"{file}: {OBSTACLES}")
    made: dict[str, Any] = {
        key: SECTIONS[key].from_mapping(values, f"{file}: {key}") for key, values in sections.items()
    }
    obstacles = (*(made.pop(kind) for kind in KINDS if kind in made), *listed)
    made = {"target": TargetSettings(), **made}
    scene = SceneFile(file.stem, obstacles=obstacles, source=str(file), environment=environment, **made)
    try:
        _check(scene)
    except ContactReachError as error:
        raise type(error)(f"{file}: {error}") from error
    return scene


def _package_directory() -> Path:
    return share_directory() / "config" / "scenes"


def scene_file(name: str) -> Path:
    """Path of a scene by its name, or by its path; it may not exist."""
    return _find(name, Path())


def _find(name: str, folder: Path) -> Path:
    """Path of a scene by its name, or by its path, which may be relative to `folder`."""
    return folder / name if name.endswith(_ENDINGS) else _package_directory() / f"{name}.yaml"


def _no_scene(name: str, what: str) -> str:
    """Why there is no scene of this name or path; `what` begins the message."""
    names = ", ".join(scene_names())
    if name.endswith(_ENDINGS):
        return f"{what}: no such file; expected the path of a YAML file, or one of {names}"
    hint = "; the path of a file ends in .yaml or .yml" if os.sep in name else ""
    return f"{what} is unknown; expected one of {names}, or a YAML file{hint}"


def _read_list(entries: Any, source: str) -> tuple[ObstacleSettings, ...]:
    """The obstacles of a list in a scene file; `source` begins the messages of the `SettingsError` it may raise."""
    if not isinstance(entries, list):
        raise SettingsError(f"{source} = {entries!r}; expected a list of obstacles, each with its {KIND_KEY}")
    found = []
    for number, entry in enumerate(entries):
        where = f"{source}[{number}]"
        kind = entry.get(KIND_KEY) if isinstance(entry, dict) else None
        if kind not in KINDS:
            raise SettingsError(f"{where}: {KIND_KEY} = {kind!r}; expected one of {', '.join(KINDS)}")
        values = {key: value for key, value in entry.items() if key != KIND_KEY}
        found.append(KINDS[kind].from_mapping(values, where))
    return tuple(found)


def _read_sections(file: Path, above: Sequence[Path]) -> dict[str, Any]:
    """The sections of a file, merged over those of its base; `above` are the files based on it."""
    content = read_yaml(file)
    base = content.pop(BASE, None)
    for key, values in content.items():
        if key not in (ENVIRONMENT, OBSTACLES, *SECTIONS):
            raise SettingsError(unknown_key(str(key), [BASE, ENVIRONMENT, OBSTACLES, *SECTIONS], str(file)))
        if key == OBSTACLES:
            _read_list(values, f"{file}: {OBSTACLES}")
            continue
        if not isinstance(values, dict):
            raise SettingsError(f"{file}: {key} = {values!r}; expected a mapping of keys to values")
        # Check here, where the file with the wrong value is known.
        if key == ENVIRONMENT:
            read_environment(values, f"{file}: {key}")
            continue
        SECTIONS[key].from_mapping(values, f"{file}: {key}")
    if base is None:
        return content
    chain = [*above, file]
    below = _find(base, file.parent) if isinstance(base, str) else None
    if below is None or not os.path.isfile(below):
        raise SceneError(_no_scene(str(base), f"{file}: {BASE} = {base!r}"))
    if any(below.samefile(other) for other in chain):
        circle = " -> ".join(str(other) for other in [*chain, below])
        raise SceneError(f"{file}: {BASE} = {base!r} leads back to where it started: {circle}")
    sections = _read_sections(below, chain)
    for key, values in content.items():
        # A list replaces that of the base.
        sections[key] = values if key == OBSTACLES else {**sections.get(key, {}), **values}
    return sections


def _check(scene: SceneFile) -> None:
    """Check what no section can check of its own values."""
    target = scene.target
    if any(low > high for low, high in zip(target.minimum, target.maximum, strict=True)):
        raise SettingsError(f"target: minimum = {target.minimum}: expected at most maximum = {target.maximum}")
    for obstacle in scene.obstacles:
        obstacle.check()
    everything = anywhere(scene)
    identifiers = [obstacle.id for obstacle in everything]
    if len(set(identifiers)) < len(identifiers):
        raise SettingsError(
            f"obstacles have the ids {identifiers}, those of walls count from the lower one; expected each once"
        )
    fixed = np.concatenate([np.zeros(0, bool), *(obstacle.fixed for obstacle in everything)])
    if len(fixed) > MAX_NODES or (~fixed).sum() > MAX_FREE_NODES:
        raise SceneError(
            f"obstacles: {len(fixed)} spheres and nodes, {(~fixed).sum()} of which can move; the simulation keeps "
            f"1 kHz with at most {MAX_NODES} and {MAX_FREE_NODES}: use fewer obstacles or coarser meshes"
        )
