"""A planning problem and its predicted outcome, as inputs and outputs of compiled programs."""

from __future__ import annotations

from typing import NamedTuple

import jax

from contact_reach_ros.planning.transfer.clearance import Bodies, Capsules
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.pipeline import Pose, Reference

Number = float | jax.Array


class Problem(NamedTuple):
    """One planning problem. All of it is input of the compiled programs: other numbers need no recompilation."""

    q: jax.Array
    """(n, 1) joint angles when the plan takes effect, rad."""
    v: jax.Array
    """(n, 1), rad/s."""
    obstacles: Obstacles | None
    """Obstacles with one lane, or None for a program without contact."""
    goal_position: jax.Array
    """(3, 1), m."""
    goal_rotation: jax.Array
    """(3, 3, 1); any rotation if the orientation is free, which makes the weight of the term `orientation` zero."""
    weights: dict[str, Number]
    """Weight of each term of the cost, by the term's name."""
    permitted_force: Number
    """ε of (4d), N."""
    joint_limit_margin: Number
    """Distance from a joint's limit at which its cost starts, rad."""
    clearance_margin: Number = 0.0
    """Distance of capsules from rigid bodies, and from the arm's other capsules, at which its cost starts, m."""
    bodies: Bodies | None = None
    """Rigid bodies; None for a program that knows the arm's own capsules only."""
    speed_scale: Number = 1.0
    """Share of γ that bounds the actions."""
    before: Reference | None = None
    """The reference in force when the plan takes effect, with one lane; None where the arm is held at `q`."""
    detour: jax.Array | None = None
    """(n, 1) posture of the detour, rad, which counts if the term `detour` has a weight."""


class Rollout(NamedTuple):
    """Motion that the transfer model predicts for some actions."""

    q: jax.Array
    """(H + 1, n, B) joint angles at the knot boundaries, rad."""
    pose: Pose
    """(H + 1, ...) flange at the knot boundaries."""
    reference: Reference
    """(H, ...) references that the actions stand for."""
    link_force: jax.Array
    """(H, L, B) largest force within each knot on each of the arm's `contact_links`, N."""
    contact: jax.Array
    """(H, B) contact(·) of (4d): largest value within each knot, N."""
    capsules: Capsules | None
    """(H, ...) capsules of the links at the ends of the knots; None if no term needs them."""
