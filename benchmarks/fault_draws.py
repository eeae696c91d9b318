"""Faults drawn at random, from each of their kinds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arrays import Array
from contact_reach_ros.simulation.fault_kinds import Schedule
from contact_reach_ros.simulation.fault_schedules import parse_faults
from contact_reach_ros.world.free_path import free_path
from contact_reach_ros.world.overlap import overlap_depths, path_segments
from contact_reach_ros.world.scene import Scene

_LATEST = 2.0
"""Latest begin of a fault, s."""
_RADIUS = 0.05
"""Of an obstacle, m."""
_CLEARANCE = 0.02
"""Of an obstacle from the arm when it appears, m."""
_FAULTS = 1
"""Separates the random numbers of the faults from those of the scene."""

Law = Callable[[np.random.Generator, Arm], Any]
"""Draws the value of a key."""
Draw = Callable[[np.random.Generator, Scene, Arm], str]
"""Draws a fault, as text."""


def _uniform(low: float, high: float) -> Law:
    return lambda random, _: float(random.uniform(low, high))


def _log(low: float, high: float) -> Law:
    return lambda random, _: float(np.exp(random.uniform(np.log(low), np.log(high))))


def _one_of(*values: Any) -> Law:
    return lambda random, _: random.choice(values)


def _joint(random: np.random.Generator, arm: Arm) -> str:
    return str(random.choice(arm.joint_names))


def _step(random: np.random.Generator, arm: Arm) -> float:
    return float(random.choice([-1, 1]) * _log(0.002, 20.0)(random, arm))


def _fault(text: str, *laws: Law) -> Draw:
    """A fault with values drawn for the fields of its text."""
    return lambda random, _, arm: text.format(*[law(random, arm) for law in laws])


def _direction(random: np.random.Generator) -> Array:
    drawn = random.standard_normal(3)
    return drawn / np.linalg.norm(drawn)


def _push(random: np.random.Generator, _: Scene, arm: Arm) -> str:
    x, y, z = random.uniform(5.0, 150.0) * _direction(random)
    link = random.choice(arm.link_names[2:])
    return f'push link={link} force="{x:.1f} {y:.1f} {z:.1f}" for={random.uniform(0.02, 0.5):.3f}'


def _obstacle(random: np.random.Generator, scene: Scene, arm: Arm) -> str:
    """Draw a place on the way of the hand, but not in the arm where it starts."""
    model = RobotModel(arm)
    path = free_path(model, scene.start, scene.target)
    starts, ends = path_segments(scene.arm, scene.start[None])
    if path is not None:
        for _ in range(50):
            place, _ = model.tip_pose(path[int(random.uniform(0.3, 1.0) * (len(path) - 1))])
            place = place + random.uniform(0.0, 0.08) * _direction(random)
            if overlap_depths(scene.arm, starts, ends, place[None], _RADIUS).max() < -_CLEARANCE:
                position = " ".join(f"{value:.3f}" for value in place)
                stiffness = _log(500, 20000)(random, arm)
                # From the beginning: later it might appear inside the arm, as nothing real does.
                return f'obstacle position="{position}" radius={_RADIUS} stiffness={stiffness:.0f} at=0'
    return "friction factor=2"


DRAWS: dict[str, Draw] = {
    "pause": lambda random, scene, arm: f"pause for={_log(0.02, 3.0)(random, arm):.3f}",
    "foreign_commands": _fault("foreign_commands torque={:.1f}", _uniform(-30, 30)),
    "foreign_states": _fault("foreign_states offset={:.3f}", _uniform(-1.0, 1.0)),
    "no_effort": _fault("no_effort share={:.2f}", _uniform(0.01, 1.0)),
    "frozen_clock": _fault("frozen_clock"),
    "false_plans": _fault(
        'false_plans offset="{:.3f} {:.3f} {:.3f}" stretch={:.2f}', *3 * [_uniform(-0.1, 0.1)], _log(0.3, 30.0)
    ),
    "other_gains": _fault("other_gains"),
    "drop_commands": _fault("drop_commands share={:.2f}", _uniform(0.1, 1.0)),
    "delay_commands": _fault("delay_commands delay={:.4f}", _log(0.001, 0.1)),
    "duplicate_commands": _fault("duplicate_commands after={:.3f}", _uniform(0.0, 0.1)),
    "nan_commands": _fault("nan_commands share={:.2f}", _uniform(0.01, 1.0)),
    "drop_states": _fault("drop_states share={:.2f}", _uniform(0.1, 1.0)),
    "delay_states": _fault("delay_states delay={:.4f}", _log(0.001, 0.1)),
    "duplicate_states": _fault("duplicate_states after={:.3f}", _uniform(0.0, 0.05)),
    "nan_states": _fault(
        "nan_states share={:.2f} field={} joint={}",
        _uniform(0.01, 1.0),
        _one_of("position", "velocity", "effort"),
        _joint,
    ),
    "velocity_noise": _fault("velocity_noise deviation={:.3f}", _log(0.01, 2.0)),
    "stuck_encoder": _fault("stuck_encoder joint={} velocity={}", _joint, _one_of("zero", "true")),
    "torque_sensor": _fault("torque_sensor joint={} gain={} bias={:.1f}", _joint, _one_of(-1, 0, 1), _uniform(-40, 40)),
    "payload": _fault("payload mass={:.2f}", _uniform(0.2, 10.0)),
    "friction": _fault("friction factor={:.2f}", _log(0.1, 20.0)),
    "foam": _fault("foam factor={:.2f}", _log(0.3, 5.0)),
    "obstacle": _obstacle,
    "push": _push,
    "clock_jump": _fault("clock_jump step={:.3f}", _step),
    "planner_silent": _fault("planner_silent"),
    "observer_silent": _fault("observer_silent"),
    "controller_silent": _fault("controller_silent"),
    "late_plans": _fault("late_plans delay={:.3f}", _uniform(0.02, 0.6)),
    "drop_obstacles": _fault("drop_obstacles share={:.2f}", _uniform(0.1, 1.0)),
}
"""How the keys of each kind are drawn, except when it begins and how long it lasts."""


def random_schedule(scene: Scene, seed: int, arm: Arm) -> Schedule:
    """Draw one to three different faults."""
    random = np.random.default_rng((seed, _FAULTS))
    kinds = random.choice(list(DRAWS), size=random.integers(1, 4), replace=False)
    parts = []
    for kind in kinds:
        text = DRAWS[str(kind)](random, scene, arm)
        if " at=" not in text:
            text += f" at={random.uniform(0.0, _LATEST):.3f}"
        if " for=" not in text and random.random() < 0.5:
            text += f" for={_log(0.005, 2.0)(random, arm):.3f}"
        parts.append(text)
    return parse_faults("; ".join(parts), arm)
