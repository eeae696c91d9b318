"""The arithmetic of the controller's tick, compiled by Numba.

Between a joint state and its command, the caches hold what the other processes on the CPU left there. Compiled, the
laws are a few kilobytes of code; as NumPy and LAPACK calls they run through megabytes of it, which takes several times
as long in the running stack as in a loop of their own.

All compiled functions are in this file, and whatever the settings decide is passed as an argument: Numba caches the
compiled code beside the file, and recompiles it when this file changes, but not when an imported module does.

Vectors and matrices are float64 of any layout, joints in the arm's order, task-space vectors
(linear, angular) in the axes of the base frame.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numba
import numpy as np
from numba import float64

from contact_reach_ros.arm import Array


class Constant(IntEnum):
    """Everything that the settings decide: rows of a matrix (len(Constant), n) with a column for each joint.

    A value that is the same for all joints fills its row. `constants.make_constants` builds the matrix.
    """

    TASK_STIFFNESS = 0
    TASK_DAMPING = 1
    NULL_STIFFNESS = 2
    NULL_DAMPING = 3
    SINGULARITY_FLOOR = 4
    LOWER_THRESHOLD = 5
    UPPER_THRESHOLD = 6
    REPULSION_MARGIN = 7
    REPULSION_STRENGTH = 8
    REPULSION_DAMPING = 9
    BRAKED_SPEED = 10
    SPEED_CEILING = 11
    SPEED_RATE = 12
    TORQUE_CAP = 13
    TORQUE_RATE = 14
    GRAVITY_SHARE = 15
    STOP_RATE = 16
    TASK_ROWS = 17
    TIP_FORCE = 18
    BODY_SPEED = 19
    IMPACT_ENERGY = 20
    POSTURE_REACH = 21


_POSITION_ROWS, _AXIS_ROWS = 3, 5
"""`TASK_ROWS` of translation alone, and of translation and the direction of the tip's z axis."""

_JERK_SHARE = 0.3
"""Share of the jerk that a joint's own torque can produce that is relied upon to end its acceleration in time.

The other joints' torques change meanwhile and may work against it.
"""

_SPEED_SWEEPS = 3
"""Times that `keep_speed` goes through the joints: what one takes back may be what another brakes with.

With references that jump about near singularities one of 300 arms became too fast with one, none with two or three.
"""

_FADE = 0.15
"""Share of the permitted speed within which the push of the laws fades beyond it."""

_YIELD_SWEEPS = 8
"""Times that `yielded` goes through the joints."""

_VECTOR, _MATRIX = (numba.types.Array(float64, dimensions, "A", readonly=True) for dimensions in (1, 2))
"""Types of read-only arrays of any layout."""
_RESULT = float64[::1]


def _compiled(*types: Any) -> Callable[[Callable], Any]:
    """Compile for these types, result first, when the module is imported; at the first call if none are given.

    What a tick calls directly must name its types: nothing may be compiled while an arm waits.
    """
    signature = types[0](*types[1:]) if types else None

    def compile_(function: Callable) -> Any:
        try:
            return numba.njit(signature, cache=True, error_model="numpy")(function)
        except RuntimeError:
            # There is no directory to cache it in: neither here nor among the user's caches.
            return numba.njit(signature, error_model="numpy")(function)

    return compile_


@_compiled()
def factorise(matrix: Array, shift: float) -> tuple[Array, bool]:
    """L of L Lᵀ = A − shift I, lower triangle, for a symmetric A; and whether that matrix is positive definite."""
    size = len(matrix)
    factor = np.empty((size, size))
    for column in range(size):
        for row in range(column, size):
            rest = matrix[row, column]
            for k in range(column):
                rest -= factor[row, k] * factor[column, k]
            if row > column:
                factor[row, column] = rest / factor[column, column]
            elif rest > shift:
                factor[column, column] = np.sqrt(rest - shift)
            else:
                return factor, False
    return factor, True


