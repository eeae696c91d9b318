"""The closed loop of arm, law (3) and soft contact: `init` makes a state of a system, `step` advances it.

The action of a step is the reference of the control law, and one call advances all candidates. Brax's generalized
pipeline takes 40 to 160 times as long for the same motion on a CPU. `planning.brax_env` offers this one on Brax's
own types.

With v the joint speeds, M the mass matrix, J the flange Jacobian and τ₀ the null-space torque before projection, law
(3) makes the arm move as

    M q̈ = Jᵀ f + τ₀ + τ_contact,    f = Λ (a − J M⁻¹ τ₀),    Λ = (J M⁻¹ Jᵀ)⁻¹,

where a is the task acceleration that law (1) asks for; C + g cancel, because the controller knows them. M, J and the
torques go through one Cholesky factorisation each of M and of J M⁻¹ Jᵀ.

Near singularities the controller lifts small eigenvalues of J M⁻¹ Jᵀ. Here the smallest one is lifted, by the same
rule: its eigenvector comes from two steps of inverse iteration, which need no eigenvalue decomposition of every
candidate. Of a second small eigenvalue, which needs two singularities at once, only the inverse is bounded. Joint
speeds are capped as the controller caps them.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.arm.kinematics import AXIS, POSE
from contact_reach_ros.control.settings import JOINT_SHARE, SINGULARITY_FLOOR, ImpedanceSettings
from contact_reach_ros.planning.transfer.arithmetic import cross, dot
from contact_reach_ros.planning.transfer.contact import Contact, Obstacles, contact_step
from contact_reach_ros.planning.transfer.dynamics import Dynamics, Frames, arm_dynamics, flange_drift, link_frames
from contact_reach_ros.planning.transfer.model import ArmModel

N_TASK = 6
"""Size of Δx in actions, whatever part of it law (1) controls."""

_CAP = 1.05 * JOINT_SHARE
"""Share of a joint's speed limit at which the controller's push has faded: at a singularity the laws would ask for
joint speeds that 25 ms steps cannot follow."""

_SHIFT = 0.01
"""What is added to J M⁻¹ Jᵀ before it is factorised, as a share of the floor: more than its error of rounding."""

_TINY = 1e-12
"""Square of a negligible wrench: keeps the eigenvector, and its derivative, of an arm that nothing drives finite."""


@dataclass(frozen=True, eq=False)
class System:
    """The constants of the closed loop."""

    arm: ArmModel
    gains: ImpedanceSettings
    timestep: float | jax.Array
    """s."""

    @property
    def action_size(self) -> int:
        """Size of one knot's action: Δx (translation, rotation) and Δq."""
        return N_TASK + self.arm.n


class Reference(NamedTuple):
    """References of laws (1) and (2) while one knot is in force."""

    position: jax.Array
    """(3, B) translation of x_d, m."""
    rotation: jax.Array
    """(3, 3, B) rotation of x_d, indexed [row, column]."""
    posture: jax.Array
    """(n, B) q_d, rad."""


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
    frames = link_frames(sys.arm, q)
    return Pose(frames.flange, frames.flange_rotation)


def step(sys: System, state: State, act: Reference) -> State:
    """Advance by one time step under the reference `act`: half a drift, a kick, half a drift."""
    timestep = sys.timestep
    q = state.q + (0.5 * timestep) * state.qd
    frames = link_frames(sys.arm, q)
    dynamics = arm_dynamics(sys.arm, frames)
    drift = flange_drift(frames, state.qd)
    contact = None
    obstacles, link_force = state.obstacles, state.link_force
    if obstacles is not None:
        contact = contact_step(sys.arm, frames, obstacles, timestep)
        obstacles = obstacles._replace(center=contact.center)
        link_force = contact.link_force
    acceleration = joint_acceleration(sys.gains, frames, dynamics, drift, q, state.qd, act, contact, timestep)
    qd = capped(sys.arm, state.qd + timestep * acceleration)
    return State(q + (0.5 * timestep) * qd, qd, obstacles, link_force)


def capped(arm: ArmModel, qd: jax.Array) -> jax.Array:
    """Joint speeds (n, B), rad/s, of which none is above what the controller's caps leave, in the same proportions."""
    share = functools.reduce(jnp.maximum, jnp.abs(qd) / (_CAP * arm.velocity_limit)[:, None])
    return qd / jnp.maximum(share, 1.0)


