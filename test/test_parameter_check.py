"""Parameter files are checked as a whole, before anything starts; what each preset sets."""

import dataclasses

import pytest
import yaml
from arm_simulation import ARM

import contact_reach_ros as cr
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.settings import PlannerNodeSettings
from contact_reach_ros.presets import PRESETS, SECTIONS, check_parameters, preset
from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import NODES, parameters_in

STACK = {"driver": {}, "controller": {}, "observer": {}, "planner": {}}


@pytest.fixture
def written(tmp_path):
    def write(**nodes):
        file = tmp_path / "own.yaml"
        file.write_text(yaml.safe_dump({name: {"ros__parameters": content} for name, content in nodes.items()}))
        return file

    return write


def test_the_packages_own_file_passes():
    check_parameters(config_file("default.yaml"), STACK)
    assert list(SECTIONS) == list(NODES)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ({"plannner": {"period": 0.1}}, "unknown node 'plannner'; did you mean 'planner'"),
        ({"/arm/planer": {}}, "unknown node 'planer'; did you mean 'planner'"),
        ({"/arm/planner": {}}, "/arm/planner: the planner is in namespace /"),
        ({"/left/**": {"robot": "fr3"}, "controller": {}}, r"/left/\*\*: the driver is in namespace /, where none of"),
        ({"planner": {"perod": 0.1}}, "planner: unknown key 'perod'; did you mean 'period'"),
        ({"/**/observer": {"momentum": {"gian": 9.0}}}, "observer: unknown key 'momentum.gian'"),
        ({"controller": {"limits": {"torque_share": 2.0}}}, "controller: limits.torque_share = 2.0: expected a number"),
        ({"/**": {"robot": "r2"}}, "robot: arm 'r2' is unknown; expected one of fr3, iiwa14"),
        (
            {"planner": {"impedance": {"task_damping": 50.0}}},
            "planner: unknown key 'impedance.task_damping'; set it for the controller",
        ),
        ({"planner": {"contact_budget": "own.yaml"}}, "planner: unknown key 'contact_budget'; set it for the observer"),
        ({"/**": {"momentum": {"gain": 9.0}}}, "driver: unknown key 'momentum.gain'; set it for the observer"),
        ({"observer": {"qos_overrides": {"/tf": {"depth": 1}}}}, r"unknown key 'qos_overrides./tf.depth'"),
        ({"observer": {"momentun": None}}, "observer: unknown key 'momentun'; did you mean 'momentum"),
        ({"controller": {"period": 0.1}}, "controller: unknown key 'period'; set it for the planner"),
        ({"controller": {"impedance": {"null_damping": 50.0}}}, "null_damping = 50 are not stable at 1000 Hz"),
        ({"planner": {"state_rate": 500.0}}, "state_rate = .*1000.0 for the controller.* 500.0 for the planner"),
        (
            {"planner": {"tool": {"mass": 1.0}}},
            r"tool\.mass = 0\.0 for the driver, .* 1\.0 for the planner; expected the same",
        ),
        ({"/**": {"tool": {"inertia": [1.0] * 6}}}, r"driver: Tool\.inertia = .* expected zeros, as mass = 0 kg"),
        ({"/**": {"state_rate": 300.0}}, "the simulated robot has a whole number of milliseconds"),
        ({"observer": {"contact_budget": "/no/such.yaml"}}, "/no/such.yaml: cannot be read"),
    ],
)
def test_what_is_wrong_is_named(written, nodes, message):
    with pytest.raises(SettingsError, match=message):
        check_parameters(written(**nodes), STACK)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("observer:\n  ros__parameters:\n  momentum:\n    gain: 40.0\n", "momentum beside ros__parameters"),
        ("observer: {ros__parameters: {momentum.gain: 6.0, momentum: {gain: 4.0}}}", "'momentum.gain' is there twice"),
        ("observer: {ros__parameters: false}", "observer.ros__parameters is not a mapping"),
        ("observer: {ros__parameters: {momentum: {gain: 1:30}}}", "momentum.gain = '1:30': expected a number"),
        ("observer: {ros__parameters: {momentum: {gain: 4_0.0}}}", "momentum.gain = '4_0.0': expected a number"),
        ("observer: {ros__parameters: {momentum: {gain: 2024-02-31}}}", "'2024-02-31': expected a number"),
        ("observer: {ros__parameters: {momentum: {gain: !!int foo}}}", "not valid YAML: invalid literal"),
        ("observer: {ros__parameters: &a {momentum: *a}}", "not valid YAML: .*recursion"),
        ("[" * 3000, "not valid YAML"),
        ("observer: {ros__parameters: {use_sim_time: maybe}}", "use_sim_time = 'maybe'; expected true or false"),
        ("a: &a {b: 1, c: 2}\n" + "".join(f"x{i}: &{n} {{p: *{o}, q: *{o}}}\n" for i, (o, n) in
         enumerate(zip("abcdefghijklmnopqrst", "bcdefghijklmnopqrstu", strict=True))), "more than 100,000 values"),
    ],
)  # fmt: skip
def test_what_no_node_can_read_is_refused_before_anything_starts(tmp_path, text, message):
    file = tmp_path / "own.yaml"
    file.write_text(text)
    with pytest.raises(SettingsError, match=message):
        check_parameters(file, STACK)


