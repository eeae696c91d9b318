"""Scene files: those of the package and those of users, each perhaps based on another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from contact_reach_ros.errors import SceneError, SettingsError
from contact_reach_ros.resources import share_directory
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.scenes.checks import check_file
from contact_reach_ros.scenes.scene import (
    NO_MISMATCH,
    BallSettings,
    MismatchSettings,
    SceneFile,
    TargetSettings,
    WallSettings,
)
from contact_reach_ros.settings import Settings, read_yaml, unknown_key

SECTIONS: dict[str, type[Settings]] = {
    "target": TargetSettings,
    "ball": BallSettings,
    "wall": WallSettings,
    "mismatch": MismatchSettings,
}
"""What a scene file may hold, besides `BASE`."""

BASE = "base"
"""Key of the scene that a file changes."""

_ENDINGS = (".yaml", ".yml")


def scene_names() -> list[str]:
    """The scenes that come with the package."""
    return sorted(file.stem for file in _package_directory().glob("*.yaml"))


def matching_scene_names() -> list[str]:
    """Those of them whose simulated robot and foam are as the planner thinks."""
    return [name for name in scene_names() if read_scene(name).mismatch == NO_MISMATCH]


def read_scene(name: str) -> SceneFile:
    """Read a scene by its name, or by the path of a YAML file, and check what does not depend on a seed.

    Raises
    ------
    SceneError
        If there is no such scene, its bases go round in a circle, or what stands where it says cannot be: an obstacle
        in the arm at the start, a target in an obstacle or out of reach, a mesh too fine to simulate. The message has
        the numbers.
    SettingsError
        If a file has an unknown section or key, a value out of range, or a lower bound above its upper one.
    """
    file = scene_file(name)
    if not file.is_file():
        raise SceneError(f"scene '{name}' is unknown; expected one of {', '.join(scene_names())}, or a YAML file")
    sections = _read_sections(file, [])
    made: dict[str, Any] = {
        key: SECTIONS[key].from_mapping(values, f"{file}: {key}") for key, values in sections.items()
    }
    scene = SceneFile(file.stem, **{"target": TargetSettings(), **made})
    _check_settings(file, scene)
    try:
        check_file(scene)
    except SceneError as error:
        raise SceneError(f"{file}: {error}") from error
    return scene


def _package_directory() -> Path:
    return share_directory() / "config" / "scenes"


def scene_file(name: str) -> Path:
    """File of a scene by its name, or by its path; it may not exist."""
    return _find(name, Path())


def _find(name: str, folder: Path) -> Path:
    """File of a scene by its name, or by its path, from `folder` if that is relative."""
    return folder / name if name.endswith(_ENDINGS) else _package_directory() / f"{name}.yaml"


def _read_sections(file: Path, above: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """The sections of a file on top of those of its base; `above` are the files that it is the base of."""
    content = read_yaml(file)
    base = content.pop(BASE, None)
    for key, values in content.items():
        if key not in SECTIONS:
            raise SettingsError(unknown_key(str(key), [BASE, *SECTIONS], str(file)))
        if not isinstance(values, dict):
            raise SettingsError(f"{file}: {key} = {values!r}; expected a mapping of keys to values")
        # Here, where the file with the wrong value is known.
        SECTIONS[key].from_mapping(values, f"{file}: {key}")
    if base is None:
        return content
    chain = [*above, file]
    below = _find(base, file.parent) if isinstance(base, str) else None
    if below is None or not below.is_file():
        raise SceneError(f"{file}: {BASE} = {base!r}; expected one of {', '.join(scene_names())}, or a YAML file")
    if any(below.samefile(other) for other in chain):
        circle = " -> ".join(str(other) for other in [*chain, below])
        raise SceneError(f"{file}: {BASE} = {base!r} leads back to where it started: {circle}")
    sections = _read_sections(below, chain)
    for key, values in content.items():
        sections[key] = {**sections.get(key, {}), **values}
    return sections


def _check_settings(file: Path, scene: SceneFile) -> None:
    """What a section alone cannot say of its values."""
    target = scene.target
    if scene.ball is not None and scene.wall is not None:
        raise SettingsError(f"{file}: has both ball and wall; expected at most one of them")
    if any(low > high for low, high in zip(target.minimum, target.maximum, strict=True)):
        raise SettingsError(f"{file}: target: minimum = {target.minimum}: expected at most maximum = {target.maximum}")
    for name, angle, limit in zip(iiwa14.JOINT_NAMES, target.start, iiwa14.POSITION_LIMITS, strict=True):
        if abs(angle) > limit:
            raise SettingsError(
                f"{file}: target: start = {target.start}: expected {name} in [{-limit:.3f}, {limit:.3f}] rad"
            )
    for section, obstacle in (("ball", scene.ball), ("wall", scene.wall)):
        if obstacle is not None and obstacle.min_overlap > obstacle.max_overlap:
            raise SettingsError(
                f"{file}: {section}: min_overlap = {obstacle.min_overlap:g}: expected at most max_overlap = "
                f"{obstacle.max_overlap:g} m"
            )