def joint_acceleration(
    gains: ImpedanceSettings,
    frames: Frames,
    dynamics: Dynamics,
    drift: jax.Array,
    q: jax.Array,
    v: jax.Array,
    reference: Reference,
    contact: Contact | None,
    timestep: float | jax.Array,
) -> jax.Array:
    """Mean joint acceleration (n, B) over a step of `timestep` seconds, from midpoint positions and initial speeds.

    Parameters
    ----------
    gains
        Gains of laws (1) and (2).
    frames, dynamics, drift
        The arm at the midpoint, J̇q̇ included.
    q, v
        (n, B) joint angles at the midpoint and speeds at the start of the step.
    reference
        References in force.
    contact
        Forces on the arm, or None in free space.
    """
    rows = gains.rows
    jacobian = controlled(gains, frames, dynamics.jacobian)
    # The implicit midpoint rule for the gains: (1 + dt Kd / 2 + dt² Kp / 4) a = −Kp Δx − Kd ẋ + (contact) in task
    # space, and the same with Kqd and Kqp in joint space. It lets 25 ms steps cope with Kd = 100 and the wrist's small
    # inertia. The contact has its share in `a`: otherwise contact would be twice too soft.
    implicit = 1.0 + 0.5 * timestep * gains.task_damping + 0.25 * timestep**2 * gains.task_stiffness
    stiffening = 0.5 * timestep * gains.null_damping + 0.25 * timestep**2 * gains.null_stiffness
    n = len(q)
    mass_matrix = dynamics.mass_matrix + stiffening * np.eye(n)[:, :, None]
    twist = jacobian[:, 0] * v[0]
    for joint in range(1, n):
        twist = twist + jacobian[:, joint] * v[joint]
    error = controlled(gains, frames, pose_error(frames, reference, gains.task))
    drift = controlled(gains, frames, drift)
    desired = (-gains.task_stiffness * error - gains.task_damping * twist - drift) / implicit
    null_torque = -gains.null_stiffness * (q - reference.posture) - gains.null_damping * v
    torques = [null_torque] if contact is None else [null_torque, contact.joint_torque]

    factor, solved, pivots = factorise_mass(mass_matrix, jnp.concatenate([jacobian, jnp.stack(torques)]))
    wrench = _task_wrench(solved, desired, implicit, SINGULARITY_FLOOR)
    # q̈ = L⁻ᵀ (L⁻¹ Jᵀ f + L⁻¹ τ₀ + L⁻¹ τ_contact), from the last joint to the first.
    acceleration: list[jax.Array] = [wrench[0]] * n
    for joint in reversed(range(n)):
        row = solved[joint]
        total = row[rows]
        for extra in range(rows + 1, rows + len(torques)):
            total = total + row[extra]
        for axis in range(rows):
            total = total + row[axis] * wrench[axis]
        for later in range(joint + 1, n):
            total = total - factor[joint][later - joint] * acceleration[later]
        acceleration[joint] = total / pivots[joint]
    return jnp.stack(acceleration)


def controlled(gains: ImpedanceSettings, frames: Frames, vectors: jax.Array) -> jax.Array:
    """The rows (m, ..., B) of task-space vectors (6, ..., B) that law (1) controls, as in `kernels.controlled`."""
    if gains.task != AXIS:
        return vectors[: gains.rows]
    x, y, _ = frames.flange_axes
    return jnp.concatenate([vectors[:3], jnp.stack([dot(x, vectors[3:]), dot(y, vectors[3:])])])


def pose_error(frames: Frames, reference: Reference, task: str = POSE) -> jax.Array:
    """Δx = x ⊖ x_d, (6, B): translation in m, then a rotation vector in rad, both in base axes.

    It is that of R R_dᵀ or, where law (1) controls no more, of the turn of the tip's z axis. It comes from the sine of
    its angle by a series, good to 0.1 mrad up to 0.5 rad.
    """
    desired, (x, y, z) = reference.rotation, frames.flange_axes
    if task == AXIS:
        sine = cross(desired[:, 2], z)
    else:
        sine = 0.5 * (cross(desired[:, 0], x) + cross(desired[:, 1], y) + cross(desired[:, 2], z))
    square = dot(sine, sine)
    rotation = sine * (1.0 + square * (1.0 / 6.0 + square * (3.0 / 40.0 + square * (15.0 / 336.0))))
    return jnp.concatenate([frames.flange - reference.position, rotation])


