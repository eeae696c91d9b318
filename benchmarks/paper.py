"""The figures of the paper, and what this project demands of itself: the one place where they are written down."""

from __future__ import annotations

from dataclasses import dataclass

METHOD = "contact_reach"
"""The paper's own method, by its name in `baselines.methods`."""
REFERENCE_POSTURE = "reference_posture"
COLLISION_FREE = "collision_free"
RRT_STAR = "rrt_star"
"""The paper's baseline: one run of plain RRT*, whose detours `collision_free` does not have."""
JOINT_TORQUE = "joint_torque"


@dataclass(frozen=True)
class PaperCell:
    """One cell of Table I: mean and standard deviation of the time, s, and of the maximum contact force, N."""

    time: float
    time_sd: float
    force: float
    force_sd: float


TABLE_1 = {
    ("free", RRT_STAR): PaperCell(11.4, 1.4, 0.0, 0.0),
    ("free", REFERENCE_POSTURE): PaperCell(11.4, 1.4, 0.0, 0.0),
    ("free", METHOD): PaperCell(11.4, 1.6, 0.0, 0.0),
    ("ball", RRT_STAR): PaperCell(37.8, 3.9, 0.0, 0.0),
    ("ball", REFERENCE_POSTURE): PaperCell(13.1, 0.4, 4.7, 2.3),
    ("ball", METHOD): PaperCell(12.8, 0.5, 2.8, 1.2),
    ("wall", REFERENCE_POSTURE): PaperCell(21.3, 2.0, 1.9, 0.7),
    ("wall", METHOD): PaperCell(17.5, 1.5, 0.5, 0.3),
}
"""Table I, simulation, by scene and method; with walls there is no collision-free path."""

NO_PATH = (("wall", RRT_STAR),)
"""Cells of Table I for which the paper reports that there is no path."""

WALL_PLANNING_TIME = {METHOD: 0.47, JOINT_TORQUE: 1.34}
"""Section V-B: mean time of a plan in the wall scene, s."""

SUCCESS = 0.9
"""Demanded here: share of the targets at which every episode settles, at least. A method that never fails shows it with
70 targets as one of 30 claims, and with 36 as the only one; fewer leave the lower end of the interval below."""

TIME_RATIO_LIMITS = {"free": 1.4, "ball": 1.6, "wall": 2.0}
"""Demanded here: time to settle over the kinematic limit, at most."""

TORQUE_SCENES = ("ball_mismatch", "wall_mismatch", "ball_misplaced", "wall_misplaced")
"""Demanded here: there, where the paper judges by external torque, the method's is below that of reference posture."""

FORCE_RATIOS = {"ball": 1.7, "wall": 4.0}
"""Section V-B: maximum contact force of reference posture over that of the method, at least."""

COLLISION_FREE_TIME_RATIO = {"ball": 2.6}
"""Section V-A: time of the collision-free path over that of the method, at least."""