@_compiled()
def solve_lower(factor: Array, vector: Array) -> Array:
    """L⁻¹ b."""
    solution = np.empty(len(vector))
    for row in range(len(vector)):
        rest = vector[row]
        for k in range(row):
            rest -= factor[row, k] * solution[k]
        solution[row] = rest / factor[row, row]
    return solution


@_compiled()
def solve_upper(factor: Array, vector: Array) -> Array:
    """L⁻ᵀ b."""
    solution = np.empty(len(vector))
    for row in range(len(vector) - 1, -1, -1):
        rest = vector[row]
        for k in range(row + 1, len(vector)):
            rest -= factor[k, row] * solution[k]
        solution[row] = rest / factor[row, row]
    return solution


@_compiled()
def times(matrix: Array, vector: Array) -> Array:
    """A b."""
    product = np.empty(matrix.shape[0])
    for row in range(matrix.shape[0]):
        total = 0.0
        for k in range(matrix.shape[1]):
            total += matrix[row, k] * vector[k]
        product[row] = total
    return product


@_compiled()
def rotation_vector(rotation: Array) -> Array:
    """Axis times angle in [0, π] of a rotation matrix, (3,), rad."""
    sines, symmetric = np.empty(3), np.empty(3)
    cosine = 0.5 * (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1.0)
    largest = 0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        sines[i] = 0.5 * (rotation[k, j] - rotation[j, k])
        if rotation[i, i] > rotation[largest, largest]:
            largest = i
    sine = np.sqrt(sines[0] ** 2 + sines[1] ** 2 + sines[2] ** 2)
    angle = np.arctan2(sine, cosine)
    if cosine > 0.0:
        # 1 where the angle is too small to differ from its sine.
        share = angle / sine if sine > 1e-8 else 1.0
        for i in range(3):
            sines[i] *= share
        return sines
    # Near a half turn they vanish; the symmetric part, cos I + (1 - cos) a aᵀ, still gives the axis a up to its sign.
    side, square = 0.0, 0.0
    for i in range(3):
        symmetric[i] = 0.5 * (rotation[i, largest] + rotation[largest, i]) - (cosine if i == largest else 0.0)
        square += symmetric[i] ** 2
        side += symmetric[i] * sines[i]
    share = (angle if side >= 0.0 else -angle) / np.sqrt(square)
    for i in range(3):
        symmetric[i] *= share
    return symmetric


@_compiled()
def axis_turn(rotation: Array, reference_rotation: Array) -> Array:
    """Rotation vector, (3,), rad, of the shortest turn from the second rotation's z axis to that of the first."""
    turn, square, cosine = np.empty(3), 0.0, 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        turn[i] = reference_rotation[j, 2] * rotation[k, 2] - reference_rotation[k, 2] * rotation[j, 2]
        square += turn[i] ** 2
        cosine += reference_rotation[i, 2] * rotation[i, 2]
    sine = np.sqrt(square)
    # Half a turn leads from one to the other about any axis in between, as about x.
    is_opposite = sine < 1e-8 and cosine < 0.0
    share = np.arctan2(sine, cosine) / sine if sine > 1e-8 else 1.0
    for i in range(3):
        turn[i] = np.pi * rotation[i, 0] if is_opposite else share * turn[i]
    return turn


@_compiled()
def pose_error(
    position: Array, rotation: Array, reference_position: Array, reference_rotation: Array, task_rows: int
) -> Array:
    """Δx = x ⊖ x_d, (6,): translation in m, then a rotation vector in rad.

    The rotation vector of R R_dᵀ, or the part that law (1) controls: with five rows `axis_turn`, with three nothing.
    """
    error = np.zeros(6)
    for i in range(3):
        error[i] = position[i] - reference_position[i]
    if task_rows == _POSITION_ROWS:
        return error
    if task_rows == _AXIS_ROWS:
        vector = axis_turn(rotation, reference_rotation)
        for i in range(3):
            error[3 + i] = vector[i]
        return error
    turn = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            total = 0.0
            for k in range(3):
                total += rotation[row, k] * reference_rotation[column, k]
            turn[row, column] = total
    vector = rotation_vector(turn)
    for i in range(3):
        error[3 + i] = vector[i]
    return error