def factorise_mass(mass_matrix: jax.Array, rows: jax.Array) -> tuple[list[jax.Array], list[jax.Array], list[jax.Array]]:
    """Left-looking Cholesky factorisation of M with further rows (R, n, B) appended.

    Returns for each joint j the column of the factor L from the diagonal down (n - j, B), the appended entries (R, B),
    which are the j-th components of L⁻¹ applied to the rows, and the pivot (B,).
    """
    n = len(mass_matrix)
    columns: list[jax.Array] = []
    pivots = []
    for joint in range(n):
        column = jnp.concatenate([mass_matrix[joint, joint:], rows[:, joint]])
        for earlier in range(joint):
            passed = columns[earlier][joint - earlier :]
            column = column - passed * passed[0][None]
        pivot = jnp.sqrt(column[0])
        pivots.append(pivot)
        columns.append(column / pivot[None])
    below = [column[: n - joint] for joint, column in enumerate(columns)]
    appended = [column[n - joint :] for joint, column in enumerate(columns)]
    return below, appended, pivots


def _task_wrench(
    solved: list[jax.Array], desired: jax.Array, implicit: float | jax.Array, floor: float
) -> list[jax.Array]:
    """The wrench f = Λ (desired − J M⁻¹ τ₀ − (1 − 1/implicit) J M⁻¹ τ_contact) as m rows (B,), by the same recursion.

    `solved` holds for each joint the entries of L⁻¹ [Jᵀ τ₀ τ_contact], the last only if there is contact.
    """
    n_rows, n_task, shift = solved[0].shape[0], len(desired), _SHIFT * floor
    columns: list[jax.Array] = []
    inverses: list[jax.Array] = []
    right: list[jax.Array] = []
    for axis in range(n_task):
        column = solved[0][axis:] * solved[0][axis][None]
        for joint in range(1, len(solved)):
            column = column + solved[joint][axis:] * solved[joint][axis][None]
        column, torque_part = column[: n_task - axis], column[n_task - axis :]
        wanted = desired[axis] - torque_part[0]
        if n_rows > n_task + 1:
            wanted = wanted + (1.0 / implicit - 1.0) * torque_part[1]
        right.append(wanted)
        for earlier in range(axis):
            passed = columns[earlier][axis - earlier :]
            column = column - passed * passed[0][None]
        # The shift bounds the pivots from below, but for rounding.
        inverses.append(jax.lax.rsqrt(jnp.maximum(column[0] + shift, shift)))
        columns.append(column * inverses[axis][None])  # The diagonal is not used.
    wrench = _solved(columns, inverses, right)
    # The smallest eigenvalue s and its vector, towards which the inverse draws any vector.
    size = jax.lax.rsqrt(_product(wrench, wrench) + _TINY)
    before = _solved(columns, inverses, [each * size for each in wrench])
    vector = _solved(columns, inverses, before)
    square = _product(vector, vector) + _TINY
    shifted = (_product(before, vector) + _TINY) / square
    least = shifted - shift
    # Below the floor s + floor/2 · (1 − s/floor)², as in the controller; of the implicit gains, which resist along s as
    # well, only what is lifted counts less.
    share = jnp.minimum(least * (1.0 / floor), 1.0)
    lifted = least + (0.5 * floor / implicit) * (1.0 - share) ** 2
    correction = (1.0 / lifted - 1.0 / shifted) * _product(vector, right) / square
    return [each + correction * along for each, along in zip(wrench, vector, strict=True)]


def _solved(columns: list[jax.Array], inverses: list[jax.Array], right: list[jax.Array]) -> list[jax.Array]:
    """The rows (B,) of x in L Lᵀ x = right, with the columns of L below the diagonal and the inverses of that."""
    forward: list[jax.Array] = []
    for axis, value in enumerate(right):
        for earlier in range(axis):
            value = value - columns[earlier][axis - earlier] * forward[earlier]
        forward.append(value * inverses[axis])
    solution = forward.copy()
    for axis in reversed(range(len(right))):
        total = forward[axis]
        for later in range(axis + 1, len(right)):
            total = total - columns[axis][later - axis] * solution[later]
        solution[axis] = total * inverses[axis]
    return solution


def _product(first: list[jax.Array], second: list[jax.Array]) -> jax.Array:
    total = first[0] * second[0]
    for one, other in zip(first[1:], second[1:], strict=True):
        total = total + one * other
    return total
