"""Build description: `colcon build` makes a ROS 2 package of it, `pip install` an ordinary Python package.

Name, version, description, maintainer and licence are those of package.xml.
"""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

MANIFEST = ElementTree.parse(Path(__file__).with_name("package.xml")).getroot()
NAME = MANIFEST.findtext("name")
SHARE = f"share/{NAME}"
NODES = ("driver", "controller", "observer", "planner", "adapter", "recorder", "replay", "bringup", "viewer")


def files_below(folder: str) -> list[Path]:
    """All files in `folder` and its subfolders that are not compiled Python."""
    paths = (path for path in Path(folder).rglob("*") if path.is_file())
    return sorted(path for path in paths if "__pycache__" not in path.parts)


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """`data_files` entries that install `folder`, with its subfolders, below the share directory."""
    by_directory: dict[Path, list[str]] = {}
    for path in files_below(folder):
        by_directory.setdefault(path.parent, []).append(str(path))
    return [(f"{SHARE}/{directory}", paths) for directory, paths in by_directory.items()]


setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description=MANIFEST.findtext("description"),
    maintainer=MANIFEST.findtext("maintainer"),
    maintainer_email=MANIFEST.find("maintainer").get("email"),
    license=MANIFEST.findtext("license"),
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: [str(path.relative_to(NAME)) for path in files_below(NAME) if path.suffix != ".py"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml", "constraints.txt"]),
        *shared("config"),
        *shared("launch"),
        *shared("msg_docs"),
        *shared("bags"),
    ],
    zip_safe=False,
    python_requires=">=3.11",
    # rclpy and the message packages are not listed: a sourced ROS 2 provides them, or else the extra `ros`.
    install_requires=[
        "brax",
        "jax",
        "jinja2",
        "llvmlite",
        "matplotlib",
        "mcap",
        "msgspec",
        "mujoco",
        "numba",
        "numpy",
        "pillow",
        "pin",
        "plotly",
        "pyyaml",
        "rich",
        "rosbags",
        "scipy",
        "trimesh",
        "viser",
        "websockets",
    ],
    extras_require={
        "benchmarks": ["ompl"],
        "ros": ["ros-jazzy-common-interfaces", "ros-jazzy-rclpy[fastrtps]"],
        "test": [
            "cma",
            "colcon-common-extensions",
            "hypothesis",
            "import-linter",
            "mcap-ros2-support",
            "mypy",
            "pytest",
            "pytest-xdist",
            "ruff",
            "xacro",
        ],
    },
    entry_points={
        "console_scripts": [
            "contact-reach = contact_reach_ros.cli:main",
            *(f"{node} = contact_reach_ros.executables:{node}" for node in NODES),
        ],
    },
)