@_compiled()
def controlled(vectors: Array, rotation: Array, task_rows: int) -> Array:
    """The rows (m, N) of task-space vectors (6, N) that law (1) controls.

    Of five, the last two are the angular part along the tip's x and y axes, which turn its z axis; `rotation` is the
    tip's. That these axes move adds nothing to the drift: ω × x has no part along ω.
    """
    found = np.empty((task_rows, vectors.shape[1]))
    for column in range(vectors.shape[1]):
        for row in range(task_rows):
            found[row, column] = vectors[row, column]
            if task_rows == _AXIS_ROWS and row > 2:
                total = 0.0
                for k in range(3):
                    total += rotation[k, row - 3] * vectors[3 + k, column]
                found[row, column] = total
    return found


@_compiled(_RESULT, _VECTOR, _VECTOR, float64)
def between(start: Array, end: Array, share: float) -> Array:
    """The vector at `share` (0 to 1) of the way from `start` to `end`."""
    found = np.empty(len(start))
    for i in range(len(start)):
        found[i] = start[i] + share * (end[i] - start[i])
    return found


@_compiled(float64[:, ::1], _MATRIX, _MATRIX, float64)
def turned(start: Array, end: Array, share: float) -> Array:
    """The rotation (3, 3) at `share` (0 to 1) of the way from `start` to `end`, along the shortest arc."""
    turn = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            total = 0.0
            for k in range(3):
                total += end[row, k] * start[column, k]
            turn[row, column] = total
    vector = rotation_vector(turn)
    x, y, z = share * vector[0], share * vector[1], share * vector[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    # Rodrigues' formula, its quotients by their series where the angle is small.
    sine = np.sin(angle) / angle if angle > 1e-4 else 1.0 - square / 6.0
    cosine = (1.0 - np.cos(angle)) / square if angle > 1e-4 else 0.5 - square / 24.0
    vector[0], vector[1], vector[2] = x, y, z
    for row in range(3):
        for column in range(3):
            turn[row, column] = cosine * vector[row] * vector[column]
        turn[row, row] += 1.0 - cosine * square
    turn[0, 1] -= sine * z
    turn[1, 0] += sine * z
    turn[0, 2] += sine * y
    turn[2, 0] -= sine * y
    turn[1, 2] -= sine * x
    turn[2, 1] += sine * x
    found = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            total = 0.0
            for k in range(3):
                total += turn[row, k] * start[k, column]
            found[row, column] = total
    return found


@_compiled()
def solve_bounded(matrix: Array, vector: Array, floor: float) -> Array:
    """A⁻¹ b for a symmetric positive semi-definite A, by an inverse whose norm stays at or below 2 / floor.

    Eigenvalues of at least `floor` are inverted exactly, so that the result is the true inverse away from
    singularities. Smaller ones are lifted to floor/2 · (1 + (s/floor)²), which meets s with the same slope at the
    floor: the result is continuously differentiable in the matrix.
    """
    # The shifted factor exists exactly when all eigenvalues are above the floor, and costs far less than they do.
    if factorise(matrix, floor)[1]:
        factor = factorise(matrix, 0.0)[0]
        return solve_upper(factor, solve_lower(factor, vector))
    size = len(vector)
    values, vectors = np.linalg.eigh(matrix)
    solution = np.zeros(size)
    for i in range(size):
        value = values[i]
        if value < floor:
            share = max(value, 0.0) / floor
            value = 0.5 * floor * (1.0 + share * share)
        part = 0.0
        for k in range(size):
            part += vectors[k, i] * vector[k]
        for k in range(size):
            solution[k] += vectors[k, i] * part / value
    return solution


@_compiled()
def push_share(driving: Array, braking: Array, most: float) -> float:
    """Greatest share s of a force, 0 to 1, with which |s F + D| ≤ `most`, for the first three rows of both, N.

    Where the damping D alone exceeds it, the share that comes nearest.
    """
    square, product, rest = 0.0, 0.0, -most * most
    for row in range(3):
        square += driving[row] * driving[row]
        product += driving[row] * braking[row]
        rest += braking[row] * braking[row]
    if square == 0.0 or square + 2.0 * product + rest <= 0.0:
        return 1.0
    root = np.sqrt(max(product * product - square * rest, 0.0))
    return min(max((root - product) / square, 0.0), 1.0)


@_compiled()
def speed_share(
    constants: Array, placements: Array, links: Array, points: Array, q: Array, v: Array, mass_factor: Array
) -> float:
    """Greatest speed of the points as a share of the permitted one: by speed, or by the energy ½ ẋ² / (nᵀ J M⁻¹ Jᵀ n).

    n is the direction of a point's motion; the arguments after `constants` are those of `constants.Body`, q (n,) rad, q̇
    (n,) rad/s, and the Cholesky factor of M.
    """
    n = len(q)
    rotation, turned_by, origin = np.eye(3), np.empty((3, 3)), np.zeros(3)
    axes, origins, rotations = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3, 3))
    for i in range(n):
        cosine, sine = np.cos(q[i]), np.sin(q[i])
        for row in range(3):
            step = 0.0
            for k in range(3):
                step += rotation[row, k] * placements[3 * i + k, 3]
                total = 0.0
                for m in range(3):
                    total += rotation[row, m] * placements[3 * i + m, k]
                turned_by[row, k] = total
            origin[row] += step
        for row in range(3):
            rotation[row, 0] = cosine * turned_by[row, 0] + sine * turned_by[row, 1]
            rotation[row, 1] = cosine * turned_by[row, 1] - sine * turned_by[row, 0]
            rotation[row, 2] = turned_by[row, 2]
            axes[i, row], origins[i, row] = turned_by[row, 2], origin[row]
        rotations[i] = rotation
    most, rows, lever = 0.0, np.empty((n, 3)), np.empty(3)
    for index in range(len(links)):
        link = int(links[index])
        motion = np.zeros(3)
        for i in range(link + 1):
            for row in range(3):
                lever[row] = origins[link, row] - origins[i, row]
                for k in range(3):
                    lever[row] += rotations[link, row, k] * points[index, k]
            for row in range(3):
                j, k = (row + 1) % 3, (row + 2) % 3
                rows[i, row] = axes[i, j] * lever[k] - axes[i, k] * lever[j]
                motion[row] += rows[i, row] * v[i]
        speed = np.sqrt(motion[0] ** 2 + motion[1] ** 2 + motion[2] ** 2)
        if speed < 1e-3:
            continue
        direction = np.zeros(n)
        for i in range(link + 1):
            for row in range(3):
                direction[i] += rows[i, row] * motion[row] / speed
        solution, mobility = solve_lower(mass_factor, direction), 0.0
        for i in range(n):
            mobility += solution[i] * solution[i]
        energy = 0.5 * speed * speed / mobility
        share = max(speed / constants[Constant.BODY_SPEED, 0], np.sqrt(energy / constants[Constant.IMPACT_ENERGY, 0]))
        most = max(most, share)
    return most


