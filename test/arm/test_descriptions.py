"""Robots in files as people have them: endings, xacro, MJCF, names, limits, and what is refused or doubtful."""

import math
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh
import yaml

from contact_reach_ros.arm.capsules import shape_segments, shapes
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.robot_file import read_robot_file
from contact_reach_ros.arm.table import ArmOptions
from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arm.urdf_reader import Reading, read_arm, read_arm_file
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import ContactBudget

AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
MASSES = (3.0, 2.5, 2.0, 1.5, 1.0, 0.5)
LIMIT = '<limit lower="-2.8" upper="2.8" velocity="2" effort="120"/>'
BALL = '<collision><origin xyz="0 0 0.1"/><geometry><sphere radius="0.05"/></geometry></collision>'


def link(name: str, mass: float = 0.0, shape: str = "", tensor: tuple[float, float, float] = (0.01, 0.01, 0.01)) -> str:
    inertia = " ".join(f'{key}="{value}"' for key, value in zip(("ixx", "iyy", "izz"), tensor, strict=True))
    inertial = f'<inertial><origin xyz="0 0 0.1"/><mass value="{mass}"/><inertia {inertia}/></inertial>'
    return f'<link name="{name}">{inertial if mass else ""}{shape}</link>'


def joint(name: str, parent: str, child: str, axis: str = "0 0 1", kind: str = "revolute", extra: str = LIMIT) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="0 0 0.2"/><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/>{extra}</joint>'
    )


def fixed(parent: str, child: str, body: str = "") -> str:
    return (body or link(child)) + joint(f"{child}_mount", parent, child, kind="fixed", extra="")


def six_joints(end: str = fixed("l6", "tool"), **changed: str) -> str:
    """A robot with links l1 to l6, moved by joints j1 to j6, and what `end` adds; `changed`: other texts by name."""
    parts = {"base": link("base", 5.0, BALL)}
    before = "base"
    for number, (axis, mass) in enumerate(zip(AXES, MASSES, strict=True), 1):
        parts[f"l{number}"] = link(f"l{number}", mass, BALL)
        parts[f"j{number}"] = joint(f"j{number}", before, f"l{number}", axis)
        before = f"l{number}"
    return f'<robot name="six">{"".join({**parts, **changed}.values())}{end}</robot>'


def read(folder: Path, text: str, options: ArmOptions | None = None, name: str = "arm.urdf") -> Reading:
    file = folder / name
    file.write_text(text)
    return read_arm(file, options)


@pytest.mark.parametrize("tip", ["flange", "universe", "j3", "tool 0/ß"])
def test_a_tip_may_have_any_name(tip, tmp_path):
    arm = read(tmp_path, six_joints(fixed("l6", tip)), ArmOptions(tip=tip)).arm
    expected = pin.buildModelFromXML(six_joints())
    data = expected.createData()
    pin.framesForwardKinematics(expected, data, np.array(arm.home))
    place = data.oMf[expected.getFrameId("tool")]
    assert arm.tip_frame == tip
    np.testing.assert_allclose(RobotModel(arm).tip_pose(np.array(arm.home))[0], place.translation, atol=1e-9)


def test_the_printed_urdf_names_its_joints_once(tmp_path):
    arm = read(tmp_path, six_joints(j6=joint("tool_joint", "l5", "l6"))).arm
    text = build_urdf(arm)
    assert pin.buildModelFromXML(text).nq == 6
    names = [each.get("name") for each in ElementTree.fromstring(text).findall("joint")]
    assert len(names) == len(set(names))


def with_efforts(effort: float, numbers: range) -> dict[str, str]:
    limit = LIMIT.replace("120", str(effort))
    return {f"j{n}": joint(f"j{n}", f"l{n - 1}", f"l{n}", AXES[n - 1], extra=limit) for n in numbers}


@pytest.mark.parametrize("effort", [0.2, 0.8, 2.0, 12.0])
def test_thresholds_of_weak_joints_are_in_proportion_and_accepted(effort, tmp_path):
    masses = {f"l{n}": link(f"l{n}", 1e-3 * MASSES[n - 1], BALL, (1e-5, 1e-5, 1e-5)) for n in range(1, 7)}
    arm = read(tmp_path, six_joints(**with_efforts(effort, range(4, 7)), **masses)).arm
    budget = ContactBudget().resolve(arm)
    stop, contact, handover = budget.torque_thresholds[5], budget.contact_thresholds[5], budget.handover_thresholds[5]
    assert 0.0 < contact < handover < stop <= 0.5 * effort
    assert contact < budget.sudden_thresholds[5] < stop


