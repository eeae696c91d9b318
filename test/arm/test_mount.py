"""Mounted arms: gravity as Pinocchio finds it in the whole URDF, and scenes and postures that stand as the arm does."""

import dataclasses
import math
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, TOOL

from benchmarks.free_motion import FreeMotion
from contact_reach_ros.arm import Arm, assumptions, link_frames, link_frames_of_many
from contact_reach_ros.arm.kinematics import task_jacobians
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.mount import in_words, mounted, scene_frame, standing
from contact_reach_ros.arm.table import ArmOptions, arm_of_table, table_of
from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arm.urdf_reader import read_arm
from contact_reach_ros.arms import ARMS, load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.scenes.placing import free_path
from contact_reach_ros.world.collision import capsule_segments, overlap_depths
from contact_reach_ros.world.rigid import Block, Plane, point_distances
from contact_reach_ros.world.scene import NO_MISMATCH
from contact_reach_ros.world.scene_file import read_scene

MOUNTS = {
    "ceiling": (math.pi, 0.0, 0.4),
    "wall": (0.0, math.pi / 2, 0.0),
    "torso": (-math.pi / 2, 0.0, 0.0),
    "slope": (0.0, math.radians(5.0), 0.0),
}
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
LENGTHS = (0.1, 0.3, 0.3, 0.3, 0.1, 0.1)
MASSES = (3.0, 3.0, 2.0, 1.5, 1.0, 0.5)


def link(name: str, mass: float, length: float) -> str:
    shape = f'<cylinder radius="{0.1 if name == "base" else 0.04}" length="{length}"/>'
    return (
        f'<link name="{name}"><inertial><origin xyz="0.01 -0.02 {length / 2}"/><mass value="{mass}"/>'
        f'<inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial><collision>'
        f'<origin xyz="0 0 {length / 2}"/><geometry>{shape}</geometry></collision></link>'
    )


def joint(name: str, ends: tuple[str, str], xyz: str, rpy: str = "0 0 0", axis: str = "") -> str:
    turns = f'<axis xyz="{axis}"/><limit lower="-2.8" upper="2.8" velocity="2" effort="120"/>'
    return (
        f'<joint name="{name}" type="{"revolute" if axis else "fixed"}"><parent link="{ends[0]}"/>'
        f'<child link="{ends[1]}"/><origin xyz="{xyz}" rpy="{rpy}"/>{turns if axis else ""}</joint>'
    )


def urdf(root: str = "", heavy: float = 1.0) -> str:
    """Six joints on `base`, which what is given leads to from the root; links `heavy` times as heavy."""
    parts, before, below = [root, link("base", 5.0, 0.1)], "base", 0.1
    for number, (axis, length, mass) in enumerate(zip(AXES, (*LENGTHS[1:], 0.1), MASSES, strict=True), 1):
        parts.append(link(f"link_{number}", heavy * mass, length))
        parts.append(joint(f"joint_{number}", (before, f"link_{number}"), f"0 0 {below}", axis=axis))
        before, below = f"link_{number}", length
    parts += ['<link name="tool"/>', joint("tip", (before, "tool"), f"0 0 {below}")]
    return f'<robot name="mounted">{"".join(parts)}</robot>'


def on_root(angles: tuple[float, ...], place: str = "0 0.1 1.2") -> str:
    return '<link name="root"/>' + joint("mount", ("root", "base"), place, " ".join(map(repr, angles)))


def read(folder: Path, text: str, **options) -> Arm:
    (folder / "arm.urdf").write_text(text)
    return read_arm(folder / "arm.urdf", ArmOptions(tip="tool", **options)).arm


