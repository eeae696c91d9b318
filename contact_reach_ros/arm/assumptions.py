"""What an arm's description leaves open, by rules: shoulder, reach, home posture, and thresholds."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arm import Arm, Array, Vector3
from contact_reach_ros.arm.capsules import pair_distances, touching_pairs
from contact_reach_ros.arm.kinematics import link_frames, link_frames_of_many, task_jacobians, tip_positions
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.mount import standing, stands

REACH_SHARE = 0.9
"""Of the greatest distance of the tip from the shoulder, up to which goals are accepted."""
_POSTURES = 20000
_PROPORTIONAL = 6.0
"""Stopping thresholds, N m, below which the least values of the others are in proportion."""
_SLOW = 4.2
"""Acceleration of the arm at home, rad/s², that a stopping threshold has to be worth to stand out: velocities with a
noise of 1 mrad/s make one of 0.05 N m per kg m² in the observer's estimate, 7 times of which are a contact."""
_HOME_MARGIN = 0.35
"""Least distance of the home posture from joint limits, rad, unless their range is too small for it."""


def defaults(arm: Arm) -> dict[str, tuple[float, ...]]:
    """Settings with a value for each joint: thresholds in proportion to the torque limits, and q_d of law (6).

    A joint stops the arm at 14 % of its torque limit, but at 8 to 30 N m, or more where its inertia demands it, or at
    half the limit where that is less; the others are shares of this one. Those of the iiwa 14, which were chosen by
    measurement, are met within 1.5 N m. Small joints, such as those of servos, have all of them in proportion.
    """
    limits = arm.torque_limits
    most = np.maximum(30.0, _SLOW * inertias_at_home(arm))
    stop = np.minimum(np.clip(0.14 * limits, 8.0, most), 0.5 * limits)
    small = np.minimum(stop / _PROPORTIONAL, 1.0)
    shares = {
        "torque_thresholds": stop,
        "torque_per_speed": np.maximum(stop / 15.0, small),
        "sudden_thresholds": 0.4 * stop,
        "contact_thresholds": np.maximum(stop / 12.0, 1.4 * small),
        "contact_per_speed": np.maximum(stop / 30.0, 0.5 * small),
        "handover_thresholds": np.maximum(0.25 * stop, 3.0 * small),
        # Zeros, as far as they are well within the limits.
        "reference_posture": np.clip(0.0, arm.lower + _HOME_MARGIN, arm.upper - _HOME_MARGIN),
    }
    return {name: tuple(round(float(value), 3) for value in values) for name, values in shares.items()}


def inertias_at_home(arm: Arm) -> Array:
    """How much momentum a speed of each joint, whatever the others' signs, gives it at home: norms of M's rows (n,)."""
    model = RobotModel(arm)
    model.update_dynamics(np.array(arm.home))
    return np.linalg.norm(model.mass_matrix, axis=1)


def shoulder(arm: Arm) -> Vector3:
    """The point of the first joint's axis that is nearest to the second joint's frame, m, base frame."""
    rotations, origins = link_frames(arm, np.zeros(arm.n))
    axis = rotations[0][:, 2]
    x, y, z = (origins[0] + axis * (axis @ (origins[min(1, arm.n - 1)] - origins[0]))).tolist()
    return round(x, 4), round(y, 4), round(z, 4)


def reach(arm: Arm) -> float:
    """A share of the greatest distance of the tip from the shoulder among random postures, m."""
    random = np.random.default_rng(0)
    best = random.uniform(arm.lower, arm.upper, (_POSTURES, arm.n))
    width = arm.upper - arm.lower
    for share in (0.1, 0.03):
        far = np.linalg.norm(tip_positions(arm, best) - np.array(arm.shoulder), axis=1).argsort()[-50:]
        moved = best[far][:, None] + share * width * random.uniform(-1.0, 1.0, (50, 200, arm.n))
        best = np.concatenate([best[far], np.clip(moved, arm.lower, arm.upper).reshape(-1, arm.n)])
    distances = np.linalg.norm(tip_positions(arm, best) - np.array(arm.shoulder), axis=1)
    return round(REACH_SHARE * float(distances.max()), 3)


def home(arm: Arm) -> tuple[float, ...]:
    """A posture far from singularities, tip in front, last joint's axis down, all links above the base, elbow up.

    Up and front are those of the arm's scene frame, which the links of an arm that hangs or reaches out of a wall are
    above, too. Each of these counts, none is required; first of all, as few capsules as possible overlap.
    """
    margin = np.minimum(_HOME_MARGIN, 0.2 * (arm.upper - arm.lower))
    middle = 0.5 * (arm.lower + arm.upper)
    lower, upper = np.maximum(arm.lower + margin, middle - np.pi), np.minimum(arm.upper - margin, middle + np.pi)
    q = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, arm.n))
    mount, arm = arm, standing(arm)
    axes, origins = link_frames_of_many(arm, q)
    tip, out = origins[-1].T, (origins[-1].T - np.array(arm.shoulder)) / arm.reach
    ahead = np.hypot(tip[:, 0], tip[:, 1]) / arm.reach
    wrong = 2.0 * np.abs(np.arctan2(tip[:, 1], tip[:, 0])) + 2.0 * np.abs(ahead - 0.65) + 2.0 * np.abs(out[:, 2])
    down = -axes[-2, 2, 2] if arm.tip_offset[2] >= 0.0 else axes[-2, 2, 2]
    wrong += np.arccos(np.clip(down, -1.0, 1.0)) + 0.5 * np.abs(q - middle).mean(axis=1)
    wrong -= 2.0 * np.minimum(origins[1:-1, 2].mean(axis=0) / arm.reach, 0.5)
    lowest = origins[1:, 2].min(axis=0)
    if not stands(mount):
        lowest = np.minimum(lowest, link_frames_of_many(mount, q)[1][1:, 2].min(axis=0))
    wrong += 10.0 * np.maximum(0.15 - lowest / arm.reach, 0.0)
    few = wrong.argsort()[: _POSTURES // 200]
    jacobians = task_jacobians(axes[..., few], origins[..., few] / arm.reach, arm.task)
    mobility = np.linalg.svd(jacobians, compute_uv=False)[:, -1]
    postures = np.round(q[few], 3)
    overlaps = (pair_distances(arm, postures, touching_pairs(arm)) <= 0.0).sum(axis=1)
    # Out of a wall, in front and at the height of the shoulder is on the first axis.
    singular = mobility < 0.5 * mobility[overlaps == overlaps.min()].max()
    return tuple(postures[np.lexsort([0.3 * wrong[few] - mobility, singular, overlaps])[0]].tolist())