def test_numbers_are_read_as_ros_reads_them(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("observer: {ros__parameters: {momentum: {gain: 4.0e1}, safety: }}")
    assert parameters_in(file, "observer")["momentum.gain"] == 40.0


def test_a_budget_that_no_torque_exceeds_is_refused(written, tmp_path):
    budget = tmp_path / "budget.yaml"
    budget.write_text(f"handover_thresholds: {[8.0] * 6 + [50.0]}")
    with pytest.raises(
        SettingsError, match=r"handover_thresholds = .*; expected no more than the joints' torque limits"
    ):
        check_parameters(written(observer={"contact_budget": str(budget)}), STACK)


def test_what_is_given_on_top_of_the_file_counts(written):
    file = written()
    rate = {name: {"state_rate": 500.0} for name in STACK}
    check_parameters(file, rate)
    with pytest.raises(SettingsError, match=r"state_rate = .* for the observer"):
        check_parameters(file, {**rate, "observer": {}})


@pytest.mark.parametrize("wildcard", ["/**", "/*", "**", "/**/controller", "controller", "/controller"])
def test_wildcards_mean_what_they_mean_in_ros(written, wildcard):
    """As tried with rclpy; of two sections for a node the later one holds."""
    assert parameters_in(written(**{wildcard: {"cpus": "0"}}), "controller") == {"cpus": "0"}
    with pytest.raises(SettingsError, match=r"/\*/controller: the controller is in namespace /, where none of these"):
        parameters_in(written(**{"/*/controller": {"cpus": "0"}}), "controller")
    assert parameters_in(written(**{"/*/controller": {"cpus": "0"}}), "controller", "/left") == {"cpus": "0"}


def test_controller_and_adapter_agree_on_who_carries_the_arm(written):
    carried = {"supervision": {"gravity_compensation": False}}
    stack = {**STACK, "adapter": {}}
    check_parameters(written(adapter={"gravity_compensation": False}, controller=carried), stack)
    for nodes in ({"adapter": {"gravity_compensation": False}}, {"controller": carried}):
        with pytest.raises(SettingsError, match=r"gravity_compensation = .*; expected the same for all of them"):
            check_parameters(written(**nodes), stack)


PAPER = ("paper_linear", "paper_hinge")


@pytest.mark.parametrize("name", PRESETS)
def test_nodes_take_the_file_of_every_preset(name):
    check_parameters(config_file(PRESETS[name]))


def test_shipped_is_what_the_nodes_run():
    shipped = preset("shipped")
    assert shipped.planning == cr.PlanningSettings().resolve(ARM)
    assert shipped.replanning == PlannerNodeSettings()
    assert shipped.unexpected_contact == cr.UnexpectedContactSettings()


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_presets_have_its_solver_and_latch_and_the_delay_of_the_nodes(name):
    found = preset(name)
    planning = found.planning
    assert planning.sampling == "paper"
    assert (planning.population, planning.elite, planning.max_steps) == (200, 50, 100)
    assert planning.deadline == planning.null_motion_weight == planning.lead_change_weight == 0.0
    assert found.replanning == preset("shipped").replanning
    assert found.controller.impedance.reference_ramp == 0.0
    assert found.unexpected_contact.reaction == "ignore"


@pytest.mark.parametrize(
    ("name", "force", "cost"),
    [("paper_hinge", 4.0, 0.0), ("paper_hinge", 12.0, 10.0), ("paper_linear", 4.0, 20.0), ("paper_linear", 12.0, 60.0)],
)
def test_the_readings_differ_in_what_a_newton_costs(name, force, cost):
    """λ3 = 5 per newton: above ε = 10 N only, or everywhere, up to the constant λ3 ε."""
    planning = preset(name).planning
    assert planning.contact_weight * force + planning.contact_limit_weight * max(0.0, force - 10.0) == cost


def test_the_readings_differ_in_nothing_else():
    linear, hinge = (preset(name) for name in PAPER)
    same = dataclasses.replace(hinge.planning, contact_weight=5.0, contact_limit_weight=0.0)
    assert linear == hinge._replace(planning=same)


def test_a_stack_takes_a_preset():
    stack = cr.Stack(cr.load_scene("free", arm=ARM), **preset("paper_hinge")._asdict())
    assert stack.planner.settings.latency == 0.04


def test_an_unknown_preset_is_refused_with_those_there_are():
    with pytest.raises(SettingsError, match="preset 'paper' is unknown; expected one of paper_linear, paper_hinge"):
        preset("paper")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("controller: {ros__parameters: {rate: 1.0}}\ncontroller: {ros__parameters: {}}\n", "controller"),
        ("observer:\n  ros__parameters:\n    safety: {debounce: 3}\n    safety: {debounce: 5}\n", "safety"),
    ],
)
def test_what_is_there_twice_is_refused_and_not_read_in_part(tmp_path, text, key):
    file = tmp_path / "twice.yaml"
    file.write_text(text)
    with pytest.raises(SettingsError, match=f"'{key}' is there twice"):
        check_parameters(file, STACK)


