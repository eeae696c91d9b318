"""Locations of the package's files that are not Python code and of its cache, and the versions behind a result."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import pickle
import platform
import shutil
import sys
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from contact_reach_ros.errors import ContactReachError, InputError

T = TypeVar("T")

PACKAGE = "contact_reach_ros"
VERSION = "0.3.0"
"""Version of this package, the same as in package.xml."""

_PACKAGES = ("contact-reach-ros", "jax", "brax", "mujoco", "numba", "numpy", "pin", "mcap", "ros-rclpy")
"""Packages that results depend on; `ros-rclpy` is there where rclpy comes as a wheel."""


def share_directory() -> Path:
    """Directory that holds `package.xml`, `config/`, `launch/` and `msg_docs/`.

    It is the source checkout if the package runs from one, else `share/contact_reach_ros` of the prefix that
    colcon or pip installed the package in. Raises `ContactReachError` if no such directory exists; the message lists
    the places searched.
    """
    module = Path(__file__).resolve()
    checkout = module.parents[1]
    installed = [prefix / "share" / PACKAGE for prefix in (*module.parents[2:], Path(sys.prefix))]
    candidates = [checkout, *dict.fromkeys(installed)]
    for candidate in candidates:
        if (candidate / "package.xml").is_file() and (candidate / "config").is_dir():
            return candidate
    places = "\n".join(f"  {candidate}" for candidate in candidates)
    raise ContactReachError(
        f"the configuration of {PACKAGE} is missing: expected package.xml and config/ in one of\n{places}\n"
        "Install the package again with `pip install .` or `colcon build`."
    )


def config_file(name: str) -> Path:
    """Path of a file in `config/`.

    Raises `ContactReachError` if there is no such file; the message lists the existing ones.

    Parameters
    ----------
    name
        Path relative to `config/`, such as `scenes/ball.yaml`.
    """
    directory = share_directory() / "config"
    path = directory / name
    if not path.is_file():
        existing = sorted(str(file.relative_to(directory)) for file in directory.rglob("*") if file.is_file())
        raise ContactReachError(f"no file '{name}' in {directory}; expected one of: {', '.join(existing)}")
    return path


def cache_directory() -> Path:
    """Directory of the user's cache for this package; it is created if it does not exist.

    Raises `ContactReachError` if it cannot be created.
    """
    setting = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG specification says to ignore relative paths.
    parent = Path(setting) if os.path.isabs(setting) else Path.home() / ".cache"
    directory = parent / PACKAGE
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ContactReachError(
            f"cannot create the cache directory {directory}: {error.strerror}; "
            "set XDG_CACHE_HOME to a directory that can be written"
        ) from error
    return directory


def kept(parts: tuple[object, ...], make: Callable[[], T]) -> T:
    """What `make` returns, out of the user's cache if it has been made before from the same parts.

    Parameters
    ----------
    parts
        Everything that the value depends on.
    make
        Makes it; that it cannot be kept is no error, and what is damaged is made anew.
    """
    name = hashlib.sha256(repr(parts).encode()).hexdigest()[:32]
    try:
        file = cache_directory() / f"{name}.pickle"
    except ContactReachError:
        return make()
    with contextlib.suppress(Exception):  # pickle raises whatever another version's file leads to
        digest, content = (stored := file.read_bytes())[:32], stored[32:]
        if digest == hashlib.sha256(name.encode() + content).digest():
            known: T = pickle.loads(content)
            return known
    value = make()
    content = pickle.dumps(value)
    with contextlib.suppress(OSError):
        new = file.with_suffix(f".{os.getpid()}")
        new.write_bytes(hashlib.sha256(name.encode() + content).digest() + content)
        new.replace(file)
    return value


def write_text(file: Path, text: str) -> None:
    """Write a file that an option names, in a new folder if need be; one that is there stays if there is no room.

    Raises `InputError` if it cannot be written.
    """
    # Names of files need not be text.
    content = text.encode("utf-8", errors="backslashreplace")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.is_file() and shutil.disk_usage(file).free + file.stat().st_size < len(content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        file.write_bytes(content)
    except OSError as error:
        raise InputError(f"'{file}' cannot be written: {error.strerror}; name a file in a folder of yours") from error


def write_json(file: Path, content: Any) -> None:
    """Write a JSON file as `write_text`, with null for numbers that JSON does not have."""
    write_text(file, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, as far as they are installed."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
