"""Arms out of URDFs: the same motion and dynamics as other readers find, and errors that name what to mend."""

import dataclasses
import json
import math
import re
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh
import yaml
from arm_simulation import ARM

from contact_reach_ros.arm import Arm, Capsule, Inertia
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.table import ArmOptions, GivenCapsule, arm_of_table, table_of
from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arm.urdf_reader import read_arm, read_arm_file
from contact_reach_ros.errors import SettingsError

LIMIT = '<limit lower="-2.5" upper="1.5" velocity="2" effort="60"/>'


def link(name: str, mass: float = 1.0, extra: str = "") -> str:
    inertial = (
        f'<inertial><origin xyz="0.01 -0.02 0.05" rpy="0.3 0.1 -0.4"/><mass value="{mass}"/>'
        '<inertia ixx="0.02" iyy="0.03" izz="0.015" ixy="0.001" ixz="-0.002" iyz="0.003"/></inertial>'
    )
    return f'<link name="{name}">{inertial if mass else ""}{extra}</link>'


def joint(name: str, parent: str, child: str, axis: str = "0 0 1", kind: str = "revolute", extra: str = LIMIT) -> str:
    number = len(name) + ord(name[-1])
    origin = f'<origin xyz="0.0{number % 5} -0.0{number % 3} 0.2" rpy="0.{number % 7} -0.{number % 4} 1.{number % 9}"/>'
    return (
        f'<joint name="{name}" type="{kind}">{origin}<parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/>{extra}</joint>'
    )


def collision(shape: str, origin: str = "") -> str:
    return f"<collision>{origin}<geometry>{shape}</geometry></collision>"


def ball(radius: float = 0.05) -> str:
    return collision(f'<sphere radius="{radius}"/>')


AXES = ("0 0 1", "0 1 0", "-1 0 0", "0 0 -1", "0.6 0 0.8", "1 2 3", "0 -1 0")
"""Of the seven joints: with the frame, aside, backwards, and not normalised."""


def odd_arm(**changed: str) -> str:
    """Seven joints about odd axes, links that are fixed to others, and a finger; `changed`: other texts by name."""
    parts = {"world": '<link name="world"/>', "stand": link("stand", extra=ball(0.1))}
    parts["mount"] = joint("mount", "world", "stand", kind="fixed", extra="")
    before = "stand"
    for number, axis in enumerate(AXES, 1):
        name = f"part_{number}"
        parts[name] = link(name, mass=3.0 - 0.3 * number, extra=ball())
        parts[f"joint_{number}"] = joint(f"joint_{number}", before, name, axis)
        before = name
    # In the middle of the chain, at its side, and at its end.
    parts["sensor"] = link("sensor", 0.4)
    parts["sensor_mount"] = joint("sensor_mount", "part_3", "sensor", kind="fixed", extra="")
    parts["joint_4"] = joint("joint_4", "sensor", "part_4", AXES[3])
    parts["finger"] = link("finger", 0.2)
    parts["finger_joint"] = joint("finger_joint", "part_7", "finger", "0 1 0")
    parts["tool"] = '<link name="tool"/>'
    parts["tool_mount"] = joint("tool_mount", "part_7", "tool", kind="fixed", extra="")
    return '<robot name="odd">' + "".join({**parts, **changed}.values()) + "</robot>"


def written(folder: Path, text: str, name: str = "arm.urdf") -> Path:
    file = folder / name
    file.write_text(text)
    return file


ODD = ArmOptions(base="stand", tip="tool", fixed={"finger_joint": 0.4}, home=(0.0,) * 7, reach=1.0)
FINGER = {"finger_joint": 0.4}
STATES = 200


@pytest.fixture(scope="module")
def odd(tmp_path_factory) -> tuple[Arm, pin.Model]:
    """The arm, and what Pinocchio reads, with the finger held and the same armature."""
    file = written(tmp_path_factory.mktemp("odd"), odd_arm())
    model = pin.buildModelFromUrdf(str(file))
    held = pin.neutral(model)
    held[model.idx_qs[model.getJointId("finger_joint")]] = 0.4
    model = pin.buildReducedModel(model, [model.getJointId("finger_joint")], held)
    model.armature = np.full(model.nv, 0.01)
    return read_arm(file, ODD).arm, model