def quick(names, chosen):
    """Parameters, of which those that are not chosen take too long for every run."""
    return [name if name in chosen else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.fixture(scope="module", params=quick(MOUNTS, ("ceiling", "slope")))
def mount(request, tmp_path_factory) -> tuple[Arm, str]:
    """An arm on its mount, and the URDF of both."""
    text = urdf(on_root(MOUNTS[request.param]))
    return read(tmp_path_factory.mktemp("mount"), text, base="base"), text


def postures(arm: Arm) -> np.ndarray:
    return np.random.default_rng(0).uniform(arm.lower, arm.upper, (20, arm.n))


def weights(model: pin.Model, q: np.ndarray) -> np.ndarray:
    return np.array([pin.computeGeneralizedGravity(model, model.createData(), each) for each in q])


def simulated(arm: Arm, q: np.ndarray) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(build_mjcf(arm))
    data, found = mujoco.MjData(model), []
    for each in q:
        data.qpos[:] = each
        mujoco.mj_forward(model, data)
        found.append(data.qfrc_bias.copy())
    return np.array(found)


def test_every_model_of_a_mounted_arm_weighs_what_pinocchio_finds_in_the_whole_urdf(mount):
    arm, text = mount
    q = postures(arm)
    expected = weights(pin.buildModelFromXML(text), q)
    upright = weights(pin.buildModelFromXML(urdf()), q)
    assert np.abs(expected - upright).max() > 1.0
    printed = pin.buildModelFromXML(build_urdf(arm))
    for found in (weights(RobotModel(arm).pinocchio, q), simulated(arm, q), weights(printed, q)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_it_weighs_the_same_with_the_mount_in_the_options_and_in_a_table(mount, tmp_path, request):
    arm, _ = mount
    angles = MOUNTS[request.node.callspec.params["mount"]]
    given = read(tmp_path, urdf(), mount=angles)
    np.testing.assert_allclose(given.gravity, arm.gravity, rtol=0, atol=1e-9)
    # What the options say counts, whatever the URDF has.
    assert read(tmp_path, urdf(on_root((1.0, 1.0, 0.0))), base="base", mount=angles).gravity == given.gravity
    table = {key: value for key, value in table_of(ARM).items() if key != "gravity"}
    assert arm_of_table({**table, "mount": list(angles)}, "table").gravity == given.gravity
    assert arm_of_table(table_of(given), "table") == given != read(tmp_path, urdf())


def test_a_tool_weighs_on_a_mounted_arm_as_pinocchio_says(mount):
    arm, text = mount
    theirs, q = pin.buildModelFromXML(text), postures(arm)
    tip = theirs.frames[theirs.getFrameId("tool")]
    xx, yy, zz, xy, xz, yz = TOOL.inertia
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    theirs.appendBodyToJoint(tip.parentJoint, pin.Inertia(TOOL.mass, np.array(TOOL.center), tensor), tip.placement)
    held = arm.with_tool(TOOL)
    for found in (weights(RobotModel(held).pinocchio, q), simulated(held, q)):
        np.testing.assert_allclose(found, weights(theirs, q), rtol=0, atol=1e-6)


def test_without_a_base_the_arm_begins_at_the_root_and_hangs_there_too(tmp_path):
    text = urdf(on_root(MOUNTS["ceiling"]))
    arm = read(tmp_path, text)
    q = postures(arm)
    assert arm.base_frame == "root" and arm.gravity == (0.0, 0.0, -9.81)
    np.testing.assert_allclose(
        weights(RobotModel(arm).pinocchio, q), weights(pin.buildModelFromXML(text), q), rtol=0, atol=1e-6
    )


def test_a_waist_is_held_and_leans_the_arm(tmp_path):
    waist = joint("waist", ("root", "torso"), "0 0 0.5", axis="0 1 0") + link("torso", 9.0, 0.3)
    text = urdf('<link name="root"/>' + waist + joint("mount", ("torso", "base"), "0 0 0.3", "0.5 0 0.2"))
    arm = read(tmp_path, text, base="base", fixed={"waist": 0.7})
    q = postures(arm)
    states = np.column_stack([np.full(len(q), 0.7), q])
    whole = weights(pin.buildModelFromXML(text), states)
    np.testing.assert_allclose(weights(RobotModel(arm).pinocchio, q), whole[:, 1:], rtol=0, atol=1e-6)
    reading = read_arm(tmp_path / "arm.urdf", ArmOptions(base="base", tip="tool"))
    assert any(line.startswith("fixed: waist at 0") for line in reading.assumed)
    assert any(line.startswith("mount: root stands upright: gravity (") for line in reading.assumed)


def test_a_turn_about_the_vertical_changes_nothing(tmp_path):
    turned = read(tmp_path, urdf(on_root((0.0, 0.0, 1.5708))), base="base")
    assert turned == read(tmp_path, urdf()) and turned.gravity == (0.0, 0.0, -9.81)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"mount": [180.0, 0.0, 0.0]}, r"table: mount = \[180.0, 0.0, 0.0\]; expected roll, pitch and yaw .* in rad"),
        ({"mount": [0.0, math.nan, 0.0]}, "table: mount = nan; expected a finite number"),
        ({"mount": [0.0, 0.0]}, "table: .* length 3, got 2 - at `mount`"),
        ({"mount": [0.0, 0.0, 0.0], "gravity": [0.0, 0.0, 9.81]}, "has mount and gravity.*; expected one of them"),
        ({"gravity": [0.0, 0.0, 0.0]}, r"gravity = \[0.0, 0.0, 0.0\]; expected its acceleration"),
    ],
)
def test_what_is_no_mount_is_refused(changes, expected):
    table = {key: value for key, value in table_of(ARM).items() if key != "gravity"}
    with pytest.raises(SettingsError, match=expected):
        arm_of_table({**table, **changes}, "table")