@_compiled()
def law_torque(
    constants: Array,
    mass_factor: Array,
    jacobian: Array,
    twist: Array,
    drift: Array,
    error: Array,
    joint_torque: Array,
    most: float,
) -> Array:
    """τ of law (3) without the C + g of law (1), (n,), N m.

    (1) + (2) as Jᵀ Λ (ẍ_cmd − J M⁻¹ τ₀) + τ₀, since Nᵀ = I − Jᵀ Λ J M⁻¹. Of the push −Kp Δx it takes the share that
    drives the arm with no more than the permitted force beyond its damping.

    Parameters
    ----------
    mass_factor
        Cholesky factor L of M, (n, n).
    jacobian, twist, drift
        J (m, n), ẋ (m,) and J̇ q̇ (m,).
    error
        Δx, (m,).
    joint_torque
        τ₀, (n,), N m.
    most
        Greatest share of the push, 0 to 1.
    """
    m, n = jacobian.shape
    stiffness, damping = constants[Constant.TASK_STIFFNESS, 0], constants[Constant.TASK_DAMPING, 0]
    # J M⁻¹ Jᵀ = Y Yᵀ with Y = J L⁻ᵀ, and J M⁻¹ τ₀ = Y L⁻¹ τ₀.
    rows = np.empty((m, n))
    for row in range(m):
        solution = solve_lower(mass_factor, jacobian[row])
        for k in range(n):
            rows[row, k] = solution[k]
    pull = times(rows, solve_lower(mass_factor, joint_torque))
    mobility, push, brake, rest = np.empty((m, m)), np.empty(m), np.empty(m), np.empty(m)
    for row in range(m):
        for column in range(row + 1):
            product = 0.0
            for k in range(n):
                product += rows[row, k] * rows[column, k]
            mobility[row, column] = mobility[column, row] = product
        push[row], brake[row] = -stiffness * error[row], -damping * twist[row]
        rest[row] = -drift[row] - pull[row]
    floor = constants[Constant.SINGULARITY_FLOOR, 0]
    driving, braking = solve_bounded(mobility, push, floor), solve_bounded(mobility, brake, floor)
    wrench = solve_bounded(mobility, rest, floor)
    share = min(push_share(driving, braking, constants[Constant.TIP_FORCE, 0]), most)
    for row in range(m):
        wrench[row] += share * driving[row] + braking[row]
    torque = times(jacobian.T, wrench)
    for i in range(n):
        torque[i] += joint_torque[i]
    return torque


