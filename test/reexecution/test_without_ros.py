"""Bags are re-executed and reported where neither rclpy nor a message package can be imported."""

import json
from pathlib import Path

from contact_reach_command import python

from contact_reach_ros.resources import share_directory

SAMPLE = str(share_directory() / "bags" / "sample")

WITHOUT_ROS = """
import json, sys

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
    for arguments in json.loads(sys.argv[1]):
        try:
            main(arguments)
        except SystemExit as end:
            assert not end.code, (arguments, end.code)
"""


def test_bags_are_reexecuted_and_reported(tmp_path: Path) -> None:
    loops, plan, page = (str(tmp_path / name) for name in ("loops.json", "plan.json", "report.html"))
    commands = [
        ["reexecute", SAMPLE, "--json", loops],
        ["reexecute", SAMPLE, "--plan", "3", "--json", plan],
        ["report", SAMPLE, "-o", page],
    ]
    printed = python(WITHOUT_ROS, json.dumps(commands))
    assert "identical" in printed and "EQUAL within tolerances" in printed
    found = json.loads(Path(loops).read_text())
    assert found["controller"]["identical"] and found["observer"]["identical"]
    solved = json.loads(Path(plan).read_text())["plan"]
    assert solved["equal"] and solved["now"]["cost"] > 0.0
    assert Path(page).stat().st_size > 1e6