MOMENTUM = "observer: {ros__parameters: {momentum: {%s}}}"


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("\ufeff" + MOMENTUM % "gain: 40.0", "gain", 40.0),
        ("observer:\r\n  ros__parameters:\r\n    momentum:\r\n      gain: 40.0\r\n", "gain", 40.0),
        ("/observer: {ros__parameters: {momentum.gain: 40.0}}", "gain", 40.0),
        (MOMENTUM % "gain: 4e1", "gain", 40.0),
        (MOMENTUM % "gain: 40.0}, tool: , safety: {", "gain", 40.0),
        (MOMENTUM % "gain: 40", "gain", 40),
        ("planner: {ros__parameters: &all {state_rate: 1e3}}\n" + MOMENTUM % "<<: &m {gain: 40.0}", "gain", 40.0),
        ("/**: {ros__parameters: &all {robot: iiwa14}}\n" + MOMENTUM % "gain: &gain 4.0e+1", "gain", 40.0),
        (MOMENTUM % "gravity_in_torque: off", "gravity_in_torque", False),
        (MOMENTUM % "torque_offset: [0, 0, 0, 0, 0, 0, 0]", "torque_offset", [0] * 7),
        (MOMENTUM % "torque_offset: [0, 1e-1, 0, 0, 0, 0, 0.5]", "torque_offset", [0, 0.1, 0, 0, 0, 0, 0.5]),
    ],
)
def test_a_file_may_be_written_as_editors_and_people_write_it(tmp_path, text, name, value):
    file = tmp_path / "own.yaml"
    file.write_bytes(text.encode())
    check_parameters(file, STACK)
    assert parameters_in(file, "observer")[f"momentum.{name}"] == value


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty; expected a mapping"),
        ("observer:\n  ros__parameters:\n\tmomentum:\n\t  gain: 40.0\n", "not valid YAML: .*'\\\\t'"),
        (MOMENTUM % 'gravity_in_torque: "false"', "gravity_in_torque = 'false': expected true or false"),
        (MOMENTUM % "gain: 40,0", "unknown key|gain = .* expected a number"),
        (MOMENTUM % "gain: '40.0'", "gain = '40.0': expected a number"),
        ("observer: {ros__parameters: {safety: {debounce: 3.0}}}", "debounce = 3.0: expected an integer"),
        ("observer: {ros__parameters: {safety: {debounce: 3e0}}}", "debounce = 3.0: expected an integer"),
    ],
)
def test_what_a_file_cannot_mean_is_refused(tmp_path, text, said):
    file = tmp_path / "own.yaml"
    file.write_text(text)
    with pytest.raises(SettingsError, match=rf"(?s)own\.yaml: .*({said})"):
        check_parameters(file, STACK)
