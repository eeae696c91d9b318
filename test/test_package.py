"""The package as users get it: built by colcon, found through the ament index, started as `ros2 run` does."""

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import Distribution, distributions
from pathlib import Path
from xml.etree import ElementTree

import pytest

import contact_reach_ros
from contact_reach_ros import resources
from contact_reach_ros.errors import ContactReachError

SOURCES = Path(__file__).resolve().parents[1]
PACKAGE = "contact_reach_ros"
NODES = {"driver", "controller", "observer", "planner", "adapter", "recorder", "replay", "bringup", "viewer"}
EXECUTABLES = {*NODES, "contact-reach"}
BUILD_FILES = ("package.xml", "setup.py", "setup.cfg", "pyproject.toml", "LICENSE", "constraints.txt")
BUILD_FOLDERS = ("resource", PACKAGE)
SHARED_FOLDERS = ("config", "launch", "msg_docs", "bags")


def run(command: list[str], directory: Path, environment: dict[str, str]) -> str:
    """Standard output of the command; if it fails, the test shows everything that the command wrote."""
    result = subprocess.run(command, cwd=directory, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, f"{command} failed:\n{result.stdout}\n{result.stderr}"
    return result.stdout


def files_in(directory: Path) -> set[Path]:
    files = (path.relative_to(directory) for path in directory.rglob("*") if path.is_file())
    return {file for file in files if "__pycache__" not in file.parts}


class Workspace:
    """A colcon build of a copy of the sources, and the environment that sourcing it makes."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.sources = directory / "src" / PACKAGE
        self.prefix = directory / "install" / PACKAGE
        self.share = self.prefix / "share" / PACKAGE
        self.executables = self.prefix / "lib" / PACKAGE
        self.sources.mkdir(parents=True)
        compiled = shutil.ignore_patterns("__pycache__")
        for name in (*BUILD_FILES, *BUILD_FOLDERS, *SHARED_FOLDERS):
            if (SOURCES / name).is_dir():
                shutil.copytree(SOURCES / name, self.sources / name, ignore=compiled)
            else:
                shutil.copy2(SOURCES / name, self.sources / name)
        tools = Path(sys.executable).parent
        path = f"{tools}{os.pathsep}{os.environ['PATH']}"
        # COLCON_HOME: the user's colcon defaults must not change this build.
        unsourced = {**os.environ, "PATH": path, "COLCON_HOME": str(directory)}
        run([str(tools / "colcon"), "build"], directory, unsourced)
        sourced = run(["bash", "-c", ". install/setup.bash && env -0"], directory, unsourced)
        self.environment = dict(entry.split("=", 1) for entry in sourced.split("\0") if entry)

    def run(self, *command: str) -> str:
        return run(list(command), self.directory, self.environment).strip()

    @property
    def distribution(self) -> Distribution:
        (site_packages,) = self.prefix.glob("lib/python3*/site-packages")
        (distribution,) = distributions(path=[str(site_packages)])
        return distribution


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return Workspace(tmp_path_factory.mktemp("workspace"))


def test_executables_are_where_ros2_run_looks_and_import_the_installed_copy(workspace):
    found = {file.name for file in workspace.executables.iterdir() if os.access(file, os.X_OK)}
    assert found == EXECUTABLES
    first_line = (workspace.executables / "driver").read_text().splitlines()[0]
    assert first_line.startswith("#!")
    locate = "from contact_reach_ros import resources as r; print(r.__file__); print(r.share_directory())"
    module, share = workspace.run(first_line.removeprefix("#!").strip(), "-c", locate).splitlines()
    assert Path(module).is_relative_to(workspace.prefix)
    assert Path(share) == workspace.share


def test_every_shared_file_is_installed_and_versions_agree(workspace):
    for folder in SHARED_FOLDERS:
        installed = files_in(workspace.share / folder)
        assert installed and installed == files_in(workspace.sources / folder)
    manifest = ElementTree.parse(workspace.share / "package.xml")
    assert manifest.findtext("version") == workspace.distribution.version == contact_reach_ros.__version__


DRIVERS = {"controller_manager_msgs", "franka_msgs", "lbr_fri_idl"}
"""Packages of robots' drivers, imported where they are installed."""


def test_the_manifest_lists_the_ros_packages_that_are_imported_or_started():
    files = [*SOURCES.glob("contact_reach_ros/**/*.py"), *SOURCES.glob("launch/*.py")]
    text = "\n".join(file.read_text() for file in files)
    names = r"\w+_msgs|\w+_interfaces|\w+_idl|rclpy|launch_ros|launch|tf2_ros"
    imported = set(re.findall(rf"^\s*(?:from|import) ({names})\b", text, re.MULTILINE))
    started = set(re.findall(r'package="(\w+)"', text))
    assert {"sensor_msgs", "tf2_ros", "launch_ros"} <= imported and "rviz2" in started
    needed = {"tf2_ros_py" if name == "tf2_ros" else name for name in imported | started} - DRIVERS
    listed = {entry.text for entry in ElementTree.parse(SOURCES / "package.xml").iter("exec_depend")}
    assert needed <= listed


@pytest.fixture
def installed_module(tmp_path, monkeypatch):
    """Makes the package believe that it is installed below `tmp_path`."""
    module = tmp_path / "lib" / "python3.12" / "site-packages" / PACKAGE / "resources.py"
    monkeypatch.setattr(resources, "__file__", str(module))
    return tmp_path


def test_missing_share_directory_names_the_places(installed_module, monkeypatch):
    monkeypatch.setattr(sys, "prefix", str(installed_module / "environment"))
    with pytest.raises(ContactReachError) as raised:
        resources.share_directory()
    assert str(installed_module / "share" / PACKAGE) in str(raised.value)
    assert str(installed_module / "environment" / "share" / PACKAGE) in str(raised.value)


def test_missing_config_file_names_the_existing_ones(installed_module):
    config = installed_module / "share" / PACKAGE / "config"
    (config / "scenes").mkdir(parents=True)
    (config.parent / "package.xml").touch()
    (config / "scenes" / "ball.yaml").touch()
    assert resources.config_file("scenes/ball.yaml") == config / "scenes" / "ball.yaml"
    with pytest.raises(ContactReachError, match=r"scenes/bell\.yaml.*scenes/ball\.yaml"):
        resources.config_file("scenes/bell.yaml")


def test_the_cache_directory_follows_xdg_and_an_unusable_one_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert resources.cache_directory() == tmp_path / "cache" / PACKAGE
    assert resources.cache_directory().is_dir()
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(ContactReachError, match="XDG_CACHE_HOME"):
        resources.cache_directory()
