"""Versions of the software behind a result: libraries, and the revision of this package's sources."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

VERSION = "0.2.0"
"""Version of this package, the same as in package.xml."""

_PACKAGES = ("contact-reach-ros", "jax", "brax", "mujoco", "numba", "numpy", "pin", "mcap", "ros-rclpy")
"""Packages that results depend on; `ros-rclpy` is there where rclpy comes as a wheel."""
_PATIENCE_S = 5.0


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, as far as they are installed."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def git_revision() -> str | None:
    """Commit of the checkout that this package runs from, with "-dirty" if files differ; None outside a checkout."""
    checkout = Path(__file__).resolve().parents[1]
    # An installed package may lie inside somebody else's checkout.
    if not (checkout / ".git").exists():
        return None
    commit = _git(checkout, "rev-parse", "HEAD")
    changes = _git(checkout, "status", "--porcelain", "--untracked-files=no")
    if not commit or changes is None:
        return None
    return f"{commit}-dirty" if changes else commit


def _git(checkout: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(checkout), *arguments]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() if result.returncode == 0 else None
