"""Schedules of faults, as text and as YAML files."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.plant.fault_kinds import KINDS, Fault, Schedule, public_key
from contact_reach_ros.settings import Setting, read_yaml, unknown_key

_KIND = "kind"
_LIST = "faults"
_YAML = (".yaml", ".yml")


def parse_faults(text: str) -> Schedule:
    """A schedule from text such as ``push link=lbr_link_4 force="0 50 0" at=2 for=0.1; drop_commands share=0.3``.

    Parameters
    ----------
    text
        Faults separated by semicolons, each a kind and its keys; or the path of a YAML file, see `read_faults`. An
        empty text is an empty schedule.

    Raises
    ------
    SettingsError
        On an unknown kind or key, or a value that is not accepted; fault and key are named.
    """
    if text.strip().endswith(_YAML):
        return read_faults(Path(text.strip()))
    faults = []
    for number, part in enumerate((part.strip() for part in text.split(";")), 1):
        if not part:
            continue
        source = f"fault {number}"
        try:
            kind, *pairs = shlex.split(part)
        except ValueError as error:
            raise SettingsError(f"{source}, '{part}': {error}; expected 'kind key=value ...'") from error
        values: dict[str, Any] = {}
        for pair in pairs:
            key, equals, value = pair.partition("=")
            if not equals:
                raise SettingsError(f"{source}, '{pair}': expected key=value, quoted if the value holds blanks")
            if key in values:
                raise SettingsError(f"{source}: {key} is given twice")
            values[key] = value
        faults.append(_make(kind, values, source, _from_text))
    return tuple(faults)


def read_faults(file: Path) -> Schedule:
    """A schedule from a YAML file: a list `faults`, each with its `kind` and keys.

    Raises
    ------
    SettingsError
        If the file cannot be read or a fault is not accepted; file, fault and key are named.
    """
    content = read_yaml(file)
    for key in content:
        if key != _LIST:
            raise SettingsError(unknown_key(str(key), [_LIST], str(file)))
    entries = content.get(_LIST)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise SettingsError(f"{file}: {_LIST} is no list of mappings; expected '- kind: push', and its keys below")
    faults = []
    for number, entry in enumerate(entries, 1):
        source = f"{file}: fault {number}"
        values = {str(key): value for key, value in entry.items()}
        if _KIND not in values:
            raise SettingsError(f"{source} has no kind; expected one of {', '.join(KINDS)}")
        faults.append(_make(str(values.pop(_KIND)), values, source, lambda value, _: value))
    return tuple(faults)


def _make(kind: str, values: Mapping[str, Any], source: str, convert: Callable[[Any, Setting], Any]) -> Fault:
    if kind not in KINDS:
        raise SettingsError(unknown_key(kind, KINDS, source).replace("unknown key", "unknown kind"))
    known = {public_key(entry): entry for entry in KINDS[kind].declared()}
    made: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            raise SettingsError(unknown_key(key, known, f"{source}, {kind}"))
        entry = known[key]
        made[entry.name] = entry.check(convert(value, entry), f"{source}, {kind}: {key}")
    return KINDS[kind](**made)


def _from_text(value: str, entry: Setting) -> Any:
    """The value that a text stands for; the text itself where it stands for none, which `check` then refuses."""
    if entry.kind is not float:
        return value
    try:
        numbers = [float(word) for word in value.split()]
    except ValueError:
        return value
    if entry.length is not None:
        return numbers
    return numbers[0] if len(numbers) == 1 else value