@_compiled()
def repulsion_torque(constants: Array, q: Array, v: Array) -> Array:
    """Torque (n,) in N m that pushes joints out of a margin before their position limits.

    It grows with the square of the depth, so that it starts without a step, and reaches the given share of the joint's
    torque limit at the position limit. Damping acts on motion towards the limit and grows in the same way.
    """
    n = len(q)
    lower, upper = constants[Constant.LOWER_THRESHOLD], constants[Constant.UPPER_THRESHOLD]
    margin = constants[Constant.REPULSION_MARGIN]
    strength, damping = constants[Constant.REPULSION_STRENGTH], constants[Constant.REPULSION_DAMPING]
    torque = np.zeros(n)
    for i in range(n):
        side = 1.0 if q[i] - upper[i] >= lower[i] - q[i] else -1.0
        depth = min(max(q[i] - upper[i], lower[i] - q[i]) / margin[i], 1.5)
        if depth > 0.0:
            approach = max(side * v[i], 0.0)
            torque[i] = -side * depth * (strength[i] * depth + damping[i] * approach)
    return torque


@_compiled()
def null_brake(constants: Array, v: Array, mass_matrix: Array) -> Array:
    """τ₀ = −M k e (n,) in N m that brakes joints in the null space, e being their speeds beyond a share of the limit.

    Null-space motion that posture references cause has little damping of its own; the task does not feel this torque.
    """
    n = len(v)
    braked, rate = constants[Constant.BRAKED_SPEED], constants[Constant.SPEED_RATE]
    acceleration = np.empty(n)
    for i in range(n):
        acceleration[i] = -rate[i] * np.sign(v[i]) * max(abs(v[i]) - braked[i], 0.0)
    return times(mass_matrix, acceleration)


@_compiled()
def inverse(factor: Array) -> Array:
    """A⁻¹ of A = L Lᵀ."""
    size = len(factor)
    result = np.empty((size, size))
    for i in range(size):
        unit = np.zeros(size)
        unit[i] = 1.0
        result[i] = solve_upper(factor, solve_lower(factor, unit))
    return result


@_compiled()
def permitted_acceleration(constants: Array, joint: int, left: float, inverse_mass: Array) -> float:
    """Greatest acceleration, rad/s², of a joint whose speed may grow by `left`, rad/s; negative where it is too fast.

    It is k times what is left, and at most what the joint's own torque can end in time at its greatest rate.
    """
    rate = constants[Constant.SPEED_RATE, joint]
    jerk = _JERK_SHARE * constants[Constant.TORQUE_RATE, joint] * inverse_mass[joint, joint]
    if left <= jerk / rate**2:
        return rate * left
    return np.sqrt(2.0 * jerk * left - (jerk / rate) ** 2)


