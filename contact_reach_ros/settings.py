"""Typed settings.

Each value is declared once, with default, unit, range and description. ROS parameters, YAML files and the documentation
all follow from this declaration, so they cannot disagree.
"""

from __future__ import annotations

import dataclasses
import difflib
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, Self

import yaml

from contact_reach_ros.errors import SettingsError

Scalar = bool | int | float | str
Value = Scalar | tuple[Scalar, ...] | None


class ArmDefaults(Protocol):
    """What settings need from an arm."""

    def default(self, setting: str) -> tuple[float, ...]:
        """Default of a setting with one value per joint."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """Declaration of one value: its name, default and accepted values."""

    name: str
    default: Value
    description: str
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]
    optional_length: int | None
    """Length of a list of numbers that may be missing, which a default of None declares."""
    per_joint: bool
    """Whether it is a list with one number per joint of the arm; a default of None stands for the arm's own."""

    @property
    def kind(self) -> type:
        """Type of the value, or of the elements of a tuple."""
        if self.optional_length is not None or self.per_joint:
            return float
        value = self.default[0] if isinstance(self.default, tuple) and self.default else self.default
        return str if self.is_open_list else type(value)

    @property
    def is_open_list(self) -> bool:
        """Whether the value is a list of strings of any length, which a default of () declares."""
        return self.default == ()

    @property
    def length(self) -> int | None:
        """Number of values of a list, None for a single value."""
        return len(self.default) if isinstance(self.default, tuple) else self.optional_length

    @property
    def accepts(self) -> str:
        """The accepted values in words, for messages and documentation."""
        words = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}[self.kind]
        if self.choices:
            words = "one of " + ", ".join(self.choices)
        if self.is_open_list:
            words = "a list of strings"
        elif self.per_joint and self.length is None:
            words = f"a list with one value for each joint, each {words}"
        elif self.length is not None:
            words = f"a list of {self.length} values, each {words}"
        if self.minimum is not None or self.maximum is not None:
            low = "-inf" if self.minimum is None else f"{self.minimum:g}"
            high = "inf" if self.maximum is None else f"{self.maximum:g}"
            words += f" in [{low}, {high}]"
        words = f"{words} {self.unit}".rstrip()
        return words if self.optional_length is None else f"null, or {words}"

    def for_arm(self, arm: ArmDefaults) -> Setting:
        """The declaration for one arm, which fixes length and default of per-joint lists."""
        return dataclasses.replace(self, default=arm.default(self.name)) if self.per_joint else self

    def check(self, value: Any, where: str) -> Value:
        """Return `value` in the declared type.

        Raises `SettingsError` if the value has another type or length, is not finite, or lies outside the range; the
        message has `where`.
        """
        # NumPy's numbers and arrays count as Python's.
        value = value.tolist() if hasattr(value, "tolist") else value
        if value is None and (self.optional_length is not None or self.per_joint):
            return None
        if self.length is not None or self.per_joint:
            is_list = isinstance(value, Sequence) and not isinstance(value, str)
            if not is_list or (self.length not in (None, len(value)) and not self.is_open_list):
                raise SettingsError(f"{where} = {value!r}: expected {self.accepts}")
            return tuple(self._check_scalar(item, where) for item in value)
        return self._check_scalar(value, where)

    def _check_scalar(self, value: Any, where: str) -> Scalar:
        kind = self.kind
        fits = isinstance(value, kind) or (kind is float and isinstance(value, int))
        if kind is not bool and isinstance(value, bool):
            fits = False
        if fits and kind in (int, float):
            # An integer too large for a float is refused like infinity.
            fits = abs(value) <= sys.float_info.max
            fits = fits and (self.minimum is None or value >= self.minimum)
            fits = fits and (self.maximum is None or value <= self.maximum)
        if fits and self.choices:
            fits = value in self.choices
        if not fits:
            raise SettingsError(f"{where} = {value!r}: expected {self.accepts}")
        return kind(value)


def setting(
    default: Any,
    description: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[str] = (),
    optional_length: int | None = None,
    per_joint: bool = False,
) -> Any:
    """Declare one value of a `Settings` class.

    A list of numbers that may be missing has an `optional_length`; a list with one number per joint of the arm is
    `per_joint`, with a default of None that stands for `Arm.default`.
    """
    metadata = {
        "description": description,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": tuple(choices),
        "optional_length": optional_length,
        "per_joint": per_joint,
    }
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of the settings classes: frozen, and checked against its declarations on construction."""

    def __post_init__(self) -> None:
        for entry in self.declared():
            checked = entry.check(getattr(self, entry.name), f"{type(self).__name__}.{entry.name}")
            object.__setattr__(self, entry.name, checked)

    @classmethod
    def declared(cls) -> Iterator[Setting]:
        """All values of the class, in the order of their declaration."""
        for field in dataclasses.fields(cls):
            yield Setting(name=field.name, default=field.default, **field.metadata)  # type: ignore[arg-type]

    def resolve(self, arm: ArmDefaults) -> Self:
        """These settings, with the arm's own values filled in where they have none.

        Raises `SettingsError` if a list does not have one value for each joint of the arm.
        """
        values: dict[str, Any] = {}
        for entry in self.declared():
            if entry.per_joint:
                value = getattr(self, entry.name)
                where = f"{type(self).__name__}.{entry.name}"
                values[entry.name] = entry.for_arm(arm).check(
                    arm.default(entry.name) if value is None else value, where
                )
        return dataclasses.replace(self, **values) if values else self

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], source: str) -> Self:
        """Make the settings from a mapping such as a YAML section.

        Raises
        ------
        SettingsError
            On an unknown key or a value that is not accepted; the message names `source` (a file, a parameter prefix).
        """
        known = {entry.name: entry for entry in cls.declared()}
        for key in mapping:
            if key not in known:
                raise SettingsError(unknown_key(str(key), known, source))
        return cls(**{key: known[key].check(value, f"{source}: {key}") for key, value in mapping.items()})


Sections = Mapping[str, type[Settings]]
"""Settings classes of a node by parameter prefix; the prefix '' is the node itself."""


def unknown_key(key: str, known: Mapping[str, Any] | Sequence[str], source: str, what: str = "key") -> str:
    """The message for an undeclared key, with the nearest declared one if there is any; `what` it is, if no key."""
    near = difflib.get_close_matches(key, list(known), n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"known {what}s: " + ", ".join(sorted(known))
    return f"{source}: unknown {what} '{key}'; {hint}"


class _Loader(yaml.SafeLoader):
    """Reads the files of launch, too, which tags lists as Python's tuples."""


_Loader.add_constructor("tag:yaml.org,2002:python/tuple", yaml.SafeLoader.construct_sequence)


def read_yaml(file: Path) -> dict[str, Any]:
    """Read the mapping in a YAML file.

    Raises `SettingsError` if the file cannot be read, is not YAML or does not hold a mapping; the message names the
    file.
    """
    try:
        content = yaml.load(file.read_text(), _Loader)
    except OSError as error:
        raise SettingsError(f"{file}: cannot be read ({error.strerror}); give the path of a YAML file") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SettingsError(f"{file}: not valid YAML: {error}") from error
    if not isinstance(content, dict):
        raise SettingsError(f"{file}: holds {type(content).__name__}; expected a mapping of keys to values")
    return content