def test_thresholds_of_a_heavy_arm_are_worth_the_same_acceleration(tmp_path):
    """Ten times as heavy and as strong: ten times as much on the joints that carry most."""

    def stops(factor: float) -> np.ndarray:
        bodies = {f"l{n}": link(f"l{n}", factor * mass, BALL, (factor,) * 3) for n, mass in enumerate(MASSES, 1)}
        arm = read(tmp_path, six_joints(**with_efforts(900.0 * factor, range(2, 7)), **bodies)).arm
        return np.array(ContactBudget().resolve(arm).torque_thresholds)

    assert stops(100.0)[1:3] == pytest.approx(10.0 * stops(10.0)[1:3], rel=0.01)
    assert stops(10.0)[1] > 30.0


def test_an_effort_that_leaves_no_threshold_is_refused_with_joint_and_reason(tmp_path):
    with pytest.raises(SettingsError, match=r"(?s)joint 'j5' has effort 0.01\. .* 0.1 Nm.*j5: {effort"):
        read(tmp_path, six_joints(**with_efforts(0.01, range(5, 6))))


def block_of(error: SettingsError) -> dict:
    """The YAML that a message asks for."""
    return yaml.safe_load(str(error).split("arm.yaml:\n")[1])


def test_all_that_is_missing_is_said_at_once_with_the_block_that_mends_it(tmp_path):
    changed = {
        "j1": joint("j1", "base", "l1", extra='<limit lower="-1" upper="1" velocity="0" effort="inf"/>'),
        "j2": joint("j2", "l1", "l2", AXES[1], extra='<limit lower="0" upper="0" velocity="2" effort="120"/>'),
        "j4": joint("j4", "l3", "l4", extra='<limit lower="-1e16" upper="1e16" velocity="1e16" effort="1e16"/>'),
        "l3": link("l3", 0.0, BALL),
        "l5": link("l5", 1.0, BALL, (0.003, 0.0237, 0.027)),
    }
    text = six_joints(**changed)
    with pytest.raises(SettingsError) as caught:
        read(tmp_path, text)
    block = block_of(caught.value)
    assert {name: set(keys) for name, keys in block["limits"].items()} == {
        "j1": {"velocity", "effort"},
        "j2": {"lower", "upper"},
        "j4": {"velocity", "effort"},
    }
    assert set(block["inertias"]) == {"l3", "l5"} and "1.124 %" in str(caught.value)
    # Filled in, it is what was asked for.
    numbers = {"lower": -1.0, "upper": 1.0, "velocity": 2.0, "effort": 120.0}
    block["limits"] = {name: {key: numbers[key] for key in keys} for name, keys in block["limits"].items()}
    block["inertias"]["l3"] = {"mass": 2.0, "center": [0.0, 0.0, 0.1], "tensor": [0.01, 0.01, 0.01, 0.0, 0.0, 0.0]}
    (tmp_path / "arm.yaml").write_text(yaml.dump(block))
    arm = read_arm_file(tmp_path / "arm.urdf").arm
    assert arm.inertias()[2].mass == 2.0 and arm.torque_limits[0] == 120.0
    assert (arm.joints[3].lower, arm.joints[3].upper) == (-6.2832, 6.2832)
    # MuJoCo refuses inertias that no body has.
    RobotModel(arm)
    assert sorted(arm.inertias()[4].tensor[:3]) == pytest.approx([0.0032, 0.0239, 0.027], rel=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_a_balanced_tensor_is_one_that_mujoco_takes(seed, tmp_path):
    random = np.random.default_rng(seed)
    turn = pin.rpy.rpyToMatrix(random.uniform(-3.0, 3.0, 3))
    wrong = turn @ np.diag([0.01, 0.02, random.uniform(0.0301, 0.2)]) @ turn.T
    keys = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    inertia = " ".join(f'{key}="{wrong[place]}"' for key, place in keys.items())
    inertial = f'<inertial><origin rpy="0.3 1 2"/><mass value="2"/><inertia {inertia}/></inertial>'
    with pytest.raises(SettingsError, match=r"'l3' .* above the sum") as caught:
        read(tmp_path, six_joints(l3=f'<link name="l3">{inertial}{BALL}</link>'))
    (tmp_path / "arm.yaml").write_text(yaml.dump(block_of(caught.value)))
    tensor = read_arm_file(tmp_path / "arm.urdf").arm.inertias()[2].tensor
    text = f'<mujoco><worldbody><body><inertial mass="1" pos="0 0 0" fullinertia="{" ".join(map(str, tensor))}"/>'
    assert mujoco.MjModel.from_xml_string(f"{text}</body></worldbody></mujoco>").nbody == 2


def test_efforts_below_gravity_are_refused_with_both_torques(tmp_path):
    weak = with_efforts(1.0, range(2, 4))
    with pytest.raises(
        SettingsError, match=r"'j2' has effort 1 Nm, less than the \d+\.?\d* Nm that gravity needs"
    ) as caught:
        read(tmp_path, six_joints(**weak))
    assert "j2" in block_of(caught.value)["limits"]
    # Hanging, the arm needs no torque, and still says what it could not hold.
    found = read(tmp_path, six_joints(**weak), ArmOptions(home=(0.0,) * 6)).doubts
    assert any("j2 needs up to" in line for line in found)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({f"l{n}": link(f"l{n}", 0.01, BALL, (1e-6, 1e-6, 1e-6)) for n in range(1, 7)}, "0.06 kg"),
        ({f"l{n}": link(f"l{n}", 1.0, BALL) for n in range(1, 7)}, "6 of 6 links have equal masses"),
        ({"l4": link("l4", 1.5, BALL + BALL.replace("0 0 0.1", "0.5 0 0"))}, None),
    ],
)
def test_what_is_hardly_real_is_said(changed, expected, tmp_path):
    found = read(tmp_path, six_joints(**changed)).doubts
    if expected is None:
        assert not any("masses" in line for line in found)
    else:
        assert [line for line in found if re.search(expected, line)], found


