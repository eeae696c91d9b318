"""Typed settings.

One declaration per value holds default, unit, range and description. ROS parameters, YAML files and the
documentation are all made from it, so they cannot disagree.
"""

from __future__ import annotations

import dataclasses
import difflib
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import yaml

from contact_reach_ros.errors import SettingsError

Scalar = bool | int | float | str
Value = Scalar | tuple[Scalar, ...] | None


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is known of one value: its name, default and the values it accepts."""

    name: str
    default: Value
    description: str
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]
    optional_length: int | None
    """Of a list of numbers that may be missing, which a default of None declares."""

    @property
    def kind(self) -> type:
        """Type of the value, or of the elements of a tuple."""
        if self.optional_length is not None:
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
        elif self.length is not None:
            words = f"a list of {self.length} values, each {words}"
        if self.minimum is not None or self.maximum is not None:
            low = "-inf" if self.minimum is None else f"{self.minimum:g}"
            high = "inf" if self.maximum is None else f"{self.maximum:g}"
            words += f" in [{low}, {high}]"
        words = f"{words} {self.unit}".rstrip()
        return words if self.optional_length is None else f"null, or {words}"

    def check(self, value: Any, where: str) -> Value:
        """Return `value` in the declared type.

        Raises
        ------
        SettingsError
            If the value has another type or length, is not finite, or lies outside the range; `where` is named.
        """
        if value is None and self.optional_length is not None:
            return None
        if self.length is not None:
            is_list = isinstance(value, Sequence) and not isinstance(value, str)
            if not is_list or (len(value) != self.length and not self.is_open_list):
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
) -> Any:
    """Declare one value of a `Settings` class; a list of numbers that may be missing has an `optional_length`."""
    metadata = {
        "description": description,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": tuple(choices),
        "optional_length": optional_length,
    }
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of the settings classes: frozen, and checked against its declarations when it is made."""

    def __post_init__(self) -> None:
        for entry in self.declared():
            checked = entry.check(getattr(self, entry.name), f"{type(self).__name__}.{entry.name}")
            object.__setattr__(self, entry.name, checked)

    @classmethod
    def declared(cls) -> Iterator[Setting]:
        """All values of the class, in the order of their declaration."""
        for field in dataclasses.fields(cls):
            yield Setting(name=field.name, default=field.default, **field.metadata)  # type: ignore[arg-type]

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], source: str) -> Self:
        """Make the settings from a mapping such as a YAML section.

        Raises
        ------
        SettingsError
            On an unknown key or a value that is not accepted; `source` (a file, a parameter prefix) is named.
        """
        known = {entry.name: entry for entry in cls.declared()}
        for key in mapping:
            if key not in known:
                raise SettingsError(unknown_key(str(key), known, source))
        return cls(**{key: known[key].check(value, f"{source}: {key}") for key, value in mapping.items()})


def unknown_key(key: str, known: Mapping[str, Any] | Sequence[str], source: str) -> str:
    """The message for a key that nobody declared, with the nearest declared one if there is any."""
    near = difflib.get_close_matches(key, list(known), n=1)
    hint = f"did you mean '{near[0]}'?" if near else "known keys: " + ", ".join(sorted(known))
    return f"{source}: unknown key '{key}'; {hint}"


def read_yaml(file: Path) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises
    ------
    SettingsError
        If the file cannot be read, is not YAML or holds no mapping; the file is named.
    """
    try:
        content = yaml.safe_load(file.read_text())
    except OSError as error:
        raise SettingsError(f"{file}: cannot be read ({error.strerror}); give the path of a YAML file") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SettingsError(f"{file}: not valid YAML: {error}") from error
    if not isinstance(content, dict):
        raise SettingsError(f"{file}: holds {type(content).__name__}; expected a mapping of keys to values")
    return content
