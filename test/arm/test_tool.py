"""A tool at the flange: what it makes of the arm, and which values are none."""

import re
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from arm_simulation import ARM, TOOL, WITH_TOOL, random_states
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm import link_frames
from contact_reach_ros.arm.mjcf import build_mjcf, numbers
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import arm_in, load_arm
from contact_reach_ros.errors import SettingsError

MASS, CENTER, TENSOR, TIP = TOOL.mass, TOOL.center, TOOL.inertia, TOOL.flange_to_tip


@pytest.fixture(params=[ARM, WITH_TOOL], ids=["iiwa", "tool"])
def bare(request):
    """A tool on a tool is mounted at the first one's tip."""
    return request.param


def test_without_a_tool_it_is_the_same_arm():
    assert ARM.with_tool(Tool()) is ARM
    assert arm_in({"tool.mass": 0.0}, "test") is load_arm()


def test_the_tip_is_where_the_tool_has_it(bare):
    arm = bare.with_tool(TOOL)
    for q in random_states(20)[0]:
        rotations, origins = link_frames(bare, q)
        tip_rotations, tip_origins = link_frames(arm, q)
        np.testing.assert_allclose(tip_origins[-1], origins[-1] + rotations[-1] @ TIP[:3], atol=1e-11)
        turn = Rotation.from_euler("xyz", TIP[3:]).as_matrix()
        np.testing.assert_allclose(tip_rotations[-1], rotations[-1] @ turn, atol=1e-11)


def test_weight_and_inertia_are_those_of_a_body_fixed_to_the_flange(bare):
    """MuJoCo attaches it by itself; nothing is composed there."""
    root = ElementTree.fromstring(build_mjcf(bare))
    flange = root.find(f".//body[@name='{bare.tip_frame}']")
    ElementTree.SubElement(flange, "inertial", mass=repr(MASS), pos=numbers(CENTER), fullinertia=numbers(TENSOR))
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    data, composed = mujoco.MjData(model), RobotModel(bare.with_tool(TOOL))
    mass_matrix = np.zeros((ARM.n, ARM.n))
    for q, v in zip(*random_states(50), strict=True):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass_matrix)
        composed.update(q, v)
        np.testing.assert_allclose(composed.mass_matrix, mass_matrix, rtol=0, atol=1e-9)
        np.testing.assert_allclose(composed.bias, data.qfrc_bias, rtol=0, atol=1e-9)


def test_a_radius_gives_it_a_capsule_from_flange_to_tip():
    arm = ARM.with_tool(TOOL)
    (added,) = arm.capsules[len(ARM.capsules) :]
    assert (added.link, added.start, added.end, added.radius) == (ARM.n, ARM.tip_offset, arm.tip_offset, 0.02)
    assert arm.contact_links == ARM.contact_links
    assert ARM.with_tool(Tool(mass=1.0)).capsules == ARM.capsules


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mass": -1.0}, "Tool.mass = -1.0: expected a number in [0, 50] kg"),
        ({"inertia": (0.01, 0.01, 0.01, 0.0, 0.0, 0.0)}, "expected zeros, as mass = 0 kg"),
        ({"mass": 1.0, "inertia": (0.01, 0.01, 0.05, 0.0, 0.0, 0.0)}, "none above the sum of the others"),
        ({"flange_to_tip": (0.0, 0.0, 120.0, 0.0, 0.0, 0.0)}, "Tool.flange_to_tip"),
        ({"radius": 0.02}, "expected 0 where flange_to_tip leads nowhere"),
    ],
)
def test_what_is_no_tool_is_refused_with_what_was_expected(values, message):
    with pytest.raises(SettingsError, match=re.escape(message)):
        Tool(**values)
