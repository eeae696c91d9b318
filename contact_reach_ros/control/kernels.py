"""The arithmetic of the controller's tick, compiled by Numba.

Between a joint state and its command the caches hold what the other processes on the CPU left there. Compiled, the laws
are a few kilobytes of code; as NumPy and LAPACK calls they run through megabytes of it, which takes several times as
long in the running stack as in a loop of their own.

All compiled functions are in this file, and what differs between settings comes as an argument: Numba keeps what it has
compiled beside the file, and makes it anew when this file has changed, not when one has that it imports.

Vectors and matrices are float64 of any layout, joints in the order of `iiwa14.JOINT_NAMES`, task-space vectors
(linear, angular) in the axes of the base frame.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numba
import numpy as np
from numba import float64
from numpy.typing import NDArray

Array = NDArray[np.float64]
_JOINTS, _TASK = 7, 6


class Constant(IntEnum):
    """Everything that settings decide: rows of a matrix (len(Constant), 7), a column for each joint.

    What is not a matter of joints stands in all columns. `constants.make_constants` fills it in.
    """

    TASK_STIFFNESS = 0
    TASK_DAMPING = 1
    NULL_STIFFNESS = 2
    NULL_DAMPING = 3
    SINGULARITY_FLOOR = 4
    REPULSION_THRESHOLD = 5
    REPULSION_MARGIN = 6
    REPULSION_STRENGTH = 7
    REPULSION_DAMPING = 8
    BRAKED_SPEED = 9
    SPEED_CEILING = 10
    SPEED_RATE = 11
    TORQUE_CAP = 12
    TORQUE_RATE = 13
    GRAVITY_SHARE = 14
    STOP_DAMPING = 15


_JERK_SHARE = 0.3
"""How much of the jerk that a joint's own torque can bring about is counted on to end its acceleration in time.

