"""`ros2 launch` with launch's own service: namespaces, arguments, and two arms in one launch file."""

import json
import signal
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import rclpy
import yaml
from stack_helpers import (
    SMALL_PLANNER,
    command_lines,
    environment,
    parameter_file,
    prefix,
    processes_of_domain,
    ready,
    ros,
    running,
    wait_for,
)

from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arms import load_arm
from contact_reach_ros.messages import topics
from contact_reach_ros.resources import share_directory
from contact_reach_ros.ros.inbox import qos_profile

pytest.importorskip("launch_ros", reason="needs launch_ros, which ROS has and no registry")
# Processes that import for seconds; a busy machine has no effect on what they say.
pytestmark = pytest.mark.slow

HERE = Path(__file__).parent
LAUNCH = [sys.executable, str(HERE / "launching.py")]
TOLD = "told "
STACK = {"driver", "observer", "controller", "planner"}
CAREFUL = {"supervision": {"gravity_compensation": False}, "limits": {"torque_rate": 1000.0}}
"""What an FR3 needs of the controller, or it has gravity twice."""


def told(text):
    """Settings by full name of the nodes that have told theirs."""
    found = [json.loads(line.partition(TOLD)[2]) for line in text.splitlines() if TOLD in line]
    return {f"{space.rstrip('/')}/{name}": settings for space, name, settings in found}


@contextmanager
def launch(folder, *arguments, command=LAUNCH, count=4, domain=None):
    """Settings by full name of the nodes that launch starts, as each tells them, and the output."""
    env = {**environment(), **prefix(folder / "prefix", f"{HERE / 'telling.py'} {{}}")}
    env |= {"ROS_DOMAIN_ID": domain} if domain else {}
    output = folder / "launch.txt"
    with running([*command, *map(str, arguments)], env, output) as process:
        wait_for(lambda: output.read_text().count(TOLD) >= count or process.poll() is not None, 240, "nodes tell")
        yield told(output.read_text()), output.read_text()
        process.send_signal(signal.SIGINT)
        process.wait(30)


@pytest.mark.parametrize(
    ("arguments", "space"),
    [
        (["--push", "left"], "/left"),
        (["--push", "cell", "--push", "left", "namespace:=arm"], "/cell/left/arm"),
    ],
)
def test_every_node_reads_its_section_in_the_namespace(arguments, space, tmp_path):
    file = parameter_file(tmp_path / "own.yaml", controller=CAREFUL, observer={"safety": {"debounce": 5}})
    given = [f"parameters:={file}", "overrides:=driver:seed=3 'planner:speed_scale=0.5'", "log_level:=warn"]
    given += ["remappings:=joint_states:=franka/joint_states /clock:=/clock", "use_sim_time:=true"]
    with launch(tmp_path, *arguments, *given) as (nodes, output):
        assert set(nodes) == {f"{space}/{name}" for name in STACK}, output
        controller, observer = nodes[f"{space}/controller"], nodes[f"{space}/observer"]
        assert not controller["supervision.gravity_compensation"] and controller["limits.torque_rate"] == 1000.0
        # Those of the observer with which it watches itself.
        assert observer["safety.debounce"] == controller["safety.debounce"] == 5
        assert nodes[f"{space}/driver"]["seed"] == 3 and nodes[f"{space}/planner"]["speed_scale"] == 0.5
        assert all(settings["use_sim_time"] for settings in nodes.values())


def test_two_arms_have_a_namespace_each_and_share_a_file(tmp_path):
    file = tmp_path / "own.yaml"
    sections = {"controller": CAREFUL, "/left/controller": {"limits": {"torque_rate": 500.0}}}
    # Of two sections for a node the later one holds.
    written = {name: {"ros__parameters": content} for name, content in sections.items()}
    file.write_text(yaml.safe_dump(written, sort_keys=False))
    with launch(tmp_path, "--file", "two_arms.launch.py", f"parameters:={file}", count=8) as (nodes, output):
        assert set(nodes) == {f"/{space}/{name}" for space in ("left", "right") for name in STACK}, output
        left, right = nodes["/left/controller"], nodes["/right/controller"]
        assert (left["robot"], right["robot"]) == ("iiwa14", "fr3")
        assert (left["limits.torque_rate"], right["limits.torque_rate"]) == (500.0, 1000.0)
        assert not (left["supervision.gravity_compensation"] or right["supervision.gravity_compensation"])


