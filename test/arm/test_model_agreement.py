"""Pinocchio and MuJoCo read one MJCF, others the URDF, and must see one robot; Brax: see test/planning."""

import dataclasses

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, WITH_TOOL, random_states

from contact_reach_ros.arm import link_frames
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arms import ARMS, load_arm

SHIPPED = [load_arm(name) for name in ARMS]
ALTERNATIVE = dataclasses.replace(ARM, inertia_sets={"nominal": ARM.inertias("alternative")})
TOLERANCE = 1e-9


@pytest.mark.parametrize("arm", [*SHIPPED, ALTERNATIVE, WITH_TOOL])
def test_pinocchio_agrees_with_mujoco(arm):
    ours, model = RobotModel(arm), mujoco.MjModel.from_xml_string(build_mjcf(arm))
    data, flange = mujoco.MjData(model), model.site("flange").id
    mass_matrix, jacobian = np.zeros((arm.n, arm.n)), np.zeros((6, arm.n))
    for q, v in zip(*random_states(50, arm=arm), strict=True):
        ours.update(q, v)
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass_matrix)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], flange)
        rotation = data.site_xmat[flange].reshape(3, 3)
        theirs = (mass_matrix, data.qfrc_bias, jacobian, data.site_xpos[flange], rotation)
        for mine, other in zip(
            (ours.mass_matrix, ours.bias, ours.jacobian, ours.position, ours.rotation), theirs, strict=True
        ):
            np.testing.assert_allclose(mine, other, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("arm", [ARM, ALTERNATIVE, WITH_TOOL])
def test_urdf_and_table_agree_with_the_mjcf(arm):
    model = pin.buildModelFromXML(build_urdf(arm))
    model.armature[:] = arm.joints[0].armature  # URDF cannot say it.
    data = model.createData()
    frames = [model.getFrameId(name) for name in (*arm.link_names, arm.tip_frame)]
    from_mjcf = RobotModel(arm)
    for q, v in zip(*random_states(50), strict=True):
        from_mjcf.update(q, v)
        pin.computeAllTerms(model, data, q, v)
        pin.updateFramePlacements(model, data)
        np.testing.assert_allclose(data.M, from_mjcf.mass_matrix, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(data.nle, from_mjcf.bias, rtol=0, atol=TOLERANCE)
        rotations, origins = link_frames(arm, q)
        for frame, rotation, origin in zip(frames, rotations, origins, strict=True):
            np.testing.assert_allclose(data.oMf[frame].translation, origin, rtol=0, atol=TOLERANCE)
            np.testing.assert_allclose(data.oMf[frame].rotation, rotation, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(from_mjcf.position, origins[-1], rtol=0, atol=1e-12)
        np.testing.assert_allclose(from_mjcf.rotation, rotations[-1], rtol=0, atol=1e-12)
