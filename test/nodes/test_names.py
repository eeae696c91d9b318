"""A node applies its own section of a parameter file by its own name, in whatever namespace it is."""

import pytest
import yaml

from contact_reach_ros.bringup import bringup
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.nodes.viewer import ViewerNode
from contact_reach_ros.ros import process
from contact_reach_ros.ros.process import in_namespace, run

OWN = {
    ControllerNode: {"supervision": {"gravity_compensation": False}, "limits": {"torque_rate": 1000.0}},
    DriverNode: {"scene": "free", "seed": 7},
    ObserverNode: {"momentum": {"torque_cutoff": 20.0}, "safety": {"debounce": 5}},
    PlannerNode: {"period": 0.1, "planning": {"population": 32, "max_steps": 3}},
    AdapterNode: {"kind": "effort", "effort": {"ask_joints": False}},
    RecorderNode: {"bag": "somewhere", "custom_data": ["a=b"]},
    ViewerNode: {"port": 0},
}
"""What the file has for each node; none of it is the default."""
WAYS = {
    "/": [],
    "/left": in_namespace("left"),
    "/right": ["--ros-args", "-r", "__ns:=/right"],
    "/cell/left": ["--ros-args", "--remap", "__ns:=/cell/left", "-r", "__ns:=/other"],
}
"""Arguments that put a node into a namespace."""


def flat(tree, prefix=""):
    for key, value in tree.items():
        yield from flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(f"{prefix}{key}", value)]


@pytest.fixture
def start(tmp_path, monkeypatch, capsys):
    """Runs a node with sections of a parameter file, and hands over what `see` gives, or what the refusal says."""
    monkeypatch.chdir(tmp_path)

    def started(node_class, sections, *arguments, see=lambda node: node):
        file, seen = tmp_path / "own.yaml", []
        file.write_text(yaml.safe_dump({name: {"ros__parameters": content} for name, content in sections.items()}))
        monkeypatch.setattr(process, "_serve", lambda node: seen.append(see(node)) or 0)
        code = run(node_class, [node_class.NAME, *arguments, "--ros-args", "--params-file", str(file)])
        assert (code == 0) == bool(seen)
        return seen[0] if seen else capsys.readouterr().err

    return started


@pytest.mark.parametrize("space", WAYS)
@pytest.mark.parametrize("node_class", OWN, ids=lambda node_class: node_class.NAME)
def test_every_node_reads_its_section_in_every_namespace(node_class, space, start):
    sections = {other.NAME: content for other, content in OWN.items()}

    def see(node):
        reported = node.reported_settings()
        parameters = {name: node.get_parameter(name).value for name, _ in flat(OWN[node_class])}
        return node.get_namespace(), reported, parameters

    found, reported, parameters = start(node_class, sections, *WAYS[space], see=see)
    assert found == space
    for name, value in flat(OWN[node_class]):
        assert parameters[name] == value
        assert reported[name] == (tuple(value) if isinstance(value, list) else value)


@pytest.mark.parametrize(
    "section", ["/cell/left/{}", "/**/{}", "/*/*/{}", "/cell/**", "cell/left/{}", "/**", "/*", "{}"]
)
def test_sections_with_a_namespace_hold_there(section, start):
    sections = {section.format("observer"): OWN[ObserverNode]} if "{}" in section else {section: {"cpus": "0"}}
    node = start(ObserverNode, sections, *WAYS["/cell/left"], see=lambda node: (node.cpus, node.settings["safety"]))
    assert node[0] == "0" if "{}" not in section else node[1].debounce == 5


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"contrller": {}}, "unknown node 'contrller'; did you mean 'controller'"),
        ({"/cell/left/contrller": {}}, "unknown node 'contrller'; did you mean 'controller'"),
        ({"camera": {"rate": 30}}, "unknown node 'camera'"),
        (
            {"/left/observer": {}, "/right/observer": {}},
            "/left/observer, /right/observer: the observer is in namespace",
        ),
        # A typing error is one beside a wildcard, too.
        (
            {"/**": {"cpus": "0"}, "/*/observer": {}},
            "expected 'observer', which holds in every namespace, or '/cell/left",
        ),
    ],
)
def test_a_section_that_no_node_reads_is_refused(sections, said, start):
    refusal = start(ObserverNode, sections, *WAYS["/cell/left"])
    assert said in refusal and "own.yaml" in refusal


def test_a_file_for_two_arms_holds_for_both(start):
    file = {"/left/observer": {"safety": {"debounce": 5}}, "/right/observer": {"safety": {"debounce": 6}}}
    for space, debounce in (("/left", 5), ("/right", 6)):
        assert start(ObserverNode, file, *WAYS[space], see=lambda node: node.settings["safety"].debounce) == debounce
    assert "in namespace /, where none" in start(ObserverNode, file)


def test_planner_and_controller_read_the_others_sections_there_too(start):
    file = {"/left/controller": {"impedance": {"task_stiffness": 500.0}}, "/right/controller": {}, "planner": {}}
    stiffness = start(PlannerNode, file, *WAYS["/left"], see=lambda node: node.settings["impedance"].task_stiffness)
    assert stiffness == 500.0
    assert "the controller is in namespace /cell/left" in start(PlannerNode, file, *WAYS["/cell/left"])


def test_parameters_of_a_node_that_there_is_not_are_refused(start):
    assert "unknown node 'planer'; did you mean 'planner'" in start(
        ObserverNode, {}, "--ros-args", "-p", "planer:period:=0.1"
    )
    # What bring-up passes on to the planner.
    assert start(PlannerNode, {}, "--ros-args", "-p", "controller:impedance.null_damping:=2.0")


@pytest.mark.parametrize(
    ("more", "clock"), [([], "/left/clock"), (["-r", "/clock:=/clock"], "/clock")], ids=["its own", "a shared one"]
)
def test_simulated_time_is_that_of_the_namespace_unless_remapped(more, clock, start):
    def see(node):
        return [one.topic_name for one in node.subscriptions if one.topic_name.endswith("clock")], node.lockstep

    clocks, lockstep = start(ObserverNode, {"observer": {"use_sim_time": True}}, *WAYS["/left"], *more, see=see)
    assert lockstep and clocks == [clock]


def test_bring_up_refuses_sections_of_another_namespace(tmp_path, capsys):
    file = tmp_path / "own.yaml"
    file.write_text("/left/planner: {ros__parameters: {period: 0.1}}\n")
    assert bringup.run_bringup(["bringup", "--ros-args", "-r", "__ns:=/right", "-p", f"parameters:={file}"]) == 2
    assert "the planner is in namespace /right" in capsys.readouterr().err


def test_a_page_needs_no_contact_budget_that_can_be_read(start):
    """It stops nothing, and shows bags of robots whose files are elsewhere."""
    sections = {"viewer": {"port": 0}, "observer": {"contact_budget": "nowhere.yaml"}}
    assert start(ViewerNode, sections, see=lambda node: node.get_name()) == "viewer"
    assert "nowhere.yaml" in start(PlannerNode, sections)
