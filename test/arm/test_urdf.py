"""The URDF describes the same robot as the MJCF."""

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, WITH_TOOL, random_states
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.arm.kinematics import link_frames, rotation_about
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.urdf import build_urdf, roll_pitch_yaw


def rotation_from_angles(roll: float, pitch: float, yaw: float) -> np.ndarray:
    return rotation_about((0, 0, 1), yaw) @ rotation_about((0, 1, 0), pitch) @ rotation_about((1, 0, 0), roll)


@pytest.mark.parametrize(("arm", "inertia_set"), [(ARM, "nominal"), (ARM, "alternative"), (WITH_TOOL, "nominal")])
def test_urdf_agrees_with_mjcf(arm, inertia_set):
    model = pin.buildModelFromXML(build_urdf(arm, inertia_set))
    model.armature[:] = ARM.joints[0].armature  # URDF cannot say it.
    data = model.createData()
    frames = [model.getFrameId(name) for name in (*ARM.link_names, ARM.tip_frame)]
    from_mjcf = RobotModel(arm, inertia_set)
    for q, v in zip(*random_states(200), strict=True):
        from_mjcf.update(q, v)
        pin.computeAllTerms(model, data, q, v)
        pin.updateFramePlacements(model, data)
        np.testing.assert_allclose(data.M, from_mjcf.mass_matrix, rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.nle, from_mjcf.bias, rtol=0, atol=1e-9)
        for frame, rotation, origin in zip(frames, *link_frames(arm, q), strict=True):
            np.testing.assert_allclose(data.oMf[frame].translation, origin, rtol=0, atol=1e-9)
            np.testing.assert_allclose(data.oMf[frame].rotation, rotation, rtol=0, atol=1e-9)


angles = st.floats(-3.1, 3.1)


@given(angles, st.one_of(angles, st.sampled_from([np.pi / 2, -np.pi / 2])), angles)
def test_roll_pitch_yaw_gives_the_rotation_back(roll, pitch, yaw):
    rotation = rotation_from_angles(roll, pitch, yaw)
    again = rotation_from_angles(*roll_pitch_yaw(rotation))
    np.testing.assert_allclose(again, rotation, rtol=0, atol=1e-7)
