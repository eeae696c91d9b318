"""The closed loop of arm, law (3) and soft contact: `init` makes a state of a system, `step` advances it.

The action of a step is the reference of the control law, and one call advances all candidates. Brax's generalized
pipeline takes 40 to 160 times as long for the same motion on a CPU. `planning.brax_env` offers this one on Brax's
own types.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from contact_reach_ros.control.settings import AXIS, ImpedanceSettings
from contact_reach_ros.planning.transfer.closed_loop import N_TASK, Reference, joint_acceleration
from contact_reach_ros.planning.transfer.contact import Obstacles, contact_step
from contact_reach_ros.planning.transfer.dynamics import arm_dynamics, flange_drift, link_frames
from contact_reach_ros.planning.transfer.lanes import dot, make_keep, rotate
from contact_reach_ros.planning.transfer.model import ArmModel

MAX_JOINT_SPEED = 10.0
"""Joint speeds are cut off here, rad/s, four times the limit of the fastest joint.

At a singularity the laws ask for joint speeds that 25 ms steps cannot follow. With the cut-off such rollouts stay
finite, and the cost of joint speeds keeps plans away from them.
"""


@dataclass(frozen=True, eq=False)
class System:
    """The constants of the closed loop."""

    arm: ArmModel
    gains: ImpedanceSettings
    contact_stiffness: float
    """N/m."""
    timestep: float | jax.Array
    """s."""

    @property
    def action_size(self) -> int:
        """Size of one knot's action: Δx (translation, rotation) and Δq."""
        return N_TASK + self.arm.n


class State(NamedTuple):
    """Positions and velocities, and the contact of the last step."""

    q: jax.Array
    """(n, B), rad."""
    qd: jax.Array
    """(n, B), rad/s."""
    obstacles: Obstacles | None
    """None in free space, where no contact is computed."""
    link_force: jax.Array
    """(L, B) contact force on each of the arm's `contact_links` in the last step, N."""


def init(sys: System, q: jax.Array, qd: jax.Array, obstacles: Obstacles | None = None) -> State:
    """State of the arm at joint angles `q` (n, B), rad, and speeds `qd` (n, B), rad/s."""
    return State(q, qd, obstacles, jnp.zeros((len(sys.arm.contact_links), q.shape[1]), q.dtype))


class Pose(NamedTuple):
    """Flange pose in the base frame."""

    position: jax.Array
    """(3, B), m."""
    rotation: jax.Array
    """(3, 3, B), indexed [row, column]."""


def tip_pose(sys: System, q: jax.Array) -> Pose:
    """Flange pose at joint angles `q` (n, B)."""
    frames = link_frames(sys.arm, q, make_keep(q))
    return Pose(frames.flange, frames.flange_rotation)


def latch(sys: System, q: jax.Array, pose: Pose, action: jax.Array) -> Reference:
    """The reference that an action {Δx, Δq} (6 + n, B) stands for when it takes effect at `q` (n, B): x_d = x ⊕ Δx.

    `pose` is the flange's at `q`. Δx is a translation in m and a rotation vector in rad in base axes, Δq is in rad.
    Where law (1) controls the direction of the flange's z axis only, the rotation vector is in the flange's axes, and
    its last component stays zero.
    """
    turn = action[3:N_TASK]
    if sys.gains.task == AXIS:
        turn = jnp.stack([dot(row, turn) for row in pose.rotation])
    return Reference(
        position=pose.position + action[:3],
        rotation=rotate(turn, pose.rotation),
        posture=q + action[N_TASK:],
    )


def step(sys: System, state: State, act: Reference) -> State:
    """Advance by one time step under the reference `act`: half a drift, a kick, half a drift."""
    timestep = sys.timestep
    keep = make_keep(state.q)
    q = state.q + (0.5 * timestep) * state.qd
    frames = link_frames(sys.arm, q, keep)
    dynamics = arm_dynamics(sys.arm, frames, keep)
    drift = flange_drift(frames, state.qd, keep)
    contact = None
    obstacles, link_force = state.obstacles, state.link_force
    if obstacles is not None:
        contact = contact_step(sys.arm, frames, obstacles, sys.contact_stiffness, timestep, keep)
        obstacles = obstacles._replace(center=contact.center)
        link_force = contact.link_force
    acceleration = joint_acceleration(sys.gains, frames, dynamics, drift, q, state.qd, act, contact, timestep)
    qd = jnp.clip(state.qd + timestep * acceleration, -MAX_JOINT_SPEED, MAX_JOINT_SPEED)
    return State(q + (0.5 * timestep) * qd, qd, obstacles, link_force)