def test_words_name_the_frame_and_the_angle():
    assert in_words(ARM) == "gravity 9.81 m/s² along -z of lbr_link_0"
    wall = dataclasses.replace(ARM, gravity=mounted(MOUNTS["wall"]))
    assert in_words(wall) == "gravity (9.81, 0, 0) m/s² in lbr_link_0, whose z axis is 90.0° from up"


@pytest.mark.parametrize("moves", [False, True])
def test_a_mounted_arm_is_held_and_moves_without_an_external_torque(mount, moves):
    arm, _ = mount
    budget = ContactBudget()
    ideal = dataclasses.replace(NO_MISMATCH, noise_scale=0.0)
    motion = FreeMotion(arm, ideal, 0, budget, moves=moves)
    farthest = largest = 0.0
    while motion.plant.time < (5.0 if moves else 1.5):
        motion.tick()
        if motion.is_handed_over:
            largest = max(largest, float(np.abs(motion.observer.momentum.residual).max()))
        farthest = max(farthest, float(np.abs(motion.plant.joint_positions - arm.home).max()))
    assert not motion.monitor.stopped and motion.monitor.contacts == 0
    assert farthest > 0.02 if moves else farthest < 1e-3
    assert largest < 0.5


def test_a_model_of_another_mount_is_refused_at_handover_with_the_gravity_that_it_assumes(mount):
    arm, _ = mount
    leaned = dataclasses.replace(arm, gravity=(*(-np.array(arm.gravity)).tolist(),))
    model, true = RobotModel(arm), RobotModel(leaned)
    motion = FreeMotion(arm, NO_MISMATCH, 0, ContactBudget())
    q, rest = np.array(arm.home), np.zeros(arm.n)
    for tick in range(1000):
        motion.monitor.update(true.gravity_at(q) - model.gravity_at(q), q, rest, 1e-3 * tick)
    assert motion.monitor.stop_reason.startswith("at hand-over external torque on joint_2 is ")
    assert motion.monitor.stop_reason.endswith(f"wrong weight; it assumes {in_words(arm)}")


@pytest.mark.parametrize("name", ARMS)
def test_shipped_arms_stand_in_their_base_frame(name):
    arm = load_arm(name)
    assert standing(arm) is arm


@pytest.fixture(
    scope="module",
    params=quick(
        [*MOUNTS, "table", "torso with the root as base", "beside the root", "below the root"],
        ("wall", "below the root"),
    ),
)
def stood(request, tmp_path_factory) -> Arm:
    """An arm that stands or hangs somewhere, with its base or the root as its base frame."""
    roots = {
        "table": on_root((0.0, 0.0, 0.0), "0 0 0.75"),
        "torso with the root as base": on_root(MOUNTS["torso"]),
        "beside the root": on_root((0.0, 0.0, 2.0), "0.7 -0.8 0"),
        "below the root": on_root((math.pi, 0.0, 0.0), "0 0 -0.1"),
    }
    folder = tmp_path_factory.mktemp("scenes")
    if request.param in roots:
        return read(folder, urdf(roots[request.param]))
    return read(folder, urdf(on_root(MOUNTS[request.param])), base="base")


def test_home_is_far_from_singularities_where_in_front_is_on_the_first_axis():
    """Of a UR10 that reaches out of a slope, whose first axis points ahead and up."""
    arm = dataclasses.replace(load_arm("ur10"), gravity=(6.9, 0.0, -6.9))
    rotations, origins = link_frames_of_many(arm, np.array([assumptions.home(arm)]))
    jacobian = task_jacobians(rotations, origins / arm.reach, arm.task)[0]
    assert np.linalg.svd(jacobian, compute_uv=False)[-1] > 0.15


