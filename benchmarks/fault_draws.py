"""Faults drawn at random, of each kind."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from benchmarks import faulty_robot as faults
from benchmarks.episode import Silent, WrongPlans
from benchmarks.faulty_robot import Fault
from contact_reach_ros.arm import Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import SceneError
from contact_reach_ros.scenes.placing import free_path
from contact_reach_ros.world.collision import capsule_segments, overlap_depths
from contact_reach_ros.world.scene import Scene

_LATEST = 2.0
"""Latest begin of a fault, s."""
_RADIUS = 0.05
"""Of an obstacle, m."""
_CLEARANCE = 0.02
"""Of an obstacle from the arm when it appears, m."""
_FAULTS = 1
"""Separates the random numbers of the faults from those of the scene."""

Random = np.random.Generator


def random_faults(scene: Scene, seed: int) -> tuple[Fault, ...]:
    """Draw one to three faults of different kinds."""
    random = np.random.default_rng((seed, _FAULTS))
    drawn = [draw(random, scene) for draw in random.choice(np.array(DRAWS), random.integers(1, 4), replace=False)]
    return tuple(_timed(random, fault) for fault in drawn)


def _timed(random: Random, fault: Fault) -> Fault:
    if isinstance(fault, faults.UnknownObstacle):
        # From the beginning: later it might appear inside the arm, as nothing real does.
        return fault
    duration = random.uniform(0.02, 0.5) if isinstance(fault, faults.Push) else _log(random, 0.005, 2.0)
    if not isinstance(fault, faults.Push) and random.random() < 0.5:
        duration = math.inf
    return dataclasses.replace(fault, at=round(random.uniform(0.0, _LATEST), 3), duration=round(duration, 3))


def _log(random: Random, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def _direction(random: Random) -> Array:
    drawn = random.standard_normal(3)
    return drawn / np.linalg.norm(drawn)


def _lost(random: Random, _: Scene) -> Fault:
    return faults.Lost(
        str(random.choice(["commands", "states", "efforts", "obstacles"])), share=random.uniform(0.1, 1.0)
    )


def _late(random: Random, _: Scene) -> Fault:
    what = str(random.choice(["commands", "states", "plans"]))
    if what == "plans":
        return WrongPlans(delay=_log(random, 0.02, 0.6))
    return faults.Late(what, _log(random, 0.001, 0.1))


def _not_finite(random: Random, scene: Scene) -> Fault:
    share, joint = random.uniform(0.01, 1.0), str(random.choice(scene.arm.joint_names))
    what = str(random.choice(["commands", "states"]))
    field = "effort" if what == "commands" else str(random.choice(["position", "velocity", "effort"]))
    return faults.NotFinite(what, field, joint, share=share)


def _stuck_encoder(random: Random, scene: Scene) -> Fault:
    return faults.StuckEncoder(str(random.choice(scene.arm.joint_names)), own_velocity=bool(random.random() < 0.5))


def _torque_sensor(random: Random, scene: Scene) -> Fault:
    joint, gain = str(random.choice(scene.arm.joint_names)), float(random.choice([-1, 0, 1]))
    return faults.TorqueSensor(joint, gain, random.uniform(-40.0, 40.0))


def _wrong_clock(random: Random, _: Scene) -> Fault:
    return faults.WrongClock(step=float(random.choice([-1, 0, 1])) * _log(random, 0.002, 20.0))


def _push(random: Random, scene: Scene) -> Fault:
    x, y, z = (random.uniform(5.0, 150.0) * _direction(random)).tolist()
    return faults.Push(str(random.choice(scene.arm.link_names[2:])), (x, y, z))


def _obstacle(random: Random, scene: Scene) -> Fault:
    """Draw a place on the way of the hand, but not in the arm where it starts."""
    model = RobotModel(scene.arm)
    try:
        path = free_path(model, scene.start, scene.target)
    except SceneError:
        return faults.Friction(2.0)
    starts, ends = capsule_segments(scene.arm, scene.start[None])
    for _ in range(50):
        place, _ = model.tip_pose(path[int(random.uniform(0.3, 1.0) * (len(path) - 1))])
        place = place + random.uniform(0.0, 0.08) * _direction(random)
        if overlap_depths(scene.arm, starts, ends, place[None], _RADIUS).max() < -_CLEARANCE:
            x, y, z = place.tolist()
            return faults.UnknownObstacle((x, y, z), _RADIUS, _log(random, 500.0, 20000.0))
    return faults.Friction(2.0)


def _wrong_plans(random: Random, _: Scene) -> Fault:
    x, y, z = random.uniform(-0.1, 0.1, 3).tolist()
    return WrongPlans((x, y, z), _log(random, 0.3, 30.0))


DRAWS: tuple[Callable[[Random, Scene], Fault], ...] = (
    *(_lost, _late, _not_finite, _stuck_encoder, _torque_sensor, _wrong_clock, _push, _obstacle, _wrong_plans),
    lambda random, _: faults.VelocityNoise(deviation=_log(random, 0.01, 2.0)),
    lambda random, _: faults.RivalCommands(random.uniform(-30.0, 30.0)),
    lambda random, _: faults.Payload(random.uniform(0.2, 10.0)),
    lambda random, _: faults.Friction(_log(random, 0.1, 20.0)),
    lambda random, _: Silent(str(random.choice(["driver", "controller", "observer", "planner"]))),
)
"""Draw the values of each kind of fault."""