@_compiled()
def excess_acceleration(constants: Array, v: Array, inverse_mass: Array, joint: int, acceleration: float) -> float:
    """Part of a joint's acceleration, rad/s², beyond the permitted one on the way to its speed limit v_max."""
    speed, ceiling = v[joint], constants[Constant.SPEED_CEILING, joint]
    most = permitted_acceleration(constants, joint, ceiling - speed, inverse_mass)
    least = -permitted_acceleration(constants, joint, ceiling + speed, inverse_mass)
    # The speed that a joint has is braked first, however soon it may then have to stop on the other side.
    if speed > 0.0:
        least = min(least, most)
    else:
        most = max(most, least)
    return max(acceleration - most, 0.0) + min(acceleration - least, 0.0)


@_compiled()
def speed_limit_torque(constants: Array, v: Array, mass_matrix: Array, inverse_mass: Array, drive: Array) -> Array:
    """Torque to add, (n,) in N m, so that no joint is driven beyond its speed limit, however strong the torques.

    The torque −M e removes the excess accelerations e of q̈ = M⁻¹ τ and leaves those of the other joints alone.
    `drive` is τ: all that drives the arm, without what only compensates C + g.
    """
    n = len(v)
    change = times(inverse_mass, drive)
    for i in range(n):
        change[i] = -excess_acceleration(constants, v, inverse_mass, i, change[i])
    return times(mass_matrix, change)


@_compiled()
def hold_others_back(
    inverse_mass: Array, joint: int, excess: float, acceleration: Array, torque: Array, previous: Array
) -> None:
    """Take back what the other joints' changes of `torque` (n,), N m, add to a joint's excess acceleration, rad/s².

    Of all that add to it the same share, no more than the excess takes; `acceleration` (n,), rad/s², follows. Near a
    straight elbow they would undo most of what the joint's own torque does at its greatest rate.
    """
    n, adding = len(torque), 0.0
    for k in range(n):
        if k != joint:
            adding += max(np.sign(excess) * inverse_mass[joint, k] * (torque[k] - previous[k]), 0.0)
    if adding == 0.0:
        return
    share = min(abs(excess) / adding, 1.0)
    for k in range(n):
        change = torque[k] - previous[k]
        if k != joint and excess * inverse_mass[joint, k] * change > 0.0:
            torque[k] = previous[k] + (1.0 - share) * change
            for row in range(n):
                acceleration[row] -= inverse_mass[row, k] * share * change


@_compiled()
def keep_speed(
    constants: Array, v: Array, inverse_mass: Array, drive: Array, torque: Array, previous: Array, period: float
) -> None:
    """Restore in `torque` (n,), N m, what `limit_torque` has undone of `speed_limit_torque`.

    A joint that would still be accelerated too much is held back by its own torque, as far as cap and rate permit, and
    where that is not enough, by the others changing less. `drive` (n,) is the part of `torque` that drives the arm,
    without what only compensates C + g.
    """
    n = len(torque)
    acceleration = times(inverse_mass, drive)
    rate, cap = constants[Constant.TORQUE_RATE], constants[Constant.TORQUE_CAP]
    for _ in range(_SPEED_SWEEPS):
        for i in range(n):
            excess = excess_acceleration(constants, v, inverse_mass, i, acceleration[i])
            if excess != 0.0:
                step = rate[i] * period
                wanted = torque[i] - excess / inverse_mass[i, i]
                wanted = min(max(wanted, previous[i] - step, -cap[i]), previous[i] + step, cap[i])
                for k in range(n):
                    acceleration[k] += inverse_mass[i, k] * (wanted - torque[i])
                torque[i] = wanted
                excess = excess_acceleration(constants, v, inverse_mass, i, acceleration[i])
                hold_others_back(inverse_mass, i, excess, acceleration, torque, previous)


