"""What an arm's description says, lacks and leaves to rules: `contact-reach arm check`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.capsule_fit import POOR
from contact_reach_ros.arm.capsules import pair_distances, self_pairs, shape_name, shapes
from contact_reach_ros.arm.kinematics import TASK_ROWS
from contact_reach_ros.arm.mount import in_words
from contact_reach_ros.arm.table import table_of
from contact_reach_ros.arm.urdf_reader import Reading, read_arm_file
from contact_reach_ros.arms import ENDINGS, load_arm
from contact_reach_ros.resources import write_text


def check_arm(name: str, table: Path | None = None) -> None:
    """Print what there is, what was assumed, and what is hardly that of a real arm.

    Raises `SettingsError` if the description is refused, naming link or joint and the key that mends it, and
    `InputError` if the table cannot be written.

    Parameters
    ----------
    name
        What `load_arm` takes.
    table
        File to write the arm's table to; none is written by default.
    """
    console = Console(markup=False)
    is_file = name.lower().endswith(ENDINGS)
    arm, fits, assumed, doubts = read_arm_file(Path(name)) if is_file else Reading(load_arm(name), {}, [], [])
    console.print(
        f"arm '{arm.name}': {arm.n} joints from {arm.base_frame} to {arm.tip_frame}, reach {arm.reach:g} m around "
        f"{list(arm.shoulder)} m"
    )
    console.print(in_words(arm))
    console.print(f"task: {arm.task}, the most that its {arm.n} joints can hold ({TASK_ROWS[arm.task]} of 6 rows)")
    console.print(_joints(arm))
    capsules = Table("capsule on", "radius m", "length m", "volume / hull")
    for number, capsule in enumerate(shapes(arm)):
        link, length = shape_name(arm, number), float(np.linalg.norm(np.subtract(capsule.end, capsule.start)))
        fit = fits.get(link)
        judged = "given" if fit is None else f"{fit.volume_ratio:.2f}"
        capsules.add_row(link, f"{capsule.radius:.3f}", f"{length:.3f}", judged)
    console.print(capsules)
    for link in (link for link, fit in fits.items() if not fit.volume_ratio <= POOR):
        console.print(
            f"poor fit: the capsule on {link} has more than {POOR:g} times the volume of its shapes; give several "
            f"under capsules ({{{link}: [{{start: ..., end: ..., radius: ...}}, ...]}})",
        )
    if overlapping := self_pairs(arm, overlapping=True):
        depths = -1000.0 * pair_distances(arm, np.array([arm.home]), np.array(overlapping))[0]
        pairs = (
            f"{shape_name(arm, first)} and {shape_name(arm, second)} (by {depth:.0f} mm)"
            for (first, second), depth in zip(overlapping, depths, strict=True)
        )
        console.print(
            f"not kept apart, since their capsules overlap at home: {', '.join(pairs)}; give another home or tighter "
            "capsules",
        )
    for line in assumed:
        console.print(f"assumed: {line}")
    for line in doubts:
        console.print(f"doubtful: {line}", style="yellow")
    if table is not None:
        write_text(table, yaml.dump(table_of(arm), sort_keys=False, default_flow_style=None, width=100))
        console.print(f"table: {table}")


def _joints(arm: Arm) -> Table:
    rows = Table("joint", "from rad", "to rad", "home rad", "rad/s", "Nm", "stops at Nm", "kg")
    stops = arm.default("torque_thresholds")
    for joint, home, stop, inertia in zip(arm.joints, arm.home, stops, arm.inertias(), strict=True):
        numbers = (joint.lower, joint.upper, home, joint.velocity_limit, joint.torque_limit, stop, inertia.mass)
        rows.add_row(joint.name, *(f"{number:.3g}" for number in numbers))
    return rows
