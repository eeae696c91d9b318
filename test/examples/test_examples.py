"""The programs in examples/ and in the documentation run as a user runs them."""

import ast
import re
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
from contact_reach_command import python
from geometry_msgs.msg import PoseStamped
from stack_helpers import environment, ros, running

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
ARGUMENTS = {"sweep.py": ["--scenes", "ball", "--seeds", "2"]}
EXPECTED = {
    "plan_once.py": r"solver steps in .*wrote plan\.png",
    "closed_loop.py": r"mm from the goal after \d",
    "own_simulator.py": r"10\.0 mm from the goal after .*springs were loaded with [1-9]",
    "own_cost_term.py": r"weight 0: reached.*weight 1: reached",
    "own_solver.py": r"reached: True",
    "sweep.py": r"ball +2 +2 ",
}
"""What each prints."""
BESIDE_A_STACK = "moving_goal.py"
"""It has a test of its own."""


def blocks(page: str, language: str = "python") -> list[str]:
    """The code blocks of a page."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


def test_every_example_is_run_and_short_and_explains_itself():
    files = sorted(EXAMPLES.glob("*.py"))
    assert [file.name for file in files] == sorted([*EXPECTED, BESIDE_A_STACK])
    for file in files:
        text = file.read_text()
        assert len(text.splitlines()) < 60, file
        assert ast.get_docstring(ast.parse(text)), file
        assert file.name in (ROOT / "docs" / "library.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPECTED)
def test_example(name, tmp_path):
    printed = python((EXAMPLES / name).read_text(), *ARGUMENTS.get(name, []), cwd=tmp_path)
    assert re.search(EXPECTED[name], printed, re.DOTALL), printed
    if name == "plan_once.py":
        assert (tmp_path / "plan.png").stat().st_size > 10_000
    if name == "own_cost_term.py":
        without, with_it = (int(height) for height in re.findall(r"at most (\d+) mm above", printed))
        assert with_it > without + 30


@pytest.mark.slow
def test_program_of_the_library_page_reaches_its_goal(tmp_path):
    program = blocks("docs/library.md")[0]
    assert program in blocks("README.md")
    *_, last = python(program, cwd=tmp_path).splitlines()
    assert re.fullmatch(r"True \d\.\d+ [1-9]\.\d N of 10 N", last), last


def test_blocks_of_the_page_on_extending_run(tmp_path):
    (tmp_path / "my_scene.yaml").write_text(blocks("docs/extending.md", "yaml")[0])
    python("\n".join(blocks("docs/extending.md")), cwd=tmp_path)


def test_goals_are_sent_on_a_circle_until_ctrl_c(tmp_path):
    env, goals = environment(), []
    command = [sys.executable, str(EXAMPLES / BESIDE_A_STACK)]
    with running(command, env, tmp_path / "out.txt") as process, ros(domain=env["ROS_DOMAIN_ID"]):
        node = rclpy.create_node("planner")
        node.create_subscription(PoseStamped, "goal_pose", goals.append, 10)
        end = time.monotonic() + 60.0
        while len(goals) < 20 and time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.1)
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0, (tmp_path / "out.txt").read_text()
    places = np.array([(goal.pose.position.x - 0.55, goal.pose.position.y) for goal in goals])
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 0.1)
    times = np.array([goal.header.stamp.sec + 1e-9 * goal.header.stamp.nanosec for goal in goals])
    angles = np.unwrap(np.arctan2(places[:, 1], places[:, 0]))
    np.testing.assert_allclose(np.diff(angles) / np.diff(times), 0.5, rtol=1e-3)
    assert "Traceback" not in (tmp_path / "out.txt").read_text()