END = fixed("l6", "tool0") + fixed("l6", "camera")


@pytest.mark.parametrize(
    ("end", "tip"),
    [
        (END, "tool0"),
        (fixed("l6", "right_tool_frame") + fixed("l6", "camera"), "right_tool_frame"),
        (END + fixed("tool0", "hand", link("hand", 0.1, BALL)) + fixed("hand", "hand_tcp"), "hand_tcp"),
        # Fingers, a jaw and what mimics one are no tips, and no joints of the arm.
        (link("jaw", 0.1, BALL) + joint("gripper", "l6", "jaw"), "l6_tip"),
        (
            fixed("l6", "hand", link("hand", 0.1, BALL))
            + "".join(
                link(f"{side}_pad", 0.05, BALL) + joint(f"{side}_slide", "hand", f"{side}_pad", kind="prismatic")
                for side in ("left", "right")
            ),
            "hand",
        ),
        (
            fixed("l6", "hand", link("hand", 0.1, BALL))
            + link("a", 0.05, BALL)
            + joint("finger_joint", "hand", "a", extra=LIMIT)
            + link("b", 0.05, BALL)
            + joint("other", "hand", "b", extra=LIMIT + '<mimic joint="finger_joint" multiplier="-1"/>'),
            "hand",
        ),
    ],
    ids=["tool0", "tool_frame", "tcp", "jaw", "parallel", "mimic"],
)
def test_the_tip_is_what_is_made_for_it_and_never_a_finger(end, tip, tmp_path):
    reading = read(tmp_path, six_joints(end))
    assert reading.arm.tip_frame == tip and reading.arm.joint_names == tuple(f"j{n}" for n in range(1, 7))


@pytest.mark.parametrize(
    "end", [fixed("l6", "tool0") + fixed("l5", "other_tool0"), fixed("l6", "a") + fixed("l6", "b")]
)
def test_between_equal_tips_the_user_chooses(end, tmp_path):
    with pytest.raises(SettingsError, match=r"2 links end a chain of joints: .*under tip"):
        read(tmp_path, six_joints(end))


