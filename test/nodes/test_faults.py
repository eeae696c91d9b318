"""The tool that makes things go wrong in the running stack, and what the driver does with a schedule."""

import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from stack_helpers import environment, module, ros, running, wait_for
from std_msgs.msg import Float64MultiArray, String
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.arms import load_arm
from contact_reach_ros.doctor import fault_tool as tool
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.simulation.fault_schedules import driver_faults

ARM = load_arm("iiwa14")


@pytest.fixture
def driver():
    with ros("--ros-args", "-p", "scene:=free"):
        node = DriverNode()
        node.boundary.protect(node)
        yield node


def send(node, text):
    (heard,) = (entry for entry in node.subscriptions if entry.topic_name.endswith(topics.SIM_FAULTS.name))
    heard.callback(String(data=text))
    node._tick(0)


class TestDriver:
    def test_a_schedule_counts_from_its_arrival(self, driver):
        for _ in range(5):
            driver._tick(0)
        send(driver, "push force='0 50 0' at=0.001 for=0.002")
        pushed = []
        for _ in range(4):
            pushed.append(bool(driver.robot.plant.data.xfrc_applied.any()))
            driver._tick(0)
        assert pushed == [False, True, True, False]

    def test_an_empty_schedule_ends_all_faults(self, driver):
        mass = driver.robot.plant.model.body_mass.sum()
        send(driver, "payload mass=3")
        assert driver.robot.plant.model.body_mass.sum() == pytest.approx(mass + 3.0)
        send(driver, "")
        assert driver.robot.plant.model.body_mass.sum() == pytest.approx(mass)
        assert driver.robot.faults is None

    def test_nan_commands_are_refused_and_counted(self, driver):
        send(driver, "nan_commands")
        driver._on_command(serialize_message(Float64MultiArray(data=[1.0] * 7)))
        driver._tick(0)
        assert driver.refused == {"commands": 1}
        assert driver.robot.drive.rejected == 1

    def test_what_is_no_schedule_is_refused_and_changes_nothing(self, driver):
        send(driver, "payload mass=3")
        for text in ("payload mass=100", "planner_silent", "obstacle; obstacle"):
            send(driver, text)
        assert driver.refused == {"faults": 3}
        assert driver.diagnosis()[1]["faults"] == "payload mass=3"

    def test_a_scene_with_nothing_but_a_floor_is_published_again_and_again_until_that_gets_lost(
        self, driver, monkeypatch
    ):
        driver._prepare_messages()
        shown = []
        monkeypatch.setattr(driver._obstacles, "publish", shown.append)
        for schedule, count in (("", 5), ("drop_obstacles", 0), ("", 5)):
            send(driver, schedule)
            shown.clear()
            for _ in range(100):
                driver._publish(driver._read())
                driver._tick(0)
            markers = [deserialize_message(data, MarkerArray).markers for data in shown]
            assert [[marker.text for marker in each] for each in markers] == count * [["floor"]]

    def test_nobody_has_to_answer_a_lost_state(self, driver):
        driver._prepare_messages()
        for schedule, answers in (("", 1), ("drop_states", 0), ("nan_states", 0), ("duplicate_states", 1)):
            send(driver, schedule)
            driver._tick(0)
            driver._publish(driver._read())
            assert driver._lockstep.unanswered == answers


def test_nodes_are_silenced_by_the_tool_not_by_the_driver():
    with pytest.raises(SettingsError, match="freeze or kill the node"):
        driver_faults("push; observer_silent", ARM)


@pytest.mark.parametrize("topic", tool.ATTACKED, ids=lambda topic: topic.name)
def test_disturbing_messages_are_of_the_topics_type(topic):
    message = tool.spoilt_message(topic, float("nan"), 0, ARM)
    assert isinstance(message, topic.type)
    assert "nan" in str(message)