def states(arm: Arm) -> list[tuple[np.ndarray, np.ndarray]]:
    random = np.random.default_rng(0)
    return [(random.uniform(arm.lower, arm.upper), random.normal(size=arm.n)) for _ in range(STATES)]


def test_controllers_model_is_the_one_that_pinocchio_reads(odd):
    arm, theirs = odd
    ours, data = RobotModel(arm), theirs.createData()
    base, tip = theirs.getFrameId("stand"), theirs.getFrameId("tool")
    pin.framesForwardKinematics(theirs, data, pin.neutral(theirs))
    stand = data.oMf[base].copy()
    for q, v in states(arm):
        ours.update(q, v)
        pin.computeAllTerms(theirs, data, q, v)
        pose = stand.actInv(pin.updateFramePlacement(theirs, data, tip))
        jacobian = pin.computeFrameJacobian(theirs, data, q, tip, pin.LOCAL_WORLD_ALIGNED)
        turned = np.vstack([stand.rotation.T @ jacobian[:3], stand.rotation.T @ jacobian[3:]])
        for mine, other in (
            (ours.position, pose.translation),
            (ours.rotation, pose.rotation),
            (ours.mass_matrix, data.M),
            (ours.bias, data.nle),
            (ours.jacobian, turned),
        ):
            np.testing.assert_allclose(mine, other, rtol=0, atol=1e-9)


def test_a_table_holds_all_of_an_arm(odd, tmp_path):
    arm, _ = odd
    again = arm_of_table(json.loads(json.dumps(table_of(arm))), "table")
    assert again == arm and again.digest == arm.digest and again.defaults == arm.defaults
    file = written(tmp_path, yaml.dump(table_of(arm)), "table.yaml")
    assert read_arm_file(file).arm.digest == arm.digest


def test_the_urdf_that_the_package_writes_is_the_same_arm(tmp_path):
    file = written(tmp_path, build_urdf(ARM))
    arm = read_arm(file, ArmOptions(home=ARM.home)).arm
    assert (arm.base_frame, arm.tip_frame, arm.joint_names) == (ARM.base_frame, ARM.tip_frame, ARM.joint_names)
    assert arm.shoulder == ARM.shoulder and arm.reach == pytest.approx(ARM.reach, abs=0.002)
    for ours, theirs in zip(arm.joints, ARM.joints, strict=True):
        np.testing.assert_allclose((*ours.offset, ours.lower, ours.upper), (*theirs.offset, theirs.lower, theirs.upper))
    for ours, theirs in zip(arm.inertias(), ARM.inertias(), strict=True):
        np.testing.assert_allclose((ours.mass, *ours.center), (theirs.mass, *theirs.center), rtol=0, atol=1e-12)
    # Spheres and cylinders are capsules again.
    assert [capsule.link for capsule in arm.capsules] == [capsule.link for capsule in ARM.capsules]
    for ours, theirs in zip(arm.capsules, ARM.capsules, strict=True):
        assert ours.radius == pytest.approx(theirs.radius, abs=2e-4)
        assert math.dist(ours.start, ours.end) == pytest.approx(math.dist(theirs.start, theirs.end), abs=2e-4)


def test_options_lie_beside_the_urdf_and_either_path_leads_to_the_arm(tmp_path):
    urdf = written(tmp_path, odd_arm())
    options = "base: stand\ntip: tool\nname: ours\narmature: [1, 2, 3, 4, 5, 6, 7]\nfixed: {finger_joint: 0.4}\n"
    options += "thresholds: {torque_thresholds: [9, 8, 7, 6, 5, 4, 3]}\nhome: [0, 0.1, 0, 0, 0, 0, 0]\nreach: 0.5\n"
    beside = written(tmp_path, options, "arm.yaml")
    elsewhere = written(tmp_path, options + "urdf: arm.urdf\n", "other.yaml")
    arms = [read_arm_file(file).arm for file in (urdf, beside, elsewhere)]
    assert len({arm.digest for arm in arms}) == 1 and arms[0].name == "ours"
    assert [joint.armature for joint in arms[0].joints] == [1, 2, 3, 4, 5, 6, 7]
    assert arms[0].default("torque_thresholds") == (9, 8, 7, 6, 5, 4, 3)
    assert arms[0].home[1] == 0.1 and arms[0].reach == 0.5