def test_a_jaw_that_is_given_as_tip_is_a_joint(tmp_path):
    text = six_joints(link("jaw", 0.1, BALL) + joint("gripper", "l6", "jaw"))
    assert read(tmp_path, text, ArmOptions(tip="jaw")).arm.n == 7


def test_a_mimic_joint_is_held_where_its_leader_is(tmp_path):
    mimic = '<mimic joint="leader" multiplier="-2" offset="0.3"/>'
    text = six_joints(
        fixed("l6", "tool0")
        + link("finger", 1.0, BALL)
        + joint("leader", "l6", "finger", "1 0 0")
        + link("follower", 1.0, BALL)
        + joint("follows", "finger", "follower", "0 1 0", extra=LIMIT + mimic)
    )
    arm = read(tmp_path, text, ArmOptions(fixed={"leader": 0.4})).arm
    model = pin.buildModelFromXML(text)
    q = pin.neutral(model)
    for name, angle in (("leader", 0.4), ("follows", -2.0 * 0.4 + 0.3)):
        q[model.idx_qs[model.getJointId(name)]] = angle
    held = pin.buildReducedModel(model, [model.getJointId(name) for name in ("leader", "follows")], q)
    np.testing.assert_allclose(arm.inertias()[5].center, held.inertias[6].lever, atol=1e-12)
    assert arm.inertias()[5].mass == pytest.approx(2.5)


def test_a_mimic_joint_of_the_chain_is_held_with_its_leader_and_refused_without(tmp_path):
    text = six_joints(j4=joint("j4", "l3", "l4", extra=LIMIT + '<mimic joint="j3"/>'))
    with pytest.raises(SettingsError, match="'j4' mimics joint 'j3'"):
        read(tmp_path, text)
    assert read(tmp_path, text, ArmOptions(fixed={"j3": 0.1})).arm.joint_names == ("j1", "j2", "j5", "j6")


def test_what_a_refusal_of_sliding_joints_says_mends_it(tmp_path):
    slides = {
        f"j{number}": joint(f"j{number}", before, f"l{number}", kind="prismatic")
        for number, before in ((1, "base"), (2, "l1"))
    }
    with pytest.raises(SettingsError, match="'j1' is of type prismatic; joint 'j2' is") as refused:
        read(tmp_path, six_joints(**slides))
    (tmp_path / "arm.yaml").write_text("fixed: " + re.search(r"under fixed \((.*?)\)", str(refused.value))[1])
    assert read_arm_file(tmp_path / "arm.urdf").arm.joint_names == ("j3", "j4", "j5", "j6")


def test_limits_without_end_and_soft_limits(tmp_path):
    soft = '<safety_controller soft_lower_limit="-1" soft_upper_limit="3" k_velocity="1"/>'
    empty = '<safety_controller soft_lower_limit="0" soft_upper_limit="0" k_velocity="1"/>'
    endless = '<limit lower="-inf" upper="inf" velocity="2" effort="120"/>'
    reading = read(
        tmp_path,
        six_joints(
            j1=joint("j1", "base", "l1", kind="continuous", extra=endless),
            j2=joint("j2", "l1", "l2", AXES[1], extra=LIMIT + soft),
            j3=joint("j3", "l2", "l3", AXES[2], extra=LIMIT + empty),
            j4=joint("j4", "l3", "l4", extra=LIMIT.replace('"2.8"', '"1e16"')),
        ),
    )
    ranges = [(each.lower, each.upper) for each in reading.arm.joints[:4]]
    assert ranges == [(-6.2832, 6.2832), (-1.0, 2.8), (-2.8, 2.8), (-2.8, 6.2832)]
    assert any("j2 from -1 to 2.8 rad, its soft ones" in line for line in reading.assumed)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (six_joints(l7=link("l3", 1.0)), "link 'l3' is there twice"),
        (six_joints(j7=joint("j3", "l6", "l1")), "joint 'j3' is there twice"),
        ('<robot name="none" xmlns:xacro="http://www.ros.org/wiki/xacro"></robot>', "has no links"),
        ("<html></html>", "its root is <html>"),
        ("<robot>", "not valid XML"),
        (six_joints(j2=joint("j2", "l1", "l2").replace("0 0 0.2", "0 0 0,2")), "'j2': origin xyz = '0 0 0,2'"),
        (six_joints(j2=joint("j2", "l1", "l2", extra=LIMIT + '<mimic joint="j9"/>')), "'j2' mimics joint 'j9'"),
        (six_joints(j2=joint("j2", "l1", "l2", extra=LIMIT + '<mimic joint="j2"/>')), "'j2' mimics itself"),
    ],
    ids=["link", "joint", "empty", "root", "xml", "comma", "leader", "itself"],
)
def test_what_no_reader_can_mean_is_refused(text, expected, tmp_path):
    with pytest.raises(SettingsError, match=f"^{tmp_path}/arm.urdf: .*{expected}"):
        read(tmp_path, text)