def fake_process(proc: Path, number: int, arguments: list[str], domain: str) -> None:
    folder = proc / str(number)
    folder.mkdir()
    (folder / "cmdline").write_bytes("\0".join([*arguments, ""]).encode())
    (folder / "environ").write_bytes(f"HOME=/\0ROS_DOMAIN_ID={domain}\0".encode())


def test_processes_are_those_of_the_node_and_the_domain(tmp_path):
    fake_process(tmp_path, 1, ["python", "-m", "contact_reach_ros.nodes.planner", "--ros-args"], "7")
    fake_process(tmp_path, 2, ["python", "-m", "contact_reach_ros.nodes.planner"], "8")
    fake_process(tmp_path, 3, ["/usr/bin/python3", "/ws/lib/contact_reach_ros/controller"], "7")
    fake_process(tmp_path, 4, ["vim", "planner.py", "planner"], "7")
    fake_process(tmp_path, 5, ["python", "-m", "contact_reach_ros.bringup.bringup"], "7")
    fake_process(tmp_path, 6, ["/venv/bin/python", "/venv/bin/viewer"], "7")
    fake_process(tmp_path, 7, ["python", "-m", "contact_reach_ros.cli", "demo"], "7")
    user = (tmp_path / "1").stat().st_uid
    assert tool.node_processes("7", tmp_path, user) == {1: "planner", 3: "controller", 5: "bringup", 6: "viewer"}
    assert tool.node_processes("8", tmp_path, user) == {2: "planner"}
    assert tool.node_processes("7", tmp_path, user + 1) == {}


def test_processes_of_one_namespace_can_be_chosen(tmp_path):
    fake_process(tmp_path, 1, ["python", "-m", "contact_reach_ros.nodes.planner", "--ros-args"], "7")
    fake_process(tmp_path, 2, ["python", "-m", "contact_reach_ros.nodes.driver", "-r", "__ns:=/left"], "7")
    assert tool.node_processes("7", tmp_path, namespace="/") == {1: "planner"}
    assert tool.node_processes("7", tmp_path, namespace="/left") == {2: "driver"}
    assert len(tool.node_processes("7", tmp_path)) == 2


def test_rate_and_time_are_checked():
    with pytest.raises(InputError, match="rate 0"):
        tool.disturb(topics.COMMANDS.name, "nan", 0.0, 1.0, ARM)


def call(env: dict[str, str], *arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [*module("doctor.fault_tool"), *arguments], env=env, capture_output=True, text=True, timeout=120
    )


def state_of(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def test_tool_on_a_running_driver(tmp_path):
    env, log = environment(), tmp_path / "driver.log"
    lonely = call(env, "send", "push")
    assert lonely.returncode == 2 and "no simulated driver listens on sim/faults" in lonely.stderr
    assert "no process of node driver" in call(env, "freeze", "driver").stderr
    wrong = call(env, "send", "push forc=1")
    assert wrong.returncode == 2 and "did you mean 'force'" in wrong.stderr
    with running([*module("nodes.driver"), "--ros-args", "-p", "scene:=free"], env, log) as process:
        wait_for(lambda: "active" in log.read_text(), 60, "driver active")
        assert call(env, "send", "push at=1 for=0.1").returncode == 0
        wait_for(lambda: "faults: push at=1 for=0.1" in log.read_text(), 20, "schedule in the driver")
        assert call(env, "publish", topics.COMMANDS.name, "garbage", "--for", "0.5").returncode == 0
        wait_for(lambda: "effort_controller/commands" in log.read_text(), 20, "garbage refused")
        assert call(env, "freeze", "driver").returncode == 0
        assert state_of(process.pid) == "T"
        assert call(env, "continue", "driver").returncode == 0
        assert state_of(process.pid) != "T"
        assert call(env, "kill", "driver").returncode == 0
        assert process.wait(10) == -signal.SIGKILL


def test_zeros_are_finite():
    assert np.isfinite(tool.spoilt_message(topics.COMMANDS, 0.0, 0, ARM).data).all()