def test_the_arm_is_the_one_that_is_described_in_the_namespace(tmp_path):
    domain, topic = environment()["ROS_DOMAIN_ID"], topics.ROBOT_DESCRIPTION
    arm = load_arm("fr3")
    with ros(domain=domain):
        node = rclpy.create_node("robot_state_publisher", namespace="left")
        publisher = node.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
        publisher.publish(topic.type(data=build_urdf(arm)))
        given = ["namespace:=left", "robot:=robot_description", "driver:=false"]
        with launch(tmp_path, *given, count=3, domain=domain) as (nodes, output):
            assert set(nodes) == {f"/left/{name}" for name in STACK - {"driver"}}, output
            (described,) = {settings["robot"] for settings in nodes.values()}
    assert load_arm(described).joint_names == arm.joint_names


OWN_FILE = """
from launch import LaunchDescription
from launch.actions import GroupAction
from launch_ros.actions import Node, PushRosNamespace, SetParameter

def generate_launch_description():
    def node(executable, **more):
        return Node(package="contact_reach_ros", executable=executable, output="screen", **more)
    return LaunchDescription([GroupAction([
        PushRosNamespace("cell"),
        SetParameter("state_rate", 500.0),
        node("controller", parameters=["{file}"]),
        node("observer", namespace="left", name="observer", parameters=["{file}", {{"safety.debounce": 6}}]),
    ])])
"""


def test_nodes_of_a_users_own_launch_file_read_their_sections_too(tmp_path):
    file = parameter_file(tmp_path / "own.yaml", controller=CAREFUL, observer={"momentum": {"torque_cutoff": 20.0}})
    own = tmp_path / "own.launch.py"
    own.write_text(OWN_FILE.format(file=file))
    with launch(tmp_path, "--file", own, count=2) as (nodes, output):
        assert set(nodes) == {"/cell/controller", "/cell/left/observer"}, output
        controller, observer = nodes["/cell/controller"], nodes["/cell/left/observer"]
        assert not controller["supervision.gravity_compensation"] and controller["limits.torque_rate"] == 1000.0
        assert (observer["momentum.torque_cutoff"], observer["safety.debounce"]) == (20.0, 6)
        assert observer["state_rate"] == pytest.approx(500.0)


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        (["contrller"], "unknown node 'contrller'; did you mean 'controller'"),
        (["/lefft/controller"], "/lefft/controller: the controller is in namespace /left"),
    ],
)
def test_a_section_that_no_node_reads_ends_the_launch(sections, said, tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text(yaml.safe_dump({name: {"ros__parameters": CAREFUL} for name in sections}))
    with launch(tmp_path, "--push", "left", f"parameters:={file}", count=1) as (nodes, output):
        assert not nodes and said in output


@pytest.mark.parametrize("name", ["bringup.launch.py", "two_arms.launch.py"])
def test_the_arguments_are_described(name):
    """As `ros2 launch -s` shows them."""
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    source = PythonLaunchDescriptionSource(str(share_directory() / "launch" / name))
    listed = source.try_get_launch_description_without_context().get_launch_arguments()
    shown = {argument.name: argument.description for argument in listed}
    assert set(shown) >= {"namespace", "overrides", "remappings", "log_level", "use_sim_time", "robot", "rviz"}
    assert all(shown.values()) and "one of none, effort, lbr, franka" in shown["adapter"]


def test_two_arms_reach_their_goals(tmp_path):
    pause = {"supervision": {"hold_limit": 1000.0}}
    file = parameter_file(tmp_path / "small.yaml", planner=SMALL_PLANNER, controller=pause)
    env = {**environment(), **prefix(tmp_path / "prefix")}
    output = tmp_path / "launch.txt"
    given = [f"parameters:={file}", "scene:=free", "lockstep:=true"]
    with running([*LAUNCH, "--file", "two_arms.launch.py", *given], env, output) as process:
        for number in (1, 2):
            wait_for(
                lambda: output.read_text().count("planner]: active") >= number or process.poll() is not None,  # noqa: B023
                300,
                "both planners are active",
            )
        ready(process, output, "planner]: active")
        goals = [f"goto 0.5 0.1 0.4 --wait --timeout 60 --namespace {name}" for name in ("left", "right")]
        for code, line in command_lines(env, *goals):
            assert code == 0 and "settled: " in line, output.read_text()
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    wait_for(lambda: not processes_of_domain(env["ROS_DOMAIN_ID"]), 20, "all processes have ended")