The other joints' torques change meanwhile and may work against it.
"""

_VECTOR, _MATRIX = (numba.types.Array(float64, dimensions, "A", readonly=True) for dimensions in (1, 2))
"""Of any layout, and not to be written to."""
_RESULT = float64[::1]


def _compiled(*types: Any) -> Callable[[Callable], Any]:
    """Compile for these types, result first, when the module is imported; at the first call if none are given.

    What a tick calls has to name them: nothing may be compiled while an arm waits.
    """
    signature = types[0](*types[1:]) if types else None

    def compile_(function: Callable) -> Any:
        try:
            return numba.njit(signature, cache=True, error_model="numpy")(function)
        except RuntimeError:
            # There is no directory to keep it in: neither here nor in the user's cache.
            return numba.njit(signature, error_model="numpy")(function)

    return compile_


@_compiled()
def factorise(matrix: Array, shift: float) -> tuple[Array, bool]:
    """L of L Lᵀ = A − shift I, lower triangle, for a symmetric A; and whether that is positive definite."""
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
        # 1 where the angle is too small to tell it from its sine.
        share = angle / sine if sine > 1e-8 else 1.0
        for i in range(3):
            sines[i] *= share
        return sines
    # Near a half turn they vanish; the symmetric part, cos I + (1 - cos) a aᵀ, still tells the axis a but for its side.
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
def pose_error(position: Array, rotation: Array, reference_position: Array, reference_rotation: Array) -> Array:
    """Δx = x ⊖ x_d, (6,): translation in m, then the rotation vector of R R_dᵀ in rad."""
    turn = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            total = 0.0
            for k in range(3):
                total += rotation[row, k] * reference_rotation[column, k]
            turn[row, column] = total
    vector = rotation_vector(turn)
    error = np.empty(_TASK)
    for i in range(3):
        error[i] = position[i] - reference_position[i]
        error[3 + i] = vector[i]
    return error


@_compiled()
def solve_bounded(matrix: Array, vector: Array, floor: float) -> Array:
    """A⁻¹ b for a symmetric positive semi-definite A, by an inverse whose norm stays at or below 2 / floor.

    Eigenvalues of at least `floor` are inverted exactly, so that the result is the true inverse away from
    singularities. Smaller ones are lifted to floor/2 · (1 + (s/floor)²), which meets s with the same slope at the
    floor: the result is continuously differentiable in the matrix.
    """
    # The shifted factor exists exactly when all eigenvalues are above the floor, and takes a fraction of their time.
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
def law_torque(
    constants: Array,
    mass_factor: Array,
    jacobian: Array,
    twist: Array,
    drift: Array,
    error: Array,
    joint_torque: Array,
) -> Array:
    """τ of law (3) without the C + g of law (1), (7,), N m.

    (1) + (2) as Jᵀ Λ (ẍ_cmd − J M⁻¹ τ₀) + τ₀, since Nᵀ = I − Jᵀ Λ J M⁻¹.

    Parameters
    ----------
    mass_factor
        Cholesky factor L of M, (7, 7).
    jacobian, twist, drift
        J (6, 7), ẋ (6,) and J̇ q̇ (6,).
    error
        Δx, (6,).
    joint_torque
        τ₀, (7,), N m.
    """
    stiffness, damping = constants[Constant.TASK_STIFFNESS, 0], constants[Constant.TASK_DAMPING, 0]
    # J M⁻¹ Jᵀ = Y Yᵀ with Y = J L⁻ᵀ, and J M⁻¹ τ₀ = Y L⁻¹ τ₀.
    rows = np.empty((_TASK, _JOINTS))
    for row in range(_TASK):
        solution = solve_lower(mass_factor, jacobian[row])
        for k in range(_JOINTS):
            rows[row, k] = solution[k]
    pull = times(rows, solve_lower(mass_factor, joint_torque))
    mobility, acceleration = np.empty((_TASK, _TASK)), np.empty(_TASK)
    for row in range(_TASK):
        for column in range(row + 1):
            product = 0.0
            for k in range(_JOINTS):
                product += rows[row, k] * rows[column, k]
            mobility[row, column] = mobility[column, row] = product
        acceleration[row] = -stiffness * error[row] - damping * twist[row] - drift[row] - pull[row]
    wrench = solve_bounded(mobility, acceleration, constants[Constant.SINGULARITY_FLOOR, 0])
    torque = times(jacobian.T, wrench)
    for i in range(_JOINTS):
        torque[i] += joint_torque[i]
    return torque


@_compiled()
def repulsion_torque(constants: Array, q: Array, v: Array) -> Array:
    """Torque (7,) in N m that pushes joints out of a margin before their position limits.

    It grows with the square of the depth, so that it starts without a step, and reaches the given share of the joint's
    torque limit at the position limit. Damping acts on motion towards the limit and grows alike.
    """
    threshold, margin = constants[Constant.REPULSION_THRESHOLD], constants[Constant.REPULSION_MARGIN]
    strength, damping = constants[Constant.REPULSION_STRENGTH], constants[Constant.REPULSION_DAMPING]
    torque = np.zeros(_JOINTS)
    for i in range(_JOINTS):
        depth = min((abs(q[i]) - threshold[i]) / margin[i], 1.5)
        if depth > 0.0:
            side = np.sign(q[i])
            approach = max(side * v[i], 0.0)
            torque[i] = -side * depth * (strength[i] * depth + damping[i] * approach)
    return torque


@_compiled()
def null_brake(constants: Array, v: Array, mass_matrix: Array) -> Array:
    """τ₀ = −M k e (7,) in N m that brakes joints in the null space, e being their speeds beyond a share of the limit.

    What posture references set in motion in the null space has little damping of its own; the task does not feel this.
    """
    braked, rate = constants[Constant.BRAKED_SPEED], constants[Constant.SPEED_RATE]
    acceleration = np.empty(_JOINTS)
    for i in range(_JOINTS):
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
    """Greatest acceleration, rad/s², of a joint that may get faster by `left`, rad/s; negative where it is too fast.

    k times what is left, and no more than a jerk can end in time: that of the joint's own torque at its greatest rate.
    """
    rate = constants[Constant.SPEED_RATE, joint]
    jerk = _JERK_SHARE * constants[Constant.TORQUE_RATE, joint] * inverse_mass[joint, joint]
    if left <= jerk / rate**2:
        return rate * left
    return np.sqrt(2.0 * jerk * left - (jerk / rate) ** 2)


@_compiled()
def excess_acceleration(constants: Array, v: Array, inverse_mass: Array, joint: int, acceleration: float) -> float:
    """What of a joint's acceleration, rad/s², is more than permitted on the way to its speed limit v_max."""
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
    """What to add, (7,) in N m, so that no joint is driven beyond its speed limit, however strong the torques.

    The excess accelerations e of q̈ = M⁻¹ τ are taken away by −M e, which leaves those of the other joints alone.
    `drive` is τ: all that drives the arm, without what only compensates C + g.
    """
    change = times(inverse_mass, drive)
    for i in range(_JOINTS):
        change[i] = -excess_acceleration(constants, v, inverse_mass, i, change[i])
    return times(mass_matrix, change)


@_compiled()
def keep_speed(
    constants: Array, v: Array, inverse_mass: Array, drive: Array, torque: Array, previous: Array, period: float
) -> None:
    """Mend in `torque` (7,), N m, what `limit_torque` has undone of `speed_limit_torque`.

    A joint that would still be accelerated too much is held back by its own torque, as far as cap and rate permit.
    `drive` (7,) is what of `torque` drives the arm, without what only compensates C + g.
    """
    acceleration = times(inverse_mass, drive)
    rate, cap = constants[Constant.TORQUE_RATE], constants[Constant.TORQUE_CAP]
    for i in range(_JOINTS):
        excess = excess_acceleration(constants, v, inverse_mass, i, acceleration[i])
        if excess != 0.0:
            step = rate[i] * period
            wanted = torque[i] - excess / inverse_mass[i, i]
            wanted = min(max(wanted, previous[i] - step, -cap[i]), previous[i] + step, cap[i])
            for k in range(_JOINTS):
                acceleration[k] += inverse_mass[i, k] * (wanted - torque[i])
            torque[i] = wanted