def test_of_several_ends_the_tip_is_the_one_without_a_body(tmp_path):
    text = odd_arm(finger=link("finger", 0.2, ball(0.01)), mark='<link name="mark"/>')
    text = text.replace("</robot>", joint("marked", "world", "mark", kind="fixed", extra="") + "</robot>")
    reading = read_arm(written(tmp_path, text), dataclasses.replace(ODD, tip=None))
    assert reading.arm.tip_frame == "tool"
    assert "tip: tool, the only frame" in "\n".join(reading.assumed)


def test_a_base_may_have_the_name_that_mujoco_keeps_for_itself(tmp_path):
    arm = read_arm(written(tmp_path, odd_arm()), dataclasses.replace(ODD, base="world")).arm
    assert arm.base_frame == "world"
    model = mujoco.MjModel.from_xml_string(build_mjcf(arm))
    assert model.nv == RobotModel(arm).pinocchio.nv == arm.n


def test_what_was_assumed_is_listed(tmp_path):
    file = written(tmp_path, odd_arm(joint_5=joint("joint_5", "part_4", "part_5", kind="continuous")))
    reading = read_arm(file, ArmOptions(base="stand", tip="tool"))
    text = "\n".join(reading.assumed)
    for expected in ("finger_joint at 0", "joint_5, which is continuous", "home:", "reach:", "thresholds:"):
        assert expected in text
    assert (reading.arm.joints[4].lower, reading.arm.joints[4].upper) == (-6.2832, 6.2832)
    assert not {"finger_joint", "home:"} & set("\n".join(read_arm(file, ODD).assumed).split())


def test_limits_and_inertias_can_be_given(tmp_path):
    text = odd_arm(
        joint_2=joint("joint_2", "part_1", "part_2", "0 1 0", "continuous", extra=""),
        part_5=link("part_5", 0.0, ball()),
    )
    given = Inertia(2.0, (0.0, 0.0, 0.1), (0.01, 0.01, 0.01, 0.0, 0.0, 0.0))
    limits = {"joint_2": {"lower": -3.0, "upper": 2.0, "velocity": 1.0, "effort": 10.0}, "joint_1": {"upper": 1.0}}
    options = dataclasses.replace(ODD, limits=limits, inertias={"part_5": given})
    arm = read_arm(written(tmp_path, text), options).arm
    assert (arm.joints[1].lower, arm.joints[1].upper, arm.joints[1].torque_limit) == (-3.0, 2.0, 10.0)
    assert (arm.joints[0].lower, arm.joints[0].upper) == (-2.5, 1.0)
    assert arm.inertias()[4].mass == 2.0
    assert math.dist(arm.inertias()[4].center, (0, 0, 0)) == pytest.approx(0.1)


def test_joints_of_the_chain_can_be_held(tmp_path):
    text = odd_arm(joint_2=joint("joint_2", "part_1", "part_2", "0 0 1", "prismatic"))
    options = dataclasses.replace(ODD, fixed={"joint_2": 0.3, **FINGER}, home=(0.0,) * 6)
    arm = read_arm(written(tmp_path, text), options).arm
    assert arm.n == 6 and "joint_2" not in arm.joint_names
    assert arm.inertias()[0].mass == pytest.approx(2.7 + 2.4)


