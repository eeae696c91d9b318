"""Parameter files of ROS nodes, without ROS."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import read_yaml


def full_name(prefix: str, name: str) -> str:
    """Name of a parameter."""
    return f"{prefix}.{name}" if prefix else name


def parameters_in(file: Path, node_name: str) -> dict[str, Any]:
    """The parameters of a file that concern a node, flattened to dotted names.

    Raises
    ------
    SettingsError
        If the file cannot be read or is no parameter file.
    """
    found: dict[str, Any] = {}
    for pattern, content in read_yaml(file).items():
        if not isinstance(content, dict) or "ros__parameters" not in content:
            raise SettingsError(f"{file}: '{pattern}' has no ros__parameters; expected '<node>: ros__parameters: ...'")
        if fnmatch.fnmatch(f"/{node_name}", str(pattern)) or str(pattern).strip("/") == node_name:
            parameters = content["ros__parameters"] or {}
            if not isinstance(parameters, dict):
                raise SettingsError(f"{file}: {pattern}.ros__parameters is no mapping of keys to values")
            found.update(_flatten(parameters))
    return found


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        name = full_name(prefix, str(key))
        if isinstance(value, dict):
            flat.update(_flatten(value, name))
        else:
            flat[name] = value
    return flat