@_compiled()
def limit_torque(constants: Array, torque: Array, previous: Array, period: float) -> Array:
    """Limit the torque (n,), N m, that follows `previous` after `period` seconds: to caps and rates; caps win.

    All joints advance by the same share of their change. If only the joints beyond their rate were held back, the
    torques would change their direction and drive the arm where nothing wants it.
    """
    n = len(torque)
    rate, cap = constants[Constant.TORQUE_RATE], constants[Constant.TORQUE_CAP]
    limited, share = np.empty(n), 1.0
    for i in range(n):
        limited[i] = min(max(torque[i], -cap[i]), cap[i])
        way, step = abs(limited[i] - previous[i]), rate[i] * period
        if way > step:
            share = min(share, step / way)
    for i in range(n):
        if share < 1.0:
            limited[i] = previous[i] + share * (limited[i] - previous[i])
        limited[i] = min(max(limited[i], -cap[i]), cap[i])
    return limited


@_compiled()
def posture_torque(constants: Array, posture_error: Array, v: Array) -> Array:
    """τ₀ of law (2), (n,) in N m, for Δq = q − q_d in rad and speeds in rad/s; q_d = 0 makes it that of law (6)."""
    n = len(v)
    stiffness, damping = constants[Constant.NULL_STIFFNESS], constants[Constant.NULL_DAMPING]
    torque = np.empty(n)
    for i in range(n):
        torque[i] = -stiffness[i] * posture_error[i] - damping[i] * v[i]
    return torque


@_compiled()
def sendable_torque(constants: Array, torque: Array, previous: Array, period: float) -> Array:
    """Torque that may follow `previous`, as `limit_torque`; all NaN where `torque` is not finite."""
    n = len(torque)
    limited = limit_torque(constants, torque, previous, period)
    total = 0.0
    for i in range(n):
        total += torque[i]
    if not np.isfinite(total):
        for i in range(n):
            limited[i] = np.nan
    return limited


@_compiled()
def braking_share(constants: Array, v: Array, mass_matrix: Array) -> float:
    """Share of the stop's damping with which every joint's torque can follow its speed down at its greatest rate.

    Damping that the rate delays would drive the arm back. One share for all joints keeps the damping dissipative.
    """
    share = 1.0
    for i in range(len(v)):
        rate, speed = constants[Constant.STOP_RATE, i], abs(v[i])
        jerk = _JERK_SHARE * constants[Constant.TORQUE_RATE, i] / mass_matrix[i, i]
        if speed > jerk / rate**2:
            share = min(share, np.sqrt(2.0 * jerk * speed - (jerk / rate) ** 2) / (rate * speed))
    return share


@_compiled(_RESULT, _VECTOR, _VECTOR, _MATRIX)
def yielded(tension: Array, most: Array, stiffness: Array) -> Array:
    """The tension (n,), N m, of a spring after it has yielded: within `most` (n,) in each joint.

    Of all tensions within, the nearest one in the norm of the stored energy ½ τᵀ K⁻¹ τ, which therefore does not grow:
    associated plasticity. Coordinate descent from the clipped tension; `stiffness` is K (n, n), N m/rad.
    """
    n = len(tension)
    found, compliance = np.empty(n), inverse(factorise(stiffness, 0.0)[0])
    for i in range(n):
        found[i] = min(max(tension[i], -most[i]), most[i])
    for _ in range(_YIELD_SWEEPS):
        for i in range(n):
            slope = 0.0
            for k in range(n):
                slope += compliance[i, k] * (found[k] - tension[k])
            found[i] = min(max(found[i] - slope / compliance[i, i], -most[i]), most[i])
    return found


@_compiled(_RESULT, *(_MATRIX,) * 2, *(_VECTOR,) * 4, float64)
def stopping_torque(
    constants: Array, mass_matrix: Array, gravity: Array, v: Array, tension: Array, previous: Array, period: float
) -> Array:
    """Torque (n,) of the stop, N m: gravity, damping −s M q̇, and the tension (n,) of the hold, N m.

    Others as for `tracking_torque`.
    """
    n = len(v)
    share = braking_share(constants, v, mass_matrix)
    wanted = np.empty(n)
    for i in range(n):
        wanted[i] = -share * constants[Constant.STOP_RATE, i] * v[i]
    torque = times(mass_matrix, wanted)
    for i in range(n):
        torque[i] += tension[i] + constants[Constant.GRAVITY_SHARE, i] * gravity[i]
    return sendable_torque(constants, torque, previous, period)


