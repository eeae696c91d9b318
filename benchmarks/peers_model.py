"""A scene as the other projects' planners get it: MJCF with position servos, and the settings of their search."""

from __future__ import annotations

import dataclasses
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.mjcf import TIP_SITE, build_mjcf, numbers
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.simulation.obstacles import obstacle_bodies, rigid_geoms, self_contacts, soften_fixed
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.scene import Scene

SERVO_SHARE = 3.0
"""Stiffness of the servos over the torque limits, 1/rad: about that of law (1) at an outstretched tip."""
STEP = "0.02"
"""Of the rollouts, s."""
FOAM_STIFFNESS = 100.0
"""Of a wall's node, surface and springs in series, N/m: `benchmarks.foam` finds 77 to 155."""
SEARCH = {
    # m/s: tip speed above which plans cost more; what γ lets this package's arm reach.
    "speed": 0.11,
    # rad: the references' greatest distance from the joints, and standard deviations of candidates.
    "lead": 0.05,
    "sampling_sigma": 0.006,
    "cem_sigma": (0.01, 0.05),
    "elites": 10,
    # s/m: tip speed above that, and any, so that the arm comes to rest.
    "speed_weight": 0.5,
    "rest_weight": 0.05,
    # 1/N: a tenth of this package's, which fades where contact keeps the arm from its goal, as theirs does not.
    "contact_weight": 0.001,
}
"""What this benchmark chose for the other planners, on targets 100 to 102 of the ball and 100 of the wall."""


def servo_gains(arm: Arm) -> tuple[Array, Array]:
    """Stiffness (n,), Nm/rad, and damping (n,), Nm s/rad, of position servos, in the ratio of law (1)."""
    gains, stiffness = ImpedanceSettings(), SERVO_SHARE * arm.torque_limits
    return stiffness, stiffness * gains.task_damping / gains.task_stiffness


def planning_mjcf(scene: Scene) -> str:
    """MJCF of the scene with sensors of the tip and of the contact force on each link.

    It has no gravity, which the servos compensate, and no joint friction, which no planner knows. The nodes of walls,
    264 coordinates, are fixed and as soft as surface and springs together.
    """
    arm, bodies = scene.arm, rigid_geoms(scene.environment)
    for index, obstacle in enumerate(scene.obstacles):
        bodies += [_held(obstacle, index)] if obstacle.is_deformable else obstacle_bodies(obstacle, index, 1.0)
    root = ElementTree.fromstring(build_mjcf(arm, obstacles=bodies, contacts=self_contacts(arm)))
    for option in root.iter("option"):
        option.attrib.update(timestep=STEP, integrator="implicitfast", cone="elliptic", gravity="0 0 0")
    for motor, joint, kp, kv in zip(root.iter("motor"), arm.joints, *servo_gains(arm), strict=True):
        motor.tag = "position"
        motor.attrib.update(kp=repr(float(kp)), kv=repr(float(kv)), forcerange=motor.attrib["ctrlrange"])
        motor.set("ctrlrange", numbers((joint.lower, joint.upper)))
    sensors = SubElement(root, "sensor")
    SubElement(sensors, "framepos", name="tip", objtype="site", objname=TIP_SITE)
    SubElement(sensors, "framelinvel", name="tip_velocity", objtype="site", objname=TIP_SITE)
    for link in arm.contact_links:
        SubElement(sensors, "contact", name=f"force_{link}", body1=link, data="force", reduce="netforce", num="1")
    return ElementTree.tostring(root, encoding="unicode")


def _held(wall: Obstacle, index: int) -> Element:
    """All nodes in one body, so that MuJoCo looks for contacts in a tree of them."""
    material = dataclasses.replace(wall.material, contact_stiffness=FOAM_STIFFNESS)
    held = dataclasses.replace(wall, material=material, fixed=np.ones(len(wall.fixed), bool))
    body = Element("body", name=f"{wall.kind}_{index}")
    for node in obstacle_bodies(held, index, 1.0):
        node[0].set("pos", node.attrib["pos"])
        body.append(node[0])
    return body


def episode_settings(scene: Scene, planning: PlanningSettings, permitted_force: float) -> dict[str, Any]:
    """All that a planner needs for an episode, as JSON has it."""
    mjcf = planning_mjcf(scene)
    model = mujoco.MjModel.from_xml_string(mjcf)
    before = model.body_invweight0[:, 0].copy()
    soften_fixed(model)
    after = model.body_invweight0[:, 0]
    return {
        "mjcf": mjcf,
        "coordinates": (model.nq, model.nv),
        "inverse_weights": {model.body(body).name: float(after[body]) for body in np.flatnonzero(after != before)},
        "start": scene.start.tolist(),
        "target": scene.target.tolist(),
        "seed": scene.seed,
        "force_sensors": [f"force_{link}" for link in scene.arm.contact_links],
        "candidates": planning.population,
        "horizon": planning.horizon * planning.knot_duration,
        "knots": planning.horizon + 1,
        "permitted_force": permitted_force,
        "goal_weight": planning.goal_weight,
        "contact_limit_weight": planning.contact_limit_weight,
        **SEARCH,
    }
