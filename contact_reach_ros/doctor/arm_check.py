"""What an arm's description says, lacks and leaves to rules, and whether the arm moves: `contact-reach arm check`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.capsules import shape_name, shapes
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.table import table_text
from contact_reach_ros.arm.urdf_reader import read_arm_file
from contact_reach_ros.arms import ENDINGS, load_arm
from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.references import References
from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.doctor.findings import write_text
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.timing import NANOSECONDS, PERIOD
from contact_reach_ros.world.scene import Scene

_SETTLING, _MOTION = 0.8, 2.0
"""Hand-over and start, and the motion, s."""
_AMPLITUDE = 0.03
"""Of the tip along each axis of the base frame, m."""
_KNOT_NS = 20_000_000
_CLOSE = 0.01
"""Distance from where it began at which the tip counts as back, m."""


def check_arm(name: str, table: Path | None = None) -> int:
    """Print what there is, what was assumed, and how the arm moves; returns 0 only if it moves as it should.

    Raises `SettingsError` if the description is refused, naming link or joint and the key that mends it, and
    `InputError` if the table cannot be written.

    Parameters
    ----------
    name
        What `load_arm` takes.
    table
        File to write the arm's table to; none is written by default.
    """
    console = Console()
    if name.endswith(ENDINGS):
        arm, fits, assumed = read_arm_file(Path(name))
    else:
        arm, fits, assumed = load_arm(name), {}, []
    console.print(
        f"arm '{arm.name}': {arm.n} joints from {arm.base_frame} to {arm.tip_frame}, reach {arm.reach:g} m around "
        f"{list(arm.shoulder)} m"
    )
    console.print(_joints(arm))
    capsules = Table("capsule on", "radius m", "length m", "volume / hull")
    for number, capsule in enumerate(shapes(arm)):
        link, length = shape_name(arm, number), float(np.linalg.norm(np.subtract(capsule.end, capsule.start)))
        fit = fits.get(link)
        judged = "given" if fit is None else f"{fit.volume_ratio:.2f}"
        capsules.add_row(link, f"{capsule.radius:.3f}", f"{length:.3f}", judged)
    console.print(capsules)
    for line in assumed:
        console.print(f"assumed: {line}", markup=False)
    if table is not None:
        write_text(table, table_text(arm))
        console.print(f"table: {table}", markup=False)
    problem = _motion(arm)
    console.print(
        problem or f"moved by {1000 * _AMPLITUDE:.0f} mm and back in {_MOTION:g} s of simulation", markup=False
    )
    return 1 if problem else 0


def _joints(arm: Arm) -> Table:
    rows = Table("joint", "from rad", "to rad", "home rad", "rad/s", "Nm", "stops at Nm", "kg")
    stops = arm.default("torque_thresholds")
    for joint, home, stop, inertia in zip(arm.joints, arm.home, stops, arm.inertias(), strict=True):
        numbers = (joint.lower, joint.upper, home, joint.velocity_limit, joint.torque_limit, stop, inertia.mass)
        rows.add_row(joint.name, *(f"{number:.3g}" for number in numbers))
    return rows


def _motion(arm: Arm) -> str:
    """Move the tip of the simulated arm along a line and back; why it did not get there, or empty."""
    robot = SimulatedRobot(Scene("check", arm, 0, np.array(arm.home), np.full(3, np.nan)))
    unwatched = SupervisionSettings(require_observer=False)
    controller = Controller(arm, ControllerSettings(supervision=unwatched), PERIOD)
    rotations, origins = link_frames(arm, arm.home)
    period_ns, due_ns = round(PERIOD * NANOSECONDS), 0
    farthest, error = 0.0, np.inf
    for step in range(round((_SETTLING + _MOTION + _SETTLING) / PERIOD)):
        clock_ns = step * period_ns
        for state in robot.read():
            torque = controller.update(state, clock_ns)
            if torque is not None:
                robot.command(torque, clock_ns)
            share = np.clip((state.stamp_ns / NANOSECONDS - _SETTLING) / _MOTION, 0.0, 1.0)
            offset = _AMPLITUDE * np.sin(np.pi * share) ** 2
            moved = np.linalg.norm(link_frames(arm, state.q)[1][-1] - origins[-1])
            farthest, error = max(farthest, float(moved)), float(moved)
            if share > 0.0 and state.stamp_ns >= due_ns:
                due_ns = state.stamp_ns + _KNOT_NS
                pose = (origins[-1] - offset)[None], rotations[-1][None]
                controller.follow(References(state.stamp_ns, (5 * _KNOT_NS,), *pose, np.array([arm.home])))
        robot.step(clock_ns)
        if controller.stop_reason or robot.stop_reason:
            return f"the simulated arm was stopped: {controller.stop_reason or robot.stop_reason}"
    if farthest < 0.5 * _AMPLITUDE or error > _CLOSE:
        return f"the simulated arm moved by {1000 * farthest:.0f} mm and ended {1000 * error:.0f} mm from its start"
    return ""