class TestWhereScenesStand:
    """In the scene frame: z up, below the shoulder, whatever the base frame is."""

    def test_it_is_the_same_arm_there(self, stood):
        own, frame = standing(stood), scene_frame(stood)
        q = postures(stood)
        np.testing.assert_allclose(
            frame.outward(link_frames_of_many(own, q)[1].transpose(0, 2, 1)),
            link_frames_of_many(stood, q)[1].transpose(0, 2, 1),
            rtol=0,
            atol=1e-9,
        )
        ours, theirs = RobotModel(own), RobotModel(stood)
        np.testing.assert_allclose(weights(ours.pinocchio, q), weights(theirs.pinocchio, q), rtol=0, atol=1e-7)
        assert own.gravity[:2] == (0.0, 0.0) and np.linalg.det(frame.rotation) == pytest.approx(1.0)
        np.testing.assert_allclose(frame.rotation[:, 2], -np.array(stood.gravity) / 9.81, rtol=0, atol=1e-6)

    def test_home_is_in_front_of_the_shoulder_with_the_tip_down(self, stood):
        own = standing(stood)
        rotations, origins = link_frames(own, stood.home)
        out = origins[-1] - own.shoulder
        assert 0.4 * stood.reach < out[0] < 0.9 * stood.reach and abs(out[1]) < 0.3 * out[0]
        assert rotations[-1][2, 2] < -0.7
        assert min(origin[2] for origin in origins[1:]) > 0.0

    @pytest.mark.parametrize("name", ["free", "ball"])
    def test_targets_are_around_the_shoulder_above_the_floor(self, stood, name):
        for seed in range(3):
            scene, own, frame = load_scene(name, stood, seed), standing(stood), scene_frame(stood)
            box, factor = read_scene(name).target, stood.reach / ARM.reach
            target = frame.inward(scene.target)
            assert (target >= factor * np.array(box.minimum) - 1e-9).all()
            assert (target <= factor * np.array(box.maximum) + 1e-9).all()
            assert np.linalg.norm(target - own.shoulder) < stood.reach
            (floor,) = scene.environment
            np.testing.assert_allclose(floor.normal, frame.rotation[:, 2], atol=1e-12)
            assert point_distances(scene.environment, scene.target) == pytest.approx(target[2] + 0.1)
            path = free_path(RobotModel(stood), scene.start, scene.target)
            np.testing.assert_allclose(link_frames(stood, path[-1])[1][-1], scene.target, rtol=0, atol=1e-3)
            for ball in scene.obstacles:
                depth = overlap_depths(stood, *capsule_segments(stood, path), ball.rest, ball.radius).max()
                assert 0.019 * factor < depth < 0.051 * factor

    def test_a_given_target_is_in_the_base_frame(self, stood):
        target = load_scene("ball", stood, 0).target
        np.testing.assert_allclose(load_scene("ball", stood, 1, target).target, target, atol=1e-12)


@pytest.mark.parametrize("name", quick(MOUNTS, ("ceiling",)))
def test_walls_stand_one_above_the_other(name):
    arm = dataclasses.replace(load_arm("ur10"), gravity=mounted(MOUNTS[name]))
    scene = load_scene("wall", arm, 0)
    lower, upper = (each.rest for each in scene.obstacles)
    up = scene_frame(arm).rotation[:, 2]
    between = upper.mean(axis=0) - lower.mean(axis=0)
    np.testing.assert_allclose(between / np.linalg.norm(between), up, atol=1e-9)
    assert (lower @ up).max() < (upper @ up).min()


def test_rigid_bodies_move_with_the_frame():
    rotation = pin.rpy.rpyToMatrix(0.3, -0.8, 1.1)
    origin, random = np.array([0.2, -0.1, 0.5]), np.random.default_rng(0)
    points = random.uniform(-1.0, 1.0, (50, 3))
    for body in (Plane("wall", (0.1, 0.2, 0.3), (1.0, 2.0, -1.0)), Block("box", (0.1, 0.2, 0.3), (0.2, 0.3, 0.6))):
        moved = body.moved(rotation, origin)
        expected, found = point_distances((body,), points), point_distances((moved,), points @ rotation.T + origin)
        np.testing.assert_allclose(found, expected, atol=1e-12)