LOST = '<mesh filename="package://x/lost.stl"/>'


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (
            {"joint_3": joint("joint_3", "part_2", "part_3", kind="prismatic")},
            "'joint_3' is of type prismatic; .*under fixed",
        ),
        (
            {"loop": joint("loop", "part_7", "part_2")},
            "closed loop: joints 'joint_2' and 'loop' both move link 'part_2'",
        ),
        ({"part_4": link("part_4", 0.0, ball())}, "link 'part_4' has no mass.*arm.yaml.*inertias:.*part_4: {mass: "),
        (
            {"joint_5": joint("joint_5", "part_4", "part_5", extra="")},
            "'joint_5' has no lower, no upper.*limits:.*joint_5: {lower: ",
        ),
        (
            {name: link(name, extra=collision(LOST.replace("lost", name))) for name in ("part_2", "part_4")},
            "link 'part_2': mesh '.*'; link 'part_4': mesh '.*': not found; .*packages.*capsules",
        ),
        (
            {"part_2": link("part_2", extra=collision('<cone radius="1"/>'))},
            "link 'part_2': .* <cone> is unknown; .*box",
        ),
        (
            {"tool_mount": joint("tool_mount", "part_7", "tool"), "tool": link("tool")},
            "8 joints .* 2 to 7: .*under fixed",
        ),
        (
            {"joint_5": joint("joint_5", "part_4", "part_5", extra='<limit lower="-1" upper="1" velocity="-2"/>')},
            "'joint_5' has velocity -2, no effort. Expected .* a velocity above 0",
        ),
        ({"joint_3": joint("joint_3", "part_2", "part_3", kind="hinge")}, "type = 'hinge'; expected one of revolute"),
        ({"part_2": link("part_2", extra=ball()).replace('<mass value="', '<mass value="-')}, "'part_2' has mass -"),
        ({"stand": link("stand").replace("0.03", "O.03")}, "'stand': inertia iyy = 'O.03'; expected 1 finite number"),
        (
            {"part_2": link("part_2", extra=ball()).replace('"0.02"', '"-0.02"')},
            "'part_2' .* moments .*not all above 0.*inertias:.*part_2: {mass: ",
        ),
        (
            {"part_2": link("part_2", extra=ball()).replace('"0.02"', '"1.02"')},
            "'part_2' .* moments .*inertias:.*part_2: {mass: ",
        ),
    ],
    ids=lambda case: next(iter(case)) if isinstance(case, dict) else "",
)
def test_what_is_no_arm_is_refused_with_name_and_key(changed, expected, tmp_path):
    file = written(tmp_path, odd_arm(**changed))
    with pytest.raises(SettingsError, match=f"(?s)^{file}.*{expected}"):
        read_arm(file, ODD)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"tip": None}, "2 links end a chain of joints: finger, tool; expected .*tip"),
        ({"fixed": {"joint_9": 0.0}}, "fixed: movable joint 'joint_9' does not exist; known: "),
        ({"fixed": {"tool_mount": 1.0}}, "fixed: movable joint 'tool_mount' does not exist; known: "),
        ({"limits": {"tool_mount": {"velocity": 1.0}}}, "limits: movable joint 'tool_mount' does not exist; known: "),
        ({"xacro": {"side": "left"}}, "is no xacro file; expected no arguments under xacro, got side"),
        ({"home": (2.0, *(0.0,) * 6)}, "home has 2 rad for joint 'joint_1'; expected"),
        ({"armature": (0.1,)}, "armature has 1 values; expected 7"),
        ({"armature": -0.1}, "'joint_1' has armature -0.1; expected a number of at least 0"),
        ({"reach": 0.0}, "reach = 0 m; expected a number above 0"),
        ({"reach": 100.0}, "reach = 100 m; expected a number above 0, and no more than the links' "),
        ({"limits": {"joint_1": {"lowr": -1.0}}}, "limits: joint_1: unknown key 'lowr'; did you mean 'lower'"),
        ({"limits": {"joint_1": {"lower": -170.0}}}, "'joint_1' has lower -170, .*; expected lower < upper, in rad"),
        ({"thresholds": {"torque_threshold": (1.0,) * 7}}, "'torque_threshold'; did you mean 'torque_thresholds'"),
        ({"base": "nosuch"}, "base: link 'nosuch' does not exist; known: world, stand"),
        ({"tip": "nosuch"}, "tip: link 'nosuch' does not exist; known: world, stand"),
        ({"base": "tool", "tip": "stand"}, "tip 'stand' is not below base 'tool'"),
    ],
)
def test_options_that_do_not_fit_the_urdf_are_refused(options, expected, tmp_path):
    with pytest.raises(SettingsError, match=expected):
        read_arm(written(tmp_path, odd_arm()), dataclasses.replace(ODD, **options))


def test_words_in_elements_that_nobody_reads_are_left_alone(tmp_path):
    shape = ball().replace("</collision>", '<verbose value="Yes"/></collision>')
    part = link("part_2", extra=shape).replace("</inertial>", '<density value="water"/></inertial>')
    words = read_arm(written(tmp_path, odd_arm(part_2=part)), ODD)
    assert words.arm == read_arm(written(tmp_path, odd_arm(part_2=link("part_2", extra=ball()))), ODD).arm