def test_fixed_joints_have_no_axis_that_counts(tmp_path):
    text = six_joints(fixed("l6", "tool").replace('axis xyz="0 0 1"', 'axis xyz="0 0 0"'))
    assert read(tmp_path, text).arm.n == 6


@pytest.mark.parametrize("encoding", ["utf-8-sig", "iso-8859-1"])
def test_prefixes_that_nobody_declared_and_other_encodings_do_no_harm(encoding, tmp_path):
    text = six_joints(l3=link("ärm", 1.0, BALL), j3=joint("j3", "l2", "ärm", AXES[2]), j4=joint("j4", "ärm", "l4"))
    text = text.replace("velocity=", 'drake:acceleration="2" velocity=').replace("</robot>", "<drake:x/></robot>")
    file = tmp_path / "arm.URDF"
    file.write_bytes(f'<?xml version="1.0" encoding="{encoding.removesuffix("-sig")}"?>{text}'.encode(encoding))
    assert load_arm(str(file)).link_names[2] == "ärm"


def test_visual_geometry_stands_for_what_has_no_other(tmp_path):
    visual = BALL.replace("collision", "visual")
    changed = {"base": link("base", 5.0, visual), "l4": link("l4", 1.5, visual), "l5": link("l5", 1.0, visual + BALL)}
    reading = read(tmp_path, six_joints(**changed, mark=fixed("base", "mark", link("mark", shape=visual))))
    assert {capsule.link for capsule in reading.arm.capsules} >= {2, 3, 4, 5, 6}
    assert any(line.endswith("since there is no other: base, l4") for line in reading.assumed)
    given = ArmOptions(capsules={"l4": ()})
    assert 4 not in {capsule.link for capsule in read(tmp_path, six_joints(**changed), given).arm.capsules}


def test_packages_have_the_names_that_they_say(tmp_path):
    package = tmp_path / "arm_description-main"
    for name in ("urdf", "meshes", "arm_description"):
        (package / name).mkdir(parents=True)
    (package / "package.xml").write_text("<package><name>arm_description</name></package>")
    trimesh.creation.box((0.04, 0.12, 0.04)).export(package / "meshes" / "box.stl")
    beside = tmp_path / "other-1.0" / "robots"
    beside.mkdir(parents=True)
    for folder in (package / "urdf", beside):
        for place in ("package:/", "file:///of/another/machine/install/arm_description/share"):
            mesh = f'<geometry><mesh filename="{place}/arm_description/meshes/box.stl"/></geometry>'
            capsules = read(folder, six_joints(l4=link("l4", 1.5, f"<collision>{mesh}</collision>"))).arm.capsules
            assert next(each for each in capsules if each.link == 4).radius == pytest.approx(0.0289, abs=2e-4)


