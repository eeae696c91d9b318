"""Pinocchio, MuJoCo and Brax read one MJCF, others the URDF, and must see one robot."""

import warnings

import jax
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, WITH_TOOL, random_states

from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arms import ARMS, load_arm

SHIPPED = [load_arm(name) for name in ARMS]
STATES = 200
TOLERANCE = 1e-9


@pytest.mark.parametrize(
    ("arm", "inertia_set"), [*((arm, "nominal") for arm in SHIPPED), (ARM, "alternative"), (WITH_TOOL, "nominal")]
)
def test_pinocchio_agrees_with_mujoco(arm, inertia_set):
    ours, model = RobotModel(arm, inertia_set), mujoco.MjModel.from_xml_string(build_mjcf(arm, inertia_set))
    data, flange = mujoco.MjData(model), model.site("flange").id
    mass_matrix, jacobian = np.zeros((arm.n, arm.n)), np.zeros((6, arm.n))
    for q, v in zip(*random_states(STATES, arm=arm), strict=True):
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


def test_pinocchio_agrees_with_brax():
    from brax import kinematics, math
    from brax.generalized import dynamics, mass
    from brax.generalized.base import State
    from brax.io import mjcf

    def evaluate(q, v):
        links, velocities = kinematics.forward(system, q, v)
        state = dynamics.transform_com(system, State.init(q, v, links, velocities))
        last = links.take(-1)
        flange = last.pos + math.rotate(np.array(arm.tip_offset), last.rot)
        rotation = math.quat_to_3x3(last.rot)
        return mass.matrix(system, state), dynamics.inverse(system, state), flange, rotation

    # Its inertias have products.
    arm = load_arm("xarm7")
    positions, velocities = random_states(STATES, arm=arm)
    with jax.enable_x64(True), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Brax says on loading that it is no longer developed.
        system = mjcf.loads(build_mjcf(arm))
        # It runs once: compiling takes longer than running.
        compiled = jax.jit(jax.vmap(evaluate), compiler_options={"xla_backend_optimization_level": 0})
        results = [np.asarray(result) for result in compiled(positions, velocities)]
    model = RobotModel(arm)
    for index, (q, v) in enumerate(zip(positions, velocities, strict=True)):
        model.update(q, v)
        expected = (model.mass_matrix, model.bias, model.position, model.rotation)
        for result, value in zip(results, expected, strict=True):
            np.testing.assert_allclose(result[index], value, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(("arm", "inertia_set"), [(ARM, "nominal"), (ARM, "alternative"), (WITH_TOOL, "nominal")])
def test_urdf_and_table_agree_with_the_mjcf(arm, inertia_set):
    model = pin.buildModelFromXML(build_urdf(arm, inertia_set))
    model.armature[:] = arm.joints[0].armature  # URDF cannot say it.
    data = model.createData()
    frames = [model.getFrameId(name) for name in (*arm.link_names, arm.tip_frame)]
    from_mjcf = RobotModel(arm, inertia_set)
    for q, v in zip(*random_states(100), strict=True):
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