def test_files_beside_a_description_may_be_empty_and_no_tables_or_of_another(tmp_path):
    file, beside = written(tmp_path, odd_arm()), tmp_path / "arm.yaml"
    beside.write_text("# nothing yet\n")
    assert read_arm_file(file).arm.n == 7
    beside.write_text("joints: []\n")
    with pytest.raises(SettingsError, match=r"arm\.yaml: is a table, which holds the whole arm"):
        read_arm_file(file)
    beside.write_text("urdf: other.urdf\n")
    with pytest.raises(SettingsError, match=r"urdf = other\.urdf, and not arm\.urdf; give .*arm\.yaml as the arm"):
        read_arm_file(file)
    beside.write_text("tip: tool\nhome: [9, 0, 0, 0, 0, 0, 0]\n")
    with pytest.raises(SettingsError, match=r"arm\.urdf with .*arm\.yaml: home has 9 rad"):
        read_arm_file(file)


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit name="millimeter" meter="0.001"/><up_axis>Y_UP</up_axis></asset>
  <library_geometries><geometry id="block"><mesh>
    <source id="places"><float_array id="numbers" count="24">{points}</float_array><technique_common>
      <accessor source="#numbers" count="8" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <vertices id="corners"><input semantic="POSITION" source="#places"/></vertices>
    <triangles count="3"><input semantic="VERTEX" source="#corners" offset="0"/><p>0 1 2 3 4 5 6 7 0</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="all"><node>
    <translate>0 0 50</translate><rotate>0 0 1 90</rotate>
    <node><scale>1 1 2</scale><instance_geometry url="#block"/></node>
  </node></visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#all"/></scene>
