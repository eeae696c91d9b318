"""Scene files, the package's and the users'; each may be based on another."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from contact_reach_ros.errors import ContactReachError, SceneError, SettingsError
from contact_reach_ros.resources import share_directory
from contact_reach_ros.settings import Settings, read_yaml, unknown_key
from contact_reach_ros.world.environment import read_environment
from contact_reach_ros.world.kinds import KINDS
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings, SceneFile, TargetSettings

SECTIONS: dict[str, type[Settings]] = {"target": TargetSettings, **KINDS, "mismatch": MismatchSettings}
"""Sections that a scene file may have, besides `BASE` and `ENVIRONMENT`."""

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
    made: dict[str, Any] = {
        key: SECTIONS[key].from_mapping(values, f"{file}: {key}") for key, values in sections.items()
    }
    obstacles = tuple(made.pop(kind) for kind in KINDS if kind in made)
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


def _read_sections(file: Path, above: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """The sections of a file, merged over those of its base; `above` are the files based on it."""
    content = read_yaml(file)
    base = content.pop(BASE, None)
    for key, values in content.items():
        if key not in (ENVIRONMENT, *SECTIONS):
            raise SettingsError(unknown_key(str(key), [BASE, ENVIRONMENT, *SECTIONS], str(file)))
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
        sections[key] = {**sections.get(key, {}), **values}
    return sections


def _check(scene: SceneFile) -> None:
    """Check what no section can check of its own values."""
    if len(scene.obstacles) > 1:
        kinds = " and ".join(obstacle.KIND for obstacle in scene.obstacles)
        raise SettingsError(f"has both {kinds}; expected at most one of them")
    target = scene.target
    if any(low > high for low, high in zip(target.minimum, target.maximum, strict=True)):
        raise SettingsError(f"target: minimum = {target.minimum}: expected at most maximum = {target.maximum}")
    for obstacle in scene.obstacles:
        obstacle.check()
