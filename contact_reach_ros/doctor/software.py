"""Checks of the installed software and of the parameters that the nodes would start with."""

from __future__ import annotations

import importlib.metadata
import os
import sys
from pathlib import Path

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.doctor.findings import Finding, check, failed, passed, warned
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.parameter_check import check_parameters
from contact_reach_ros.parameter_files import NODES, parameters_in
from contact_reach_ros.resources import share_directory

CONSTRAINTS = "constraints.txt"

_NEEDED = ("numpy", "scipy", "numba", "pin", "mujoco", "jax", "jaxlib", "brax", "mcap")
_DISTRIBUTION = "jazzy"


@check("Python packages")
def python_packages(constraints: Path | None = None) -> Finding:
    """Check the libraries that decide results: installed, and in the pinned versions."""
    file = constraints or share_directory() / CONSTRAINTS
    lines = file.read_text().splitlines() if file.is_file() else []
    pinned = {name: number for name, equals, number in (line.partition("==") for line in lines) if equals}
    installed = {package: _version(package) for package in _NEEDED}
    missing = [package for package, number in installed.items() if not number]
    install = f"{sys.executable} -m pip install " + (f"-c {file} " if pinned else "")
    if missing:
        return failed(f"not installed: {', '.join(missing)}", install + " ".join(missing), **installed)
    others = [package for package, number in installed.items() if number != pinned.get(package, number)]
    if others:
        differ = ", ".join(f"{package} {installed[package]} (tested {pinned[package]})" for package in others)
        return warned(differ, install + " ".join(others), **installed)
    return passed(", ".join(f"{package} {number}" for package, number in installed.items()), **installed)


@check("rclpy")
def ros_version() -> Finding:
    """Check which rclpy this is, and where it comes from."""
    import rclpy

    distribution, wheels = os.environ.get("ROS_DISTRO", ""), _version("ros-rclpy")
    number = f"{wheels} from unofficial wheels" if wheels else _manifest_version("rclpy")
    place = str(Path(rclpy.__file__).parent)
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    sourced = any(place.startswith(prefix) for prefix in prefixes if prefix)
    if distribution and not sourced:
        fix = "use the interpreter and environment that ROS uses (make venv with ROS sourced), or a shell without ROS"
        return warned(f"ROS 2 {distribution} is sourced, but rclpy {number} is imported from elsewhere", fix)
    if sourced and distribution != _DISTRIBUTION:
        fix = f"source ROS 2 {_DISTRIBUTION}: source /opt/ros/{_DISTRIBUTION}/setup.bash"
        return warned(f"rclpy {number}, ROS 2 {distribution or 'of unknown name'}", fix)
    words = f"{number}: for trying and testing; a robot uses the ROS 2 {_DISTRIBUTION} that is sourced"
    return passed(words if wheels else f"{number}, sourced ROS 2 {distribution}", wheels=bool(wheels))


@check("parameters")
def parameter_file(file: Path) -> Finding:
    """Check whether the nodes would start with the parameters of a file."""
    try:
        check_parameters(file)
    except ContactReachError as error:
        return failed(str(error), f"correct {file}; the pages in msg_docs/ list what each node accepts")
    return passed(f"{file}: valid for {', '.join(NODES)}")


@check("contact budget")
def contact_budget(file: Path, arm: Arm) -> Finding:
    """Check whether planner and observer have a contact budget, and the same."""
    paths = {node: parameters_in(file, node).get("contact_budget", "") for node in ("planner", "observer")}
    fix = "set contact_budget of planner and observer to one readable file (see config/contact_budget.yaml)"
    try:
        planner, observer = (load_budget(path).resolve(arm) for path in paths.values())
    except ContactReachError as error:
        return failed(str(error), fix)
    if planner != observer:
        return failed(f"planner and observer read different budgets: {paths}", fix)
    thresholds = ", ".join(f"{value:g}" for value in planner.torque_thresholds)
    joints = f"{arm.joint_names[0]} to {arm.joint_names[-1]}"
    return passed(f"{planner.permitted_force:g} N on one body, stop above {thresholds} Nm ({joints})")


def _version(package: str) -> str:
    """Version of an installed distribution; empty if there is none."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _manifest_version(package: str) -> str:
    """Version in the manifest of a ROS package."""
    from ament_index_python.packages import get_package_share_directory

    manifest = Path(get_package_share_directory(package)) / "package.xml"
    return manifest.read_text().partition("<version>")[2].partition("<")[0]