</COLLADA>"""


def capsule_of(folder: Path, shape: str) -> Capsule:
    """The capsule that a collision element on part 2 leads to."""
    arm = read_arm(written(folder, odd_arm(part_2=link("part_2", extra=shape))), ODD).arm
    return next(capsule for capsule in arm.capsules if capsule.link == 2)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory) -> Path:
    """A package with a box of 0.04 x 0.12 x 0.04 m as meshes; the URDF belongs into its folder `urdf`."""
    package = tmp_path_factory.mktemp("workspace") / "arm_description"
    for name in ("urdf", "meshes"):
        (package / name).mkdir(parents=True)
    trimesh.creation.box((0.04, 0.12, 0.04)).export(package / "meshes" / "box.stl")
    trimesh.creation.box((0.04, 0.06, 0.01)).export(package / "meshes" / "flat.obj")
    corners = [(x, y, z) for x in (-60, 60) for y in (-20, 20) for z in (-10, 10)]
    written(package / "meshes", COLLADA.format(points=" ".join(f"{x} {y} {z}" for x, y, z in corners)), "box.dae")
    return package / "urdf"


@pytest.mark.parametrize(
    "shape",
    [
        collision('<box size="0.04 0.12 0.04"/>', '<origin xyz="0 0 0.05"/>'),
        collision('<mesh filename="../meshes/box.stl"/>', '<origin xyz="0 0 0.05"/>'),
        collision('<mesh filename="package://arm_description/meshes/box.stl"/>', '<origin xyz="0 0 0.05"/>'),
        collision('<mesh filename="../meshes/flat.obj" scale="1 2 4"/>', '<origin xyz="0 0 0.05"/>'),
        collision('<mesh filename="../meshes/box.dae"/>'),
    ],
    ids=["box", "beside", "package", "scaled", "collada"],
)
def test_a_box_counts_in_metres_where_its_file_and_the_urdf_place_it(shape, meshes):
    found = capsule_of(meshes, shape)
    # Part 2 turns about y, so that y is the z axis of its frame.
    low, high = sorted([found.start, found.end], key=lambda end: end[2])
    assert low == pytest.approx((0.0, -0.05, -0.0549), abs=5e-4) and high == pytest.approx(
        (0.0, -0.05, 0.0549), abs=5e-4
    )
    assert found.radius == pytest.approx(0.0289, abs=2e-4)


def test_a_collada_file_may_hold_points_alone_unless_it_moves_them(meshes):
    text = (meshes / "../meshes/box.dae").read_text()
    points = re.sub(r"<triangles.*</triangles>", "", text)
    written(meshes / "../meshes", points, "moved.dae")
    with pytest.raises(SettingsError, match=r"moved.dae' cannot be read; expected a file with triangles"):
        capsule_of(meshes, collision('<mesh filename="../meshes/moved.dae"/>'))
    written(meshes / "../meshes", re.sub(r"<(translate|rotate|scale)>.*?</\1>", "", points), "points.dae")
    found = capsule_of(meshes, collision('<mesh filename="../meshes/points.dae"/>'))
    assert found == capsule_of(meshes, collision('<box size="0.12 0.04 0.02"/>'))


def test_geometry_without_a_size_counts_for_nothing_and_is_named(tmp_path):
    shapes = collision('<box size="0 0 0"/>', '<origin xyz="1 1 1"/>'), collision('<sphere radius="0"/>')
    text = odd_arm(part_2=link("part_2", extra=shapes[0] + ball()), part_3=link("part_3", extra=shapes[1]))
    reading = read_arm(written(tmp_path, text), ODD)
    by_link = {capsule.link: capsule for capsule in reading.arm.capsules}
    assert by_link[2].radius == pytest.approx(0.05, abs=2e-4) and 3 not in by_link
    found = [line for line in reading.assumed if line.startswith("capsules:")]
    assert found == [
        "capsules: none on part_3, which has no collision geometry",
        "capsules: collision geometry of part_2 has no size",
        "capsules: collision geometry of part_3 has no size",
    ]


def test_a_capsule_stays_one(tmp_path):
    found = capsule_of(tmp_path, collision('<capsule radius="0.05" length="0.3"/>'))
    assert found.radius == pytest.approx(0.05, abs=1e-3)
    assert math.dist(found.start, found.end) == pytest.approx(0.3, abs=2e-3)


def test_capsules_can_be_given_in_the_frames_of_the_urdf(tmp_path):
    given = GivenCapsule((0.0, 0.0, 0.0), (0.0, 0.1, 0.0), 0.03)
    options = dataclasses.replace(ODD, capsules={"part_2": (given,), "part_3": ()})
    capsules = read_arm(written(tmp_path, odd_arm()), options).arm.capsules
    # The first link is a ball on its joint's axis, which belongs to the base.
    assert [capsule.link for capsule in capsules] == [2, 4, 5, 6, 7]
    assert capsules[0].end == pytest.approx((0.0, 0.0, 0.1)) and capsules[0].radius == 0.03


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tipp: tool\n", "unknown key 'tipp'; did you mean 'tip'"),
        ("fixed: {joint_1: .nan}\n", "fixed: joint_1 = nan; expected a finite number"),
        ("inertias: {part_1: {mass: 1, centre: [0, 0, 0], tensor: [1, 1, 1, 0, 0, 0]}}\n", "center"),
    ],
)
def test_options_that_are_wrong_are_refused(text, expected, tmp_path):
    file = written(tmp_path, odd_arm())
    beside = written(tmp_path, text, "arm.yaml")
    with pytest.raises(SettingsError, match=f"^{beside}.*{expected}"):
        read_arm_file(file)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"joint": []}, "unknown key 'joint'; did you mean 'joints'"),
        ({"reach": -1.0}, "reach = -1 m; expected a number above 0"),
        ({"tip_rotation": [0.0] * 4}, "the rotation of the tip is .*; expected a quaternion"),
        ({"home": [9.0] * 7}, "home has 9 rad for joint 'joint_1'; expected an angle in"),
        ({"defaults": {"torque_thresholds": [1.0]}}, "defaults: torque_thresholds has 1 values; expected 7"),
        ({"capsules": [{"link": 8, "start": [0, 0, 0], "end": [0, 0, 1], "radius": 1}]}, "link = 8; expected a number"),
    ],
)
def test_tables_that_are_wrong_are_refused(odd, change, expected):
    with pytest.raises(SettingsError, match=f"^here: .*{expected}"):
        arm_of_table({**table_of(odd[0]), **change}, "here")
