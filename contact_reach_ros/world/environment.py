"""The section of scene files that places rigid bodies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from scipy.spatial.transform import Rotation

from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.world.rigid import Block, Environment, Plane, RigidBody


@dataclass(frozen=True)
class PlaneSettings(Settings):
    """A plane with everything behind it solid."""

    point: tuple[float, ...] = setting((0.0, 0.0, 0.0), "anywhere on it", unit="m", minimum=-5.0, maximum=5.0)
    normal: tuple[float, ...] = setting((0.0, 0.0, 1.0), "towards the arm, of any length", minimum=-1.0, maximum=1.0)

    def body(self, name: str) -> RigidBody:
        """The plane; raises `InputError` if it has no normal."""
        return Plane(name, self.point, self.normal)


@dataclass(frozen=True)
class BlockSettings(Settings):
    """A rigid box."""

    center: tuple[float, ...] = setting((0.5, 0.0, 0.0), "its middle", unit="m", minimum=-5.0, maximum=5.0)
    size: tuple[float, ...] = setting((0.5, 0.5, 0.1), "along its own x, y, z", unit="m", minimum=0.001, maximum=10.0)
    angles: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "roll, pitch and yaw about the axes of the base", unit="rad", minimum=-6.3, maximum=6.3
    )

    def body(self, name: str) -> RigidBody:
        """The block."""
        return Block(name, self.center, self.size, Rotation.from_euler("xyz", self.angles).as_quat())


BODIES: dict[str, type[PlaneSettings] | type[BlockSettings]] = {"plane": PlaneSettings, "block": BlockSettings}
"""What a body of the section may be, by the words of the documentation; a block has a size."""


def read_environment(section: Mapping[str, Any], source: str) -> Environment:
    """Rigid bodies by name, from the section of a scene file; `null` removes one of the base.

    Raises
    ------
    SettingsError
        On an unknown key or a value that is not accepted; `source` is named.
    """
    bodies = []
    for name, values in section.items():
        where = f"{source}: {name}"
        if values is None:
            continue
        if not isinstance(values, dict):
            raise SettingsError(f"{where} = {values!r}; expected a mapping of keys to values, or null")
        kind = BODIES["block" if "size" in values else "plane"]
        known = {entry.name for entry in kind.declared()}
        for key in values:
            if key not in known:
                keys = (f"a {word} has {', '.join(e.name for e in cls.declared())}" for word, cls in BODIES.items())
                raise SettingsError(f"{where}: unknown key '{key}'; {', '.join(keys)}")
        try:
            bodies.append(kind.from_mapping(values, where).body(str(name)))
        except InputError as error:
            raise SettingsError(f"{source}: {error}") from error
    return tuple(bodies)
