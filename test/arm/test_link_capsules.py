"""Capsules of arms out of URDFs: around all collision geometry, several for what is fixed, none left out silently."""

import json
from pathlib import Path

import coal
import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from arm_simulation import ARM

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.capsule_fit import POOR
from contact_reach_ros.arm.capsules import (
    self_pairs,
    shape_name,
    shape_radii,
    shape_segments,
    shapes,
)
from contact_reach_ros.arm.mjcf import build_mjcf, capsule_names
from contact_reach_ros.arm.table import ArmOptions, GivenCapsule, arm_of_table, table_of
from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arm.urdf_reader import Reading, read_arm
from contact_reach_ros.arms import ARMS, load_arm
from contact_reach_ros.doctor.arm_check import check_arm
from contact_reach_ros.errors import InputError
from contact_reach_ros.simulation.obstacles import self_contacts
from contact_reach_ros.world.collision import check_hand, nearest
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.rigid import Plane

OUTSIDE = 5e-4
"""How far collision geometry may stand out of its capsules, m."""


def shape(kind: str, at: str = "0 0 0", turned: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{at}" rpy="{turned}"/><geometry><{kind}/></geometry></collision>'


def cylinder(radius: float, length: float) -> str:
    """It stands on the link's origin."""
    return shape(f'cylinder radius="{radius}" length="{length}"', f"0 0 {0.5 * length}")


def link(name: str, *shapes: str) -> str:
    inertial = (
        '<inertial><origin xyz="0 0 0.1"/><mass value="2"/>'
        '<inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    return f'<link name="{name}">{inertial}{"".join(shapes)}</link>'


def joint(parent: str, child: str, at: str, axis: str = "0 0 1", kind: str = "revolute", turned: str = "0 0 0") -> str:
    return (
        f'<joint name="{child}_joint" type="{kind}"><origin xyz="{at}" rpy="{turned}"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/><limit lower="-2.5" upper="2.5" velocity="2" effort="90"/></joint>'
    )


def fixed(parent: str, child: str, at: str, turned: str = "0 0 0") -> str:
    return joint(parent, child, at, kind="fixed", turned=turned)


def six_links(prefix: str = "", base: str = "base", first: str = "") -> str:
    """Six joints on a base; `first`: more shapes of the first link."""
    rows = ("0 0 1", 0.3), ("0 1 0", 0.3), ("0 1 0", 0.3), ("0 0 1", 0.1), ("0 1 0", 0.1), ("0 0 1", 0.1)
    parts, parent, height = [link(base, cylinder(0.08, 0.1))], base, 0.1
    for number, (axis, length) in enumerate(rows, 1):
        name = f"{prefix}link_{number}"
        parts.append(link(name, cylinder(0.05 if number == 1 else 0.04, length), first if number == 1 else ""))
        parts.append(joint(parent, name, f"0 0 {height}", axis))
        parent, height = name, length
    return "".join([*parts, f'<link name="{prefix}tool"/>', fixed(parent, f"{prefix}tool", f"0 0 {height}")])


TORSO = link("torso", shape('box size="0.2 0.3 0.6"', "0 0 0.3"))
TWO_ARMS = (
    TORSO
    + fixed("torso", "left_base", "0 0.2 0.6")
    + fixed("torso", "right_base", "0 -0.2 0.6")
    + six_links("left_", "left_base")
    + six_links("right_", "right_base")
)
RAIL = link("ground", shape('box size="2 0.2 0.1"', "0 0 0.05")) + joint(
    "ground", "base", "0 0 0.1", "1 0 0", "prismatic"
)
PLATFORM = link("platform", shape('box size="0.8 0.6 0.3"', "0 0 0.15")) + fixed("platform", "base", "0.2 0 0.3")
TABLE = link("table", shape('box size="1.5 1 0.05"', "0 0 0.725")) + fixed("table", "base", "0 0 0.75")
MOUNTED = {
    "plain": (six_links(), {}),
    "head on the first axis": (six_links(first=shape('sphere radius="0.18"', "0 0 0.45")), {}),
    "elbow off the first axis": (six_links(first=shape('box size="0.4 0.1 0.1"', "0.2 0 0.3")), {}),
    "two arms": (TWO_ARMS, {"tip": "left_tool"}),
    "two arms seen from one": (TWO_ARMS, {"base": "left_base", "fixed": {"right_link_2_joint": 1.2}}),
    "rail": (RAIL + six_links(), {"fixed": {"base_joint": 0.5}}),
    "above the base": (PLATFORM + six_links(), {"base": "base"}),
    "on a table": (TABLE + six_links(), {"base": "base"}),
    "sideways": (TORSO + fixed("torso", "base", "0 0.15 0.4", "-1.5708 0 0") + six_links(), {"base": "base"}),
    "askew": (TORSO + fixed("torso", "base", "0.1 0.15 0.4", "-0.7 0.3 0.4") + six_links(), {}),
}


def read(folder: Path, links: str, **options) -> Reading:
    file = folder / "arm.urdf"
    file.write_text(f'<robot name="mounted">{links}</robot>')
    return read_arm(file, ArmOptions(**options))


def base_radii(arm: Arm) -> dict[str, float]:
    return {shape_name(arm, number): capsule.radius for number, capsule in enumerate(arm.base_capsules)}


def named(arm: Arm, pairs: tuple[tuple[int, int], ...]) -> set[tuple[str, str]]:
    return {(shape_name(arm, first), shape_name(arm, second)) for first, second in pairs}


def surface(geometry: coal.CollisionGeometry) -> np.ndarray:
    """Points (N, 3) of a shape among which are those that are farthest out, in its frame, m."""
    if isinstance(geometry, coal.Box):
        return geometry.halfSide * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    if not isinstance(geometry, coal.Sphere | coal.Cylinder):
        return np.array(geometry.vertices())
    angles = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    circle = geometry.radius * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    if isinstance(geometry, coal.Cylinder):
        up = np.array([0.0, 0.0, geometry.halfLength])
        return np.concatenate([circle - up, circle + up])
    return np.concatenate([np.roll(circle, turns, axis=1) for turns in range(3)])


def standing_out(arm: Arm, file: Path, held: dict[str, float]) -> float:
    """By how much collision shapes of a URDF stand out of the capsules of their link, m, the most in random postures.

    Pinocchio reads and places the shapes. The first link's capsule may be one of the base.
    """
    model = pin.buildModelFromUrdf(str(file))
    geometry = pin.buildGeomFromUrdf(model, str(file), pin.COLLISION, package_dirs=[str(file.parent)])
    q, still = pin.neutral(model), [name for name in model.names[1:] if name not in arm.joint_names]
    for name, position in held.items():
        q[model.idx_qs[model.getJointId(name)]] = position
    model, geometry = pin.buildReducedModel(model, geometry, [model.getJointId(name) for name in still], q)
    data, places = model.createData(), pin.GeometryData(geometry)
    base, out = model.frames[model.getFrameId(arm.base_frame, pin.BODY)].placement, []
    for q in np.random.default_rng(0).uniform(arm.lower, arm.upper, (5, arm.n)):
        pin.updateGeometryPlacements(model, data, geometry, places, q)
        starts, ends = (points[0] for points in shape_segments(arm, q[None]))
        for number, body in enumerate(geometry.geometryObjects):
            links = {body.parentJoint, *([0] if body.parentJoint == 1 else [])}
            own = [index for index, capsule in enumerate(shapes(arm)) if capsule.link in links]
            place = base.actInv(places.oMg[number])
            points = surface(body.geometry) @ place.rotation.T + place.translation
            axes = (ends - starts)[own]
            shares = np.einsum("pca,ca->pc", points[:, None] - starts[own], axes) / (axes**2).sum(axis=1)
            nearest = starts[own] + np.clip(shares, 0.0, 1.0)[:, :, None] * axes
            apart = np.linalg.norm(points[:, None] - nearest, axis=2) - shape_radii(arm)[own]
            out.append(apart.min(axis=1).max())
    return float(max(out))


@pytest.mark.parametrize(("links", "options"), MOUNTED.values(), ids=MOUNTED)
def test_all_collision_geometry_is_inside_capsules_and_poor_fits_are_named(links, options, tmp_path, capsys):
    options = {"tip": "left_tool" if "left" in links else "tool", **options}
    reading = read(tmp_path, links, **options)
    assert standing_out(reading.arm, tmp_path / "arm.urdf", options.get("fixed", {})) < OUTSIDE
    (tmp_path / "arm.yaml").write_text(json.dumps(options))
    check_arm(str(tmp_path / "arm.urdf"))
    said = capsys.readouterr().out.replace("\n", " ")
    for name, fit in reading.fits.items():
        assert (f"poor fit: the capsule on {name} " in said) == (fit.volume_ratio > POOR)


def random_links(seed: int, folder: Path) -> str:
    """A stand, a base, a shelf and six links with random shapes, each of them nearly the same a second time."""
    random = np.random.default_rng(seed)
    trimesh.creation.icosphere(subdivisions=2, radius=0.05).apply_scale((1, 2, 3)).export(folder / "egg.stl")
    trimesh.creation.annulus(0.03, 0.06, 0.2).export(folder / "tube.obj")

    def three(scale: float) -> np.ndarray:
        return random.uniform(-scale, scale, 3)

    def text(values: np.ndarray) -> str:
        return " ".join(map(repr, values.tolist()))

    def twice() -> str:
        radius, length, at, turned = random.uniform(0.02, 0.1), random.uniform(0.02, 0.4), three(0.1), text(three(3.0))
        kind = random.choice(
            [
                f'sphere radius="{radius}"',
                f'cylinder radius="{radius}" length="{length}"',
                f'box size="{radius} {length} {0.5 * length}"',
                'mesh filename="egg.stl" scale="1 -0.5 1"',
                'mesh filename="tube.obj"',
            ]
        )
        return shape(kind, text(at), turned) + shape(kind, text(at + three(1e-9)), turned)

    def some(name: str) -> str:
        return link(name, *(twice() for _ in range(random.integers(1, 4))))

    parts = [some("stand")]
    for name in ("base", "shelf"):
        parts += [some(name), fixed("stand", name, text(three(0.3)), text(three(3.0)))]
    parent = "base"
    for number in range(1, 7):
        name = f"link_{number}"
        parts += [some(name), joint(parent, name, text(three(0.3)), text(three(1.0)), turned=text(three(3.0)))]
        parent = name
    return "".join(parts)


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_all_collision_geometry_of_random_arms_is_inside_capsules(seed, tmp_path):
    links = random_links(seed, tmp_path)
    base = ("stand", "base")[seed % 2]
    reading = read(tmp_path, links, base=base, tip="link_6", reach=1.0, home=(0.0,) * 6)
    assert standing_out(reading.arm, tmp_path / "arm.urdf", {}) < OUTSIDE
    assert {"stand", "base", "shelf"} <= set(base_radii(reading.arm))


@pytest.mark.parametrize("name", ARMS)
def test_a_shipped_arm_written_as_a_urdf_is_inside_the_capsules_that_are_read_from_it(name, tmp_path):
    arm = load_arm(name)
    links = build_urdf(arm).partition(">")[2].removesuffix("</robot>")
    again = read(tmp_path, links, home=arm.home, reach=arm.reach).arm
    assert standing_out(again, tmp_path / "arm.urdf", {}) < OUTSIDE
    for ours, theirs in zip(shapes(again), shapes(arm), strict=True):
        assert ours.radius == pytest.approx(theirs.radius, abs=2e-4)


def test_a_first_link_around_its_axis_belongs_to_the_base_however_that_is_mounted(tmp_path):
    for name in ("plain", "head on the first axis", "sideways", "askew"):
        assert "link_1" in base_radii(read(tmp_path, MOUNTED[name][0], tip="tool").arm), name
    elbow = read(tmp_path, MOUNTED["elbow off the first axis"][0]).arm
    assert "link_1" not in base_radii(elbow) and elbow.contact_links[0] == "link_1"


def test_each_fixed_link_has_its_own_capsule_and_the_arm_is_kept_from_it(tmp_path):
    arm = read(tmp_path, TWO_ARMS, tip="left_tool").arm
    radii = base_radii(arm)
    assert {"torso", "left_base", "right_base", *(f"right_link_{k}" for k in range(1, 7))} <= set(radii)
    # Around the torso's corners in its cross section, 0.18 m; around everything it would be 0.28 m.
    assert radii["torso"] < 0.2 and max(radii.values()) == radii["torso"]
    pairs = named(arm, self_pairs(arm))
    assert {("torso", "left_link_6"), ("right_link_6", "left_link_6"), ("left_base", "left_link_5")} <= pairs
    assert not any(second.startswith("right") for _, second in pairs)
    rail = read(tmp_path, *MOUNTED["rail"][:1], fixed={"base_joint": 0.5}, tip="tool").arm
    assert base_radii(rail)["ground"] < 0.12
    assert ("ground", "link_6") in named(rail, self_pairs(rail))


def test_what_is_above_the_base_is_the_same_as_seen_from_the_root(tmp_path):
    below, above = (read(tmp_path, MOUNTED["above the base"][0], base=base).arm for base in ("platform", "base"))
    assert base_radii(below) == pytest.approx(base_radii(above), abs=3e-4)
    assert set(base_radii(above)) == {"platform", "base", "link_1"}
    assert named(above, self_pairs(above)) == named(below, self_pairs(below))
    assert named(above, self_pairs(above)) >= {("platform", "link_4"), ("platform", "link_6")}


def test_a_link_that_is_only_shown_counts_beside_a_small_one_that_is_fixed_to_it(tmp_path):
    shown = cylinder(0.04, 0.3).replace("collision>", "visual>")
    bracket = link("bracket", shape('box size="0.01 0.01 0.01"', "0 0 0.1")) + joint(
        "link_3", "bracket", "0 0 0", kind="fixed"
    )
    text = six_links().replace(link("link_3", cylinder(0.04, 0.3), ""), link("link_3", shown)) + bracket
    assert "<visual>" in text
    reading = read(tmp_path, text)
    assert any("visual geometry" in line and "link_3" in line for line in reading.assumed)
    (capsule,) = (each for each in reading.arm.capsules if each.link == 3)
    assert capsule.radius > 0.035


def test_a_mark_without_mass_is_named(tmp_path):
    wall = '<link name="wall"><visual><geometry><box size="0.02 2 2"/></geometry></visual></link>'
    reading = read(tmp_path, TABLE + six_links() + wall + fixed("table", "wall", "0.5 0 0"), base="base")
    assert "capsules: none on wall, taken for a mark since it has no mass" in reading.assumed


def test_a_table_leaves_room_above_it(tmp_path):
    arm = read(tmp_path, MOUNTED["on a table"][0], base="base").arm
    heights = [
        max(c.start[2], c.end[2]) + c.radius for n, c in enumerate(arm.base_capsules) if shape_name(arm, n) == "table"
    ]
    assert len(heights) > 1 and max(heights) < 0.06
    check_hand(arm, Target(np.array([0.5, 0.0, 0.2]), None), ())
    with pytest.raises(InputError, match="deep in table"):
        check_hand(arm, Target(np.array([0.5, 0.0, 0.0]), None), ())


def test_pairs_that_overlap_at_home_are_named(tmp_path, capsys):
    # The elbow is bent so far that the hand is in the platform.
    home = (0.0, 0.9, 2.4, 0.0, 0.0, 0.0)
    arm = read(tmp_path, MOUNTED["above the base"][0], base="base", home=home).arm
    dropped = named(arm, self_pairs(arm, overlapping=True))
    assert dropped and not dropped & named(arm, self_pairs(arm))
    (tmp_path / "arm.yaml").write_text(json.dumps({"base": "base", "home": home}))
    check_arm(str(tmp_path / "arm.urdf"))
    said = capsys.readouterr().out.replace("\n", " ")
    assert "not kept apart" in said
    for first, second in dropped:
        assert f"{first} and {second} (by " in said


@pytest.mark.slow
def test_a_home_that_nobody_gave_drops_no_pair(tmp_path):
    for name, (links, options) in MOUNTED.items():
        options = {"tip": "left_tool" if "left" in links else "tool", **options}
        assert not self_pairs(read(tmp_path, links, **options).arm, overlapping=True), name


def test_given_capsules_are_all_used_and_the_rest_is_fitted(tmp_path):
    two = tuple(GivenCapsule((x, 0.0, 0.0), (x, 0.0, 0.6), 0.1) for x in (-0.05, 0.05))
    arm = read(tmp_path, TWO_ARMS, tip="left_tool", capsules={"torso": two, "left_link_6": two, "right_base": ()}).arm
    torso = [capsule for number, capsule in enumerate(arm.base_capsules) if shape_name(arm, number) == "torso"]
    assert [(capsule.start, capsule.end, capsule.radius) for capsule in torso] == [
        (given.start, given.end, given.radius) for given in two
    ]
    assert "right_base" not in base_radii(arm) and "left_base" in base_radii(arm)
    assert [capsule.radius for capsule in arm.capsules if capsule.link == 6] == [0.1, 0.1]


def test_a_base_without_geometry_is_no_obstacle(tmp_path):
    links = six_links().replace(link("base", cylinder(0.08, 0.1)), link("base"))
    reading = read(tmp_path, links, capsules={"link_1": ()})
    arm = reading.arm
    assert arm.base_capsules == () and "capsules: none on base, which has no collision geometry" in reading.assumed
    model = mujoco.MjModel.from_xml_string(build_mjcf(arm, contacts=self_contacts(arm)))
    assert [model.geom(number).name for number in range(model.ngeom)] == list(capsule_names(arm))
    floor = Plane("floor", (0.0, 0.0, 0.0))
    assert nearest(arm, np.array([arm.home]), (floor,))[0].link in arm.link_names
    check_hand(arm, Target(np.array([0.0, 0.0, 0.1]), None), ())


def test_tables_with_one_base_capsule_are_read_and_have_the_same_digest():
    table = table_of(ARM)
    (one,) = table.pop("base_capsules")
    again = arm_of_table({**table, "base_capsule": one}, "table")
    assert again == ARM and again.base_capsules == ARM.base_capsules
