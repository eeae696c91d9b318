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

SPEED = 0.11
"""Tip speed beyond which a plan costs more, m/s: what γ lets this package's arm reach."""
SERVO_SHARE = 3.0
"""Stiffness of the servos over the torque limits, 1/rad: about that of law (1) at an outstretched tip."""
STEP = 0.02
"""Of the rollouts, s."""
FOAM_STIFFNESS = 100.0
"""Of a wall's node, surface and springs in series, N/m."""
SEARCH = {
    # rad: the references' greatest distance from the joints, and standard deviations of candidates.
    "lead": 0.05,
    "sampling_sigma": 0.006,
    "cem_sigma": (0.01, 0.05),
    "elites": 10,
    # s/m: tip speed above `SPEED`, and any, so that the arm comes to rest.
    "speed_weight": 0.5,
    "rest_weight": 0.05,
    # 1/N: a tenth of this package's, which fades where contact keeps the arm from its goal, as theirs does not.
    "contact_weight": 0.001,
}
"""What this benchmark chose for the other planners, on targets 100 to 102 of both scenes."""


def servo_gains(arm: Arm) -> tuple[Array, Array]:
    """Stiffness (n,), Nm/rad, and damping (n,), Nm s/rad, of position servos, in the ratio of law (1)."""
    gains = ImpedanceSettings()
    stiffness = SERVO_SHARE * arm.torque_limits
    return stiffness, stiffness * gains.task_damping / gains.task_stiffness


def planning_mjcf(scene: Scene) -> str:
    """MJCF of the scene without gravity, which the servos compensate, with the sensors of `force_sensors` and the tip.

    The nodes of walls, 264 coordinates, are fixed and as soft as surface and springs together.
    """
    arm, bodies = scene.arm, []
    for index, obstacle in enumerate(scene.obstacles):
        bodies += _held_wall(obstacle, index) if obstacle.is_deformable else obstacle_bodies(obstacle, index, 1.0)
    contacts = self_contacts(arm)
    root = ElementTree.fromstring(
        build_mjcf(arm, obstacles=[*bodies, *rigid_geoms(scene.environment)], contacts=contacts)
    )
    option = root.find("option")
    assert option is not None
    option.attrib.update(timestep=repr(STEP), integrator="implicitfast", cone="elliptic", gravity="0 0 0")
    for motor, joint, kp, kv in zip(root.iter("motor"), arm.joints, *servo_gains(arm), strict=True):
        limit = numbers((-joint.torque_limit, joint.torque_limit))
        motor.tag = "position"
        motor.attrib.update(
            kp=repr(float(kp)), kv=repr(float(kv)), ctrlrange=numbers((joint.lower, joint.upper)), forcerange=limit
        )
    sensors = SubElement(root, "sensor")
    SubElement(sensors, "framepos", name="tip", objtype="site", objname=TIP_SITE)
    SubElement(sensors, "framelinvel", name="tip_velocity", objtype="site", objname=TIP_SITE)
    for name, link in zip(force_sensors(arm), arm.contact_links, strict=True):
        SubElement(sensors, "contact", name=name, body1=link, data="force", reduce="netforce", num="1")
    return ElementTree.tostring(root, encoding="unicode")


def force_sensors(arm: Arm) -> list[str]:
    """Names of the sensors of the contact force on each of the arm's contact links."""
    return [f"force_{link}" for link in arm.contact_links]


def _held_wall(wall: Obstacle, index: int) -> list[Element]:
    material = dataclasses.replace(wall.material, contact_stiffness=FOAM_STIFFNESS)
    held = dataclasses.replace(wall, material=material, fixed=np.ones(len(wall.fixed), bool))
    # One body: MuJoCo then looks for contacts in a tree of its spheres.
    body = Element("body", name=f"{wall.kind}_{index}")
    for sphere in obstacle_bodies(held, index, 1.0):
        geom = sphere[0]
        geom.set("pos", sphere.attrib["pos"])
        body.append(geom)
    return [body]


def episode_settings(scene: Scene, planning: PlanningSettings, permitted_force: float) -> dict[str, Any]:
    """All that a planner needs for an episode, as JSON has it."""
    mjcf = planning_mjcf(scene)
    model = mujoco.MjModel.from_xml_string(mjcf)
    hard = model.body_invweight0[:, 0].copy()
    soften_fixed(model)
    return {
        "mjcf": mjcf,
        "coordinates": (model.nq, model.nv),
        "inverse_weights": {
            model.body(body).name: float(model.body_invweight0[body, 0])
            for body in np.flatnonzero(model.body_invweight0[:, 0] != hard)
        },
        "start": scene.start.tolist(),
        "target": scene.target.tolist(),
        "seed": scene.seed,
        "force_sensors": force_sensors(scene.arm),
        "candidates": planning.population,
        "horizon": planning.horizon * planning.knot_duration,
        "knots": planning.horizon + 1,
        "permitted_force": permitted_force,
        "speed": SPEED,
        "goal_weight": planning.goal_weight,
        "contact_limit_weight": planning.contact_limit_weight,
        **SEARCH,
    }
