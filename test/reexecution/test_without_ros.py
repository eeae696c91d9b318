"""Bags are re-executed and reported where neither rclpy nor a message package can be imported."""

import json
import subprocess
import sys
from pathlib import Path

from contact_reach_ros.resources import share_directory

SAMPLE = share_directory() / "bags" / "sample"

WITHOUT_ROS = """
import sys

MISSING = ("ament_index_python", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "nav_msgs", "rcl_interfaces",
           "rclpy", "rosgraph_msgs", "sensor_msgs", "std_msgs", "std_srvs", "trajectory_msgs", "visualization_msgs")

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in MISSING:
            raise ImportError(f"{name} is missing here")

sys.meta_path.insert(0, Missing())
try:
    import rclpy
except ImportError:
    from contact_reach_ros.cli import main
    main(sys.argv[1:])
"""


def run(*arguments: str) -> str:
    command = [sys.executable, "-c", WITHOUT_ROS, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    return done.stdout


def test_reexecution(tmp_path: Path) -> None:
    file = tmp_path / "loops.json"
    assert "identical" in run("reexecute", str(SAMPLE), "--json", str(file))
    found = json.loads(file.read_text())
    assert found["controller"]["identical"] and found["observer"]["identical"]


def test_reexecution_of_a_plan(tmp_path: Path) -> None:
    file = tmp_path / "plan.json"
    assert "EQUAL within tolerances" in run("reexecute", str(SAMPLE), "--plan", "3", "--json", str(file))
    plan = json.loads(file.read_text())["plan"]
    assert plan["equal"] and plan["now"]["cost"] > 0.0


def test_report(tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    run("report", str(SAMPLE), "-o", str(page))
    assert page.stat().st_size > 1e6