@_compiled(
    *(_RESULT, _MATRIX),
    *(_MATRIX, _VECTOR, _VECTOR, _VECTOR, _MATRIX, _MATRIX, _VECTOR, _VECTOR),
    *(_VECTOR, _MATRIX, _VECTOR),
    *(_MATRIX, _VECTOR, _MATRIX),
    *(_VECTOR, _VECTOR, float64, _VECTOR, float64, _RESULT),
)
def tracking_torque(
    constants: Array,
    mass_matrix: Array,
    bias: Array,
    gravity: Array,
    position: Array,
    rotation: Array,
    jacobian: Array,
    twist: Array,
    drift: Array,
    reference_position: Array,
    reference_rotation: Array,
    reference_posture: Array,
    placements: Array,
    links: Array,
    points: Array,
    q: Array,
    v: Array,
    authority: float,
    previous: Array,
    period: float,
    found: Array,
) -> Array:
    """Law (3) with all limits, (n,), N m; all NaN where no finite torque follows from the state.

    Parameters
    ----------
    constants
        From `constants.make_constants`.
    mass_matrix, bias, gravity, position, rotation, jacobian, twist, drift
        Attributes of `RobotModel`.
    reference_position, reference_rotation, reference_posture
        Attributes of `Reference`.
    placements, links, points
        Attributes of `Body`.
    q, v
        (n,), rad and rad/s.
    authority
        Share of all torques except the one that holds the arm against gravity.
    previous, period
        The last torque sent (n,), N m, and the time since then, s.
    found
        (7,), overwritten with Δx as `pose_error` gives it, and `speed_share`.
    """
    n, task_rows = len(v), int(constants[Constant.TASK_ROWS, 0])
    deviation = pose_error(position, rotation, reference_position, reference_rotation, task_rows)
    vectors = np.empty((6, n + 3))
    for i in range(6):
        found[i] = deviation[i]
        for k in range(n):
            vectors[i, k] = jacobian[i, k]
        vectors[i, n], vectors[i, n + 1], vectors[i, n + 2] = twist[i], drift[i], deviation[i]
    rows = controlled(vectors, rotation, task_rows)
    factor, regular = factorise(mass_matrix, 0.0)
    if not regular:
        return np.full(n, np.nan)
    found[6] = speed_share(constants, placements, links, points, q, v, factor)
    push = min(max((1.0 + _FADE - found[6]) / _FADE, 0.0), 1.0)
    posture_error = np.empty(n)
    for i in range(n):
        reach = constants[Constant.POSTURE_REACH, i]
        posture_error[i] = push * min(max(q[i] - reference_posture[i], -reach), reach)
    joint_torque = posture_torque(constants, posture_error, v)
    brake = null_brake(constants, v, mass_matrix)
    for i in range(n):
        joint_torque[i] += brake[i]
    torque = law_torque(constants, factor, rows[:, :n], rows[:, n], rows[:, n + 1], rows[:, n + 2], joint_torque, push)
    repulsion = repulsion_torque(constants, q, v)
    for i in range(n):
        torque[i] += repulsion[i]
    inverse_mass = inverse(factor)
    change = speed_limit_torque(constants, v, mass_matrix, inverse_mass, torque)
    share = constants[Constant.GRAVITY_SHARE]
    for i in range(n):
        torque[i] = authority * (torque[i] + change[i] + bias[i] - gravity[i]) + share[i] * gravity[i]
    sendable = sendable_torque(constants, torque, previous, period)
    if np.isfinite(sendable[0]):
        drive = np.empty(n)
        for i in range(n):
            drive[i] = sendable[i] - bias[i] + (1.0 - share[i]) * gravity[i]
        keep_speed(constants, v, inverse_mass, drive, sendable, previous, period)
    return sendable