MACRO = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:macro name="tip" params="name"><link name="${name}"/><joint name="${name}_mount" type="fixed">
<parent link="l6"/><child link="${name}"/></joint></xacro:macro></robot>"""


def test_a_xacro_file_is_expanded_with_its_arguments_and_packages(tmp_path):
    pytest.importorskip("xacro", reason="pip install xacro")
    package = tmp_path / "parts-main"
    package.mkdir()
    (package / "package.xml").write_text("<package><name>parts</name></package>")
    (package / "tip.xacro").write_text(MACRO)
    calls = '<xacro:include filename="$(find parts)/tip.xacro"/><xacro:arg name="tip" default=""/>'
    text = six_joints(f'{calls}<xacro:tip name="$(arg tip)"/>')
    file = tmp_path / "arm.urdf.xacro"
    file.write_text(text.replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"'))
    (tmp_path / "arm.yaml").write_text("xacro: {tip: end}\n")
    assert read_arm_file(file).arm.tip_frame == "end"
    assert read_arm_file(tmp_path / "arm.yaml").arm.tip_frame == "end"
    (tmp_path / "arm.yaml").write_text("xacro: {tpi: end}\n")
    with pytest.raises(SettingsError, match=f"^{file}: xacro argument 'tpi' is unknown; expected one of tip$"):
        read_arm_file(tmp_path / "arm.yaml")
    (tmp_path / "arm.yaml").write_text("xacro: {tip: end}\npackages: {parts: nowhere}\n")
    with pytest.raises(SettingsError, match=f"^{file}: xacro does not expand it: .*nowhere"):
        read_arm_file(file)


def test_a_xacro_file_that_lacks_a_package_is_refused_in_one_sentence(tmp_path):
    pytest.importorskip("xacro", reason="pip install xacro")
    head = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm"><xacro:property name="x" value='
    expected = "arm.xacro: package 'nosuch' is not found; give its folder under packages$"
    with pytest.raises(SettingsError, match=expected):
        read(tmp_path, f'{head}"$(find nosuch)"/><link name="${{x}}"/></robot>', name="arm.xacro")


def test_a_xacro_file_that_lacks_an_argument_is_refused_with_all_of_them(tmp_path):
    pytest.importorskip("xacro", reason="pip install xacro")
    declared = (("name", "ar"), ("kind", ""), ("way", "$(arg name)/a"))
    arguments = "".join(f'<xacro:arg name="{name}" default="{default}"/>' for name, default in declared)
    text = six_joints(arguments).replace('"six"', '"$(arg name)" xmlns:xacro="http://www.ros.org/wiki/xacro"')
    with pytest.raises(SettingsError, match=r"argument name; .* under xacro \({name: ar, kind: ''}\)"):
        read(tmp_path, text, name="arm.xacro")
    (tmp_path / "arm.yaml").write_text("xacro: {name: 7, kind: true}")
    assert read_arm_file(tmp_path / "arm.xacro").arm.name == "7"


@pytest.mark.parametrize("end", ["<xacro:x/>", fixed("l6", "${tip}")])
def test_without_xacro_its_command_is_said(end, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(SettingsError, match="install it: pip install xacro"):
        read(tmp_path, six_joints(end), name="arm.xacro")


MJCF = """<mujoco model="odd"><compiler angle="degree" autolimits="true"/>
<default><default class="a"><joint axis="0 0 1" range="-100 100" armature="0.1" actuatorfrcrange="-120 90"/>
<geom type="capsule" size="0.04 0.1" contype="1"/></default></default>
<asset><mesh name="box" vertex="0 0 0  0.1 0 0  0 0.2 0  0 0 0.1  0.1 0.2 0.1" scale="1 1 2"/></asset>
<worldbody><geom type="plane" size="1 1 1"/><light pos="0 0 3"/>
<body name="base" pos="0 0 0.1"><geom class="a" mass="3"/>
<body name="one" pos="0 0 0.2" euler="0 0 30" childclass="a"><joint name="q1"/><geom/>
<body name="two" pos="0 0.1 0.2" euler="90 20 0"><joint name="q2" pos="0.05 0 0.02" axis="1 0 1" ref="20"/>
<geom/><geom type="mesh" mesh="box" pos="0.01 0 0" euler="0 10 0"/>
<body name="three" pos="0.2 0 0" euler="0 90 0"><joint name="q3" range="-200 200"/>
<inertial pos="0.01 0.02 0.03" mass="1.5" fullinertia="0.02 0.03 0.025 0.001 0.002 -0.001"/><geom pos="0 0 0.1"/>
<body name="four" pos="0 0 0.2" quat="0.7 0.1 0.2 0.3"><joint name="q4" actuatorfrclimited="false"/><geom/>
<geom type="box" size="0.2 0.2 0.2" contype="0" conaffinity="0" mass="0"/>
<site name="grip_tcp" pos="0 0.02 0.1" euler="10 20 30"/><site name="camera" pos="0.1 0 0"/>
<body name="pad" pos="0 0.1 0"><joint name="left_finger" type="slide" range="0 0.04" pos="0 0 0.1"/>
<joint name="left_jaw" pos="0.03 0 0" ref="10" axis="0 1 0"/><geom size="0.01 0.02" pos="0 0 0.1"/></body>
</body></body></body></body></body></worldbody>
<actuator><motor joint="q4" gear="5" ctrlrange="-4 6"/></actuator></mujoco>"""


def test_an_mjcf_is_the_arm_that_mujoco_simulates(tmp_path):
    reading = read(tmp_path, MJCF, name="arm.XML")
    arm, theirs = reading.arm, mujoco.MjModel.from_xml_string(MJCF)
    assert (arm.name, arm.base_frame, arm.tip_frame) == ("odd", "world", "grip_tcp")
    assert arm.joint_names == tuple(f"q{n}" for n in range(1, 5))
    assert arm.torque_limits.tolist() == [90.0] * 3 + [20.0]
    assert arm.joints[2].upper == pytest.approx(math.radians(200.0)) and arm.joints[0].armature == 0.1
    assert any("velocity" in line and "MJCF has none" in line for line in reading.assumed)
    ours, data, random = RobotModel(arm), mujoco.MjData(theirs), np.random.default_rng(0)
    # The fingers are held.
    mass, jacobian = np.zeros((theirs.nv, theirs.nv)), np.zeros((6, theirs.nv))
    for _ in range(50):
        q, v = random.uniform(arm.lower, arm.upper), random.normal(size=4)
        data.qpos[:], data.qvel[:] = [*q, 0.0, 0.0], [*v, 0.0, 0.0]
        mujoco.mj_forward(theirs, data)
        mujoco.mj_fullM(theirs, data, mass)
        site = data.site("grip_tcp")
        mujoco.mj_jacSite(theirs, data, jacobian[:3], jacobian[3:], site.id)
        ours.update(q, v)
        np.testing.assert_allclose(ours.position, site.xpos, rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.rotation, site.xmat.reshape(3, 3), rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.jacobian, jacobian[:, :4], rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.mass_matrix, mass[:4, :4], rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.bias, data.qfrc_bias[:4], rtol=0, atol=1e-8)


def test_a_motor_gives_no_more_than_its_control_and_its_force_permit(tmp_path):
    for force, expected in ((80.0, 20.0), (2.0, 10.0)):
        text = MJCF.replace('ctrlrange="-4 6"', f'ctrlrange="-4 6" forcerange="-{force} {force}"')
        arm, model = read(tmp_path, text, name="arm.xml").arm, mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        data.ctrl[:] = -1e9
        mujoco.mj_forward(model, data)
        assert arm.torque_limits[3] == expected == -data.qfrc_actuator[3]


def test_forces_of_an_mjcf_that_the_model_lacks_are_said(tmp_path):
    text = MJCF.replace('<joint name="q1"/>', '<joint name="q1" stiffness="100"/>')
    text = text.replace('<body name="two"', '<body name="two" gravcomp="1"')
    text = text.replace("<worldbody>", '<worldbody><body name="floor"><geom type="plane" size="1 1 1"/></body>')
    text = text.replace(
        "<actuator>", '<tendon><fixed name="belt"><joint joint="q2" coef="1"/></fixed></tendon><actuator>'
    )
    said = "\n".join(read(tmp_path, text, name="arm.xml").assumed)
    for part in (
        "springs of q1 are",
        "gravity compensation of two are",
        "tendons belt are",
        "a plane of floor is left out",
    ):
        assert part in said


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fixed": {"j3": 90.0}}, r"fixed: j3 = 90; expected from -.* to .* rad$"),
        ({"limits": {"j3": {"velocity": 1e3}}}, r"limits: j3: velocity = 1000; expected less than 1000$"),
        ({"thresholds": {"torque_thresholds": [1e5] * 6}}, "torque_thresholds = .*; expected no more than the joints'"),
    ],
)
def test_options_that_no_arm_has_are_refused(options, message, tmp_path):
    with pytest.raises(SettingsError, match=message):
        read(tmp_path, six_joints(), ArmOptions(**options))


def test_names_that_are_those_of_others_do_no_harm_or_are_refused(tmp_path):
    text = six_joints().replace('"j3"', '"universe"')
    with pytest.raises(SettingsError, match="joint 'universe' has the name that Pinocchio has"):
        read(tmp_path, text)
    arm = read(tmp_path, six_joints("").replace('"l3"', '"l6_tip"').replace('"base"', '"world"')).arm
    assert arm.tip_frame == "l6_tip_" and arm.base_frame == "world"
    mujoco.MjModel.from_xml_string(build_mjcf(arm))


def test_capsules_of_an_mjcf_cover_the_geometry_that_mujoco_has(tmp_path):
    arm, model = read(tmp_path, MJCF, name="arm.xml").arm, mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    data.qpos[:4] = q = np.array(arm.home)
    mujoco.mj_kinematics(model, data)
    geom = next(number for number in range(model.ngeom) if model.geom_type[number] == mujoco.mjtGeom.mjGEOM_MESH)
    vertices = model.mesh_vert @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    starts, ends = (points[0] for points in shape_segments(arm, q[None]))
    number = next(n for n, shape in enumerate(shapes(arm)) if shape.link == 2)
    axis = ends[number] - starts[number]
    share = np.clip((vertices - starts[number]) @ axis / (axis @ axis), 0.0, 1.0)
    apart = np.linalg.norm(vertices - starts[number] - share[:, None] * axis, axis=1)
    assert apart.max() <= shapes(arm)[number].radius + 5e-4


def test_an_mjcf_whose_geometry_touches_nothing_has_capsules_of_it(tmp_path):
    text = MJCF.replace('contype="1"', 'contype="0" conaffinity="0"').replace('type="mesh"', 'type="mesh" contype="0"')
    arm = read(tmp_path, text, name="arm.xml").arm
    assert {each.link for each in arm.capsules} >= {2, 3, 4}
    # Geometry that counts for nothing else still has its mass.
    assert arm.inertias() == pytest.approx(read(tmp_path, MJCF, name="other.xml").arm.inertias())


def test_an_mjcf_keeps_its_gravity_and_equal_joints_and_names_other_equalities(tmp_path):
    joints = (
        '<joint joint1="q4" joint2="q3" polycoef="0.1 2 0 0 0"/><joint name="bent" joint1="q4" polycoef="0 0 1 0 0"/>'
    )
    file = tmp_path / "equal.xml"
    file.write_text(MJCF.replace("</mujoco>", f"<equality>{joints}</equality></mujoco>"))
    robot, assumed = read_robot_file(file, ArmOptions())
    follower = next(each for each in robot.iter("joint") if each.get("name") == "q4")
    assert follower.find("mimic").get("joint") == "q3" and follower.find("mimic").get("multiplier") == "2.0"
    assert any("constraint bent (joint) is left out" in line for line in assumed)

    def of_gravity(*values):
        option = f'<option gravity="{" ".join(map(str, values))}"/><worldbody>'
        return read(tmp_path, MJCF.replace("<worldbody>", option, 1), name="arm.xml").arm.gravity

    assert np.linalg.norm(of_gravity(0.0, -9.0, 1.0)) == pytest.approx(np.hypot(9.0, 1.0))
    assert of_gravity(0.0, 0.0, -1.62)[2] != pytest.approx(-9.81)
    with pytest.raises(SettingsError, match=r"gravity = .*; expected its acceleration"):
        of_gravity(0.0, 0.0, 0.0)


def test_an_mjcf_that_mujoco_refuses_is_refused_with_its_words(tmp_path):
    with pytest.raises(SettingsError, match=r"arm.xml: MuJoCo refuses it: .*childclass"):
        read(tmp_path, MJCF.replace('class="a"><joint name="q1"', 'class="nosuch"><joint name="q1"'), name="arm.xml")


def test_a_joint_of_an_mjcf_without_armature_has_a_rotor_all_the_same(tmp_path):
    arm = read(tmp_path, MJCF.replace(' armature="0.1"', ""), name="arm.xml").arm
    assert [each.armature for each in arm.joints] == [0.01] * 4
