"""What the other projects' planners are given, and what is made of their episodes."""

import mujoco
import numpy as np
import pytest

from benchmarks.peers import PLANNERS, bench_peers, make_environment, peers_table
from benchmarks.peers_model import episode_settings, planning_mjcf, servo_gains
from contact_reach_ros import load_scene
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.simulation.plant import Actuation, Plant
from contact_reach_ros.world.spheres import rest_positions


def model_of(scene) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(planning_mjcf(scene))
    data = mujoco.MjData(model)
    data.qpos[: scene.arm.n] = data.ctrl[:] = scene.start
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("name", ["ball", "wall"])
def test_the_model_has_the_scene(name):
    scene = load_scene(name, seed=20)
    model, data = model_of(scene)
    spheres = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
    soft = [geom for geom in spheres if model.geom(geom).name.startswith(name)]
    assert data.geom_xpos[soft] == pytest.approx(rest_positions(scene))
    assert set(model.geom_size[soft, 0]) == {obstacle.radius for obstacle in scene.obstacles}
    assert data.sensor("tip").data == pytest.approx(Plant(scene).tip_position)
    settings = episode_settings(scene, PlanningSettings(), 10.0)
    assert settings["target"] == scene.target.tolist()
    assert settings["coordinates"] == (model.nq, model.nv)
    # The fixed nodes of the walls are softened, a movable ball needs none of it.
    assert len(settings["inverse_weights"]) == (2 if name == "wall" else 0)


def test_servos_hold_the_arm_without_gravity_and_follow_their_references():
    scene = load_scene("ball", seed=20)
    model, data = model_of(scene)
    data.ctrl[:] = scene.start + 0.05
    start = scene.start[0]
    stiffness, damping = servo_gains(scene.arm)
    # Slower than the inertia, they approach as an overdamped spring does, at the ratio of the gains.
    mujoco.mj_step(model, data, round(damping[0] / stiffness[0] / model.opt.timestep))
    assert 0.4 < (data.qpos[0] - start) / 0.05 < 0.75
    mujoco.mj_step(model, data, 100)
    assert data.qpos[: scene.arm.n] == pytest.approx(scene.start + 0.05, abs=1e-3)


def test_sensors_show_the_contact_forces_of_the_simulation():
    scene = load_scene("ball", seed=20)
    model, data = model_of(scene)
    plant = Plant(scene, friction=(0.0, 0.0))
    plant.set_actuation(Actuation.COMMANDED)
    link, ball = data.body("lbr_link_5").xpos, rest_positions(scene)[0]
    data.qpos[7:] = plant.data.qpos[7:] = link - ball + 0.12 * (ball - link) / np.linalg.norm(ball - link)
    mujoco.mj_forward(model, data)
    plant.data.ctrl[:] = plant.data.qfrc_bias[:7]
    mujoco.mj_forward(plant.model, plant.data)
    forces = [np.linalg.norm(data.sensor(f"force_{link}").data) for link in scene.arm.contact_links]
    assert max(forces) > 1.0
    assert forces == pytest.approx(plant.contact_forces(), rel=0.02, abs=0.01)


def record(method: str, target: int, time: float | None, force: float) -> dict:
    found = {"scene": "ball", "method": method, "target": target, "time": time, "entry_time": 1.0}
    return {**found, "peak_force": force, "top_speed": 0.1 + 0.01 * target, "plan_cpu_s": 0.02}


def test_the_table_compares_the_targets_that_all_planners_have_had():
    records = [record(name, target, 4.0 + target, 2.0) for name in PLANNERS for target in range(2)]
    records[1]["time"] = None
    lines = peers_table([*records, record("judo", 2, 100.0, 100.0)]).splitlines()
    assert lines[2].startswith("| ball | **contact_reach** | 20 | 50 | 2/2 | 1/2 | – | 2.00 [2.00, 2.00] | 0.11 |")
    assert lines[3].startswith("| ball | judo: CEM | 20 | 50 | 2/2 | 2/2 | 4.50 [4.00, 5.00] |")
    assert len(lines) == 2 + len(PLANNERS)


@pytest.mark.slow
def test_packages_that_cannot_be_installed_are_named_and_tried_again(tmp_path, monkeypatch):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    for _ in range(2):
        with pytest.raises(SettingsError, match=r"no-such-package==1 could not be installed.*try again"):
            make_environment(tmp_path / "env", ["no-such-package==1"])
    (tmp_path / "env" / ".installed").touch()
    assert make_environment(tmp_path / "env", ["no-such-package==1"]).exists()


def test_other_scenes_are_refused(tmp_path):
    with pytest.raises(SettingsError, match="--scenes slalom: expected some of ball, wall"):
        bench_peers(tmp_path / "peers.jsonl", scenes=("slalom",))
