"""Versions of what the package stands on, against those that its tests run with."""

from __future__ import annotations

import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from contact_reach_ros.doctor.findings import Finding, failed, passed, warned
from contact_reach_ros.resources import share_directory

CONSTRAINTS = "constraints.txt"

_NEEDED = ("numpy", "scipy", "numba", "pin", "mujoco", "jax", "jaxlib", "brax", "mcap")
_OLDEST_PYTHON = (3, 11)


def python_packages(constraints: Path | None = None) -> Finding:
    """Python and the libraries that decide results: installed, and in the pinned versions."""
    name = "Python packages"
    python = platform.python_version()
    if sys.version_info < _OLDEST_PYTHON:
        fix = "make the environment again with a newer interpreter: make venv PYTHON=python3.12"
        return failed(name, f"Python {python}; 3.11 or newer is needed", fix)
    file = constraints or share_directory() / CONSTRAINTS
    pinned = _pinned(file)
    installed = {package: _version(package) for package in _NEEDED}
    missing = [package for package, number in installed.items() if not number]
    install = f"pip install -c {file} " if pinned else "pip install "
    if missing:
        return failed(name, f"not installed: {', '.join(missing)}", install + " ".join(missing), **installed)
    found = f"Python {python}, " + ", ".join(f"{package} {number}" for package, number in installed.items())
    others = [package for package, number in installed.items() if number != pinned.get(package, number)]
    if others:
        differ = ", ".join(f"{package} {installed[package]} (tested {pinned[package]})" for package in others)
        return warned(name, f"Python {python}; {differ}", install + " ".join(others), python=python, **installed)
    return passed(name, found, python=python, **installed)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _pinned(file: Path) -> dict[str, str]:
    """Versions in a constraints file; empty if there is none."""
    lines = file.read_text().splitlines() if file.is_file() else []
    return {name: number for name, equals, number in (line.partition("==") for line in lines) if equals}