@_compiled()
def limit_torque(constants: Array, torque: Array, previous: Array, period: float) -> Array:
    """The torque (7,) in N m that may follow `previous` after `period` seconds: caps and rates are kept; caps win.

    All joints go the same share of their way. Were only those held back that are too quick, all would no longer pull
    in one direction, and the arm would be driven where nothing wants it.
    """
    rate, cap = constants[Constant.TORQUE_RATE], constants[Constant.TORQUE_CAP]
    limited, share = np.empty(_JOINTS), 1.0
    for i in range(_JOINTS):
        limited[i] = min(max(torque[i], -cap[i]), cap[i])
        way, step = abs(limited[i] - previous[i]), rate[i] * period
        if way > step:
            share = min(share, step / way)
    for i in range(_JOINTS):
        if share < 1.0:
            limited[i] = previous[i] + share * (limited[i] - previous[i])
        limited[i] = min(max(limited[i], -cap[i]), cap[i])
    return limited


@_compiled()
def posture_torque(constants: Array, posture_error: Array, v: Array) -> Array:
    """τ₀ of law (2), (7,) in N m, for Δq = q − q_d in rad and speeds in rad/s; q_d = 0 makes it that of law (6)."""
    stiffness, damping = constants[Constant.NULL_STIFFNESS], constants[Constant.NULL_DAMPING]
    torque = np.empty(_JOINTS)
    for i in range(_JOINTS):
        torque[i] = -stiffness[i] * posture_error[i] - damping[i] * v[i]
    return torque


@_compiled()
def sendable_torque(constants: Array, torque: Array, previous: Array, period: float) -> Array:
    """What may follow `previous`, as `limit_torque`; NaN in all of it where `torque` is not finite."""
    limited = limit_torque(constants, torque, previous, period)
    total = 0.0
    for i in range(_JOINTS):
        total += torque[i]
    if not np.isfinite(total):
        for i in range(_JOINTS):
            limited[i] = np.nan
    return limited


@_compiled(_RESULT, _MATRIX, *(_VECTOR,) * 4, float64)
def stopping_torque(constants: Array, bias: Array, gravity: Array, v: Array, previous: Array, period: float) -> Array:
    """Torque (7,) of the compliant stop, N m: no stiffness, damping and gravity only. As `tracking_torque`."""
    share, damping = constants[Constant.GRAVITY_SHARE], constants[Constant.STOP_DAMPING]
    torque = np.empty(_JOINTS)
    for i in range(_JOINTS):
        torque[i] = bias[i] - gravity[i] - damping[i] * v[i] + share[i] * gravity[i]
    return sendable_torque(constants, torque, previous, period)


@_compiled(
    *(_RESULT, _MATRIX),
    *(_MATRIX, _VECTOR, _VECTOR, _VECTOR, _MATRIX, _MATRIX, _VECTOR, _VECTOR),
    *(_VECTOR, _MATRIX, _VECTOR),
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
    q: Array,
    v: Array,
    authority: float,
    previous: Array,
    period: float,
    error: Array,
) -> Array:
    """Law (3) with all limits, (7,), N m; NaN in all of it where no finite torque follows from the state.

    Parameters
    ----------
    constants
        Of `constants.make_constants`.
    mass_matrix, bias, gravity, position, rotation, jacobian, twist, drift
        Of `RobotModel`.
    reference_position, reference_rotation, reference_posture
        Of `Reference`.
    q, v
        (7,), rad and rad/s.
    authority
        Share of all torques but that which holds the arm against gravity.
    previous, period
        The torque (7,) sent last, N m, and since when, s.
    error
        (6,): becomes Δx.
    """
    deviation = pose_error(position, rotation, reference_position, reference_rotation)
    for i in range(_TASK):
        error[i] = deviation[i]
    factor, regular = factorise(mass_matrix, 0.0)
    if not regular:
        return np.full(_JOINTS, np.nan)
    posture_error = np.empty(_JOINTS)
    for i in range(_JOINTS):
        posture_error[i] = q[i] - reference_posture[i]
    joint_torque = posture_torque(constants, posture_error, v)
    brake = null_brake(constants, v, mass_matrix)
    for i in range(_JOINTS):
        joint_torque[i] += brake[i]
    torque = law_torque(constants, factor, jacobian, twist, drift, deviation, joint_torque)
    repulsion = repulsion_torque(constants, q, v)
    for i in range(_JOINTS):
        torque[i] += repulsion[i]
    inverse_mass = inverse(factor)
    change = speed_limit_torque(constants, v, mass_matrix, inverse_mass, torque)
    share = constants[Constant.GRAVITY_SHARE]
    for i in range(_JOINTS):
        torque[i] = authority * (torque[i] + change[i] + bias[i] - gravity[i]) + share[i] * gravity[i]
    sendable = sendable_torque(constants, torque, previous, period)
    if np.isfinite(sendable[0]):
        drive = np.empty(_JOINTS)
        for i in range(_JOINTS):
            drive[i] = sendable[i] - bias[i] + (1.0 - share[i]) * gravity[i]
        keep_speed(constants, v, inverse_mass, drive, sendable, previous, period)
    return sendable
