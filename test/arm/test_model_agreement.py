"""Pinocchio, MuJoCo and Brax read one MJCF, others the URDF, and must see one robot."""

import warnings

import jax
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, WITH_TOOL, random_states

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arms import ARMS, load_arm

SHIPPED = [load_arm(name) for name in ARMS]
STATES = 200
TOLERANCE = 1e-9


class MujocoModel:
    """The same quantities as `RobotModel`, from MuJoCo."""

    def __init__(self, arm: Arm, inertia_set: str) -> None:
        self.model = mujoco.MjModel.from_xml_string(build_mjcf(arm, inertia_set))
        self.data = mujoco.MjData(self.model)
        self.flange = self.model.site("flange").id

    def update(self, q: np.ndarray, v: np.ndarray) -> None:
        data = self.data
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(self.model, data)
        self.mass_matrix = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, data, self.mass_matrix)
        self.jacobian = np.zeros((6, self.model.nv))
        mujoco.mj_jacSite(self.model, data, self.jacobian[:3], self.jacobian[3:], self.flange)
        self.bias = data.qfrc_bias
        self.position = data.site_xpos[self.flange]
        self.rotation = data.site_xmat[self.flange].reshape(3, 3)


@pytest.mark.parametrize(
    ("arm", "inertia_set"), [*((arm, "nominal") for arm in SHIPPED), (ARM, "alternative"), (WITH_TOOL, "nominal")]
)
def test_pinocchio_agrees_with_mujoco(arm, inertia_set):
    pinocchio, other = RobotModel(arm, inertia_set), MujocoModel(arm, inertia_set)
    for q, v in zip(*random_states(STATES, arm=arm), strict=True):
        pinocchio.update(q, v)
        other.update(q, v)
        for name in ("mass_matrix", "bias", "jacobian", "position", "rotation"):
            np.testing.assert_allclose(
                getattr(pinocchio, name), getattr(other, name), rtol=0, atol=TOLERANCE, err_msg=name
            )


@pytest.mark.parametrize("arm", [ARM, load_arm("ur10")], ids=lambda arm: arm.name)
def test_pinocchio_agrees_with_brax(arm):
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
