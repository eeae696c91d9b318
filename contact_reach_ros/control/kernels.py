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
from numba import float64, int64

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
    REPULSION_STRENGTH = 7
    REPULSION_DAMPING = 8
    TORQUE_CAP = 9
    TORQUE_RATE = 10
    GRAVITY_SHARE = 11
    STOP_RATE = 12
    TASK_ROWS = 13
    TIP_FORCE = 14
    BODY_SPEED = 15
    JOINT_SPEED = 16
    IMPACT_ENERGY = 17
    TORQUE_DELAY = 18
    HOLD = 19


_POSITION_ROWS, _AXIS_ROWS = 3, 5
"""`TASK_ROWS` of translation alone, and of translation and the direction of the tip's z axis."""

_APPROACH = 0.2
"""Speed towards a position limit at which half of the repulsion stops the joint, whatever the caps say, rad/s."""
_REPULSION = 250.0
"""Acceleration by the repulsion at a position limit, rad/s²: law (1) asks for less within its bounds."""
REPULSION_MARGIN = 0.04
"""Distance to a position limit at which repulsion begins, rad: a fast joint needs it to come to rest."""
_POSTURE_REACH = 0.25
"""Distance of a joint from its reference posture beyond which law (2) pulls no harder, rad: plans ask for less."""

FADE = 0.15
"""Share of the permitted speed within which the push of the laws fades beyond it."""
FADE_SHARE = 0.5
"""Share of the speed that its cap may take within the delay of the torques: with the damping of the laws, more than
2 is unstable."""

_CALMING = 10.0
"""By how much sooner after a start than the push all that does not push has full authority: what a stop held must not
fall, and the first torque is that of gravity to the last bit."""
_HEAVIEST = 200.0
"""Mass, kg, that counts for a point at most: heavier ones are so near a joint's axis that they have hardly any way, and
would hold the whole arm. With 250, three times the usual friction slows the arm down."""
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
def fill(target: Array, values: Array) -> None:
    """Overwrite a vector with another one; Numba takes seconds to compile an assignment of arrays."""
    for i in range(len(values)):
        target[i] = values[i]


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


@_compiled(_RESULT, _VECTOR, _MATRIX, _VECTOR, _MATRIX, int64)
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


@_compiled()
def solve_bounded(matrix: Array, vectors: Array, floor: float) -> Array:
    """A⁻¹ b for each row b of `vectors` (k, m) and a symmetric positive semi-definite A.

    The norm of the inverse stays at or below 2 / floor. Eigenvalues of at least `floor` are inverted exactly, so that
    it is the true inverse away from singularities. Smaller ones are lifted to floor/2 · (1 + (s/floor)²), which meets s
    with the same slope at the floor: the result is continuously differentiable in the matrix.
    """
    solutions = np.zeros(vectors.shape)
    # The shifted factor exists exactly when all eigenvalues are above the floor, and costs far less than they do.
    if factorise(matrix, floor)[1]:
        factor = factorise(matrix, 0.0)[0]
        for row in range(len(vectors)):
            fill(solutions[row], solve_upper(factor, solve_lower(factor, vectors[row])))
        return solutions
    values, axes = np.linalg.eigh(matrix)
    for i in range(len(values)):
        value = values[i]
        if value < floor:
            share = max(value, 0.0) / floor
            value = 0.5 * floor * (1.0 + share * share)
        parts = times(vectors, axes[:, i])
        for row in range(len(vectors)):
            for k in range(len(values)):
                solutions[row, k] += axes[k, i] * parts[row] / value
    return solutions


@_compiled()
def joint_frames(placements: Array, q: Array) -> tuple[Array, Array]:
    """Rotations (n, 3, 3) and origins (n, 3), m, of the joints' frames, from the placements of `constants.Body`."""
    n = len(q)
    rotations, origins = np.empty((n, 3, 3)), np.empty((n, 3))
    rotation, placed, origin = np.zeros((3, 3)), np.empty((3, 3)), np.zeros(3)
    for row in range(3):
        rotation[row, row] = 1.0
    for i in range(n):
        cosine, sine = np.cos(q[i]), np.sin(q[i])
        for row in range(3):
            for column in range(4):
                total = 0.0
                for k in range(3):
                    total += rotation[row, k] * placements[3 * i + k, column]
                if column < 3:
                    placed[row, column] = total
                else:
                    origin[row] += total
        for row in range(3):
            rotation[row, 0] = cosine * placed[row, 0] + sine * placed[row, 1]
            rotation[row, 1] = cosine * placed[row, 1] - sine * placed[row, 0]
            rotation[row, 2] = placed[row, 2]
            fill(rotations[i, row], rotation[row])
        fill(origins[i], origin)
    return rotations, origins


@_compiled()
def point_jacobian(rotations: Array, origins: Array, link: int, point: Array) -> Array:
    """J_pᵀ (n, 3) of a point (3,), m, in the frame of a joint that moves it."""
    n = len(origins)
    rows, lever = np.zeros((n, 3)), np.empty(3)
    for i in range(link + 1):
        for row in range(3):
            lever[row] = origins[link, row] - origins[i, row]
            for k in range(3):
                lever[row] += rotations[link, row, k] * point[k]
        for row in range(3):
            j, k = (row + 1) % 3, (row + 2) % 3
            rows[i, row] = rotations[i, j, 2] * lever[k] - rotations[i, k, 2] * lever[j]
    return rows


@_compiled()
def mobility_of(rows: Array, mass_factor: Array) -> Array:
    """W = J_p M⁻¹ J_pᵀ (3, 3), 1/kg, of a point; a little more, so that it has an inverse."""
    n = len(rows)
    solved, column, mobility = np.empty((3, n)), np.empty(n), np.empty((3, 3))
    for row in range(3):
        for i in range(n):
            column[i] = rows[i, row]
        fill(solved[row], solve_lower(mass_factor, column))
        for k in range(row + 1):
            total = 0.0
            for i in range(n):
                total += solved[row, i] * solved[k, i]
            mobility[row, k] = mobility[k, row] = total
        mobility[row, row] += 1e-9
    return mobility


@_compiled()
def inverse_of(matrix: Array) -> Array:
    """Inverse of a symmetric matrix (3, 3), by its cofactors."""
    inverse, determinant = np.empty((3, 3)), 0.0
    for row in range(3):
        i, j = (row + 1) % 3, (row + 2) % 3
        for column in range(3):
            k, m = (column + 1) % 3, (column + 2) % 3
            inverse[row, column] = matrix[i, k] * matrix[j, m] - matrix[i, m] * matrix[j, k]
    for k in range(3):
        determinant += matrix[0, k] * inverse[0, k]
    for row in range(3):
        for column in range(3):
            inverse[row, column] /= determinant
    return inverse


@_compiled()
def dot(first: Array, second: Array) -> float:
    """Scalar product of two vectors (3,)."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@_compiled()
def norm(vector: Array) -> float:
    """Length of a vector (3,)."""
    return np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@_compiled()
def pressing_share(push: Array, drag: Array, mobility: Array, most: float) -> float:
    """Share s, 0 to 1, of a push with which a smooth body feels at most `most`, however its surface is turned.

    A surface with normal n that stops a point, accelerated by a, feels nᵀa / nᵀWn. That is at most √(aᵀW⁻¹a λ) by the
    greatest eigenvalue λ of W⁻¹, and λ at most the mean of the three plus √2 times their deviation: exact for a push
    along the one heavy direction, or where all are equal, and elsewhere at most about twice too much. Of the damping
    counts as much, from nothing to all, as relieves most: a = s push + r drag.

    Parameters
    ----------
    push, drag
        Accelerations (3,) of the point by driving and by damping, m/s².
    mobility
        W (3, 3), 1/kg.
    most
        N.
    """
    inverse, squares = inverse_of(mobility), 0.0
    for row in range(3):
        squares += dot(inverse[row], inverse[row])
    mean = (inverse[0, 0] + inverse[1, 1] + inverse[2, 2]) / 3.0
    limit = most * most / (mean + 2.0 * np.sqrt(max(squares / 6.0 - 0.5 * mean * mean, 0.0)))
    pressing = times(inverse, push)
    square, product, rest = dot(push, pressing), min(dot(drag, pressing), 0.0), dot(drag, times(inverse, drag))
    # With part of the damping; all of it is not enough where the share is greater.
    across = max(square - product * product / max(rest, 1e-12), 0.0)
    if product == 0.0 or limit * product * product <= across * rest * rest:
        return min(np.sqrt(limit / max(across, 1e-12)), 1.0)
    return min((np.sqrt(product * product - square * (rest - limit)) - product) / square, 1.0)


@_compiled()
def faded(speed_share: float, driving: float, braking: float, delay: float, ending: float) -> float:
    """Share p of the driving torque that is left: 0 where the push would end at a speed of 1 + `FADE`.

    The push ends after t = delay + p ending, in which the speed rises by t (p driving + braking): a quadratic equation.
    Where push and damping are in balance, the speed does not depend on these times.

    Parameters
    ----------
    speed_share
        The speed, as a share of the permitted one.
    driving, braking
        By how much driving and damping raise that share, 1/s.
    delay, ending
        Time until the torques change, and half of that in which they take the whole push away, s.
    """
    rise, left = max(driving, 0.0), 1.0 + FADE - speed_share
    drag = min(max(-braking, 0.0), rise)
    linear = FADE + delay * rise - ending * drag
    constant = left + delay * drag
    if constant <= 0.0:
        return 0.0
    return 2.0 * constant / (linear + np.sqrt(linear**2 + 4.0 * ending * rise * constant))


@_compiled()
def body_shares(
    constants: Array,
    placements: Array,
    links: Array,
    points: Array,
    q: Array,
    v: Array,
    mass_factor: Array,
    driving: Array,
    braking: Array,
) -> tuple[float, float]:
    """Greatest speed as a share of the permitted one, and the share of the driving torque that is permitted.

    The speed is that of joints and points, or by the energy ½ ẋᵀ W⁻¹ ẋ, the most that a surface takes up that stops a
    point. The force is the most that a body feels that blocks a point, see `pressing_share`; but what a start accepts
    may always be held: a push within the hand-over limits of all joints is permitted.

    Parameters
    ----------
    placements, links, points
        Attributes of `constants.Body`.
    q, v
        (n,), rad and rad/s.
    mass_factor
        Cholesky factor L of M, (n, n).
    driving
        Torque (n,), N m, of the stiffness of both laws and of the push away from limits.
    braking
        Torque (n,), N m, of damping.
    """
    speed_share, share, most = 0.0, 1.0, constants[Constant.TIP_FORCE, 0]
    delay = constants[Constant.TORQUE_DELAY, 0] / FADE_SHARE
    ending, holding = 0.0, 1.0
    for i in range(len(q)):
        torque = abs(driving[i])
        ending = max(ending, 0.5 * torque / constants[Constant.TORQUE_RATE, i])
        holding = min(holding, constants[Constant.HOLD, i] / max(torque, 1e-9))
    speeding = solve_upper(mass_factor, solve_lower(mass_factor, driving))
    slowing = solve_upper(mass_factor, solve_lower(mass_factor, braking))
    for i in range(len(q)):
        to_share = np.sign(v[i]) / constants[Constant.JOINT_SPEED, i]
        part = abs(v[i]) / constants[Constant.JOINT_SPEED, i]
        speed_share = max(speed_share, part)
        share = min(share, faded(part, to_share * speeding[i], to_share * slowing[i], delay, ending))
    rotations, origins = joint_frames(placements, q)
    for index in range(len(links)):
        rows = point_jacobian(rotations, origins, int(links[index]), points[index])
        motion, push, drag = times(rows.T, v), times(rows.T, speeding), times(rows.T, slowing)
        mobility = mobility_of(rows, mass_factor)
        speed = norm(motion)
        if speed > 1e-3:
            momentum = times(inverse_of(mobility), motion)
            energy = 0.5 * dot(motion, momentum)
            part, hard = (
                speed / constants[Constant.BODY_SPEED, 0],
                np.sqrt(energy / constants[Constant.IMPACT_ENERGY, 0]),
            )
            rises, slows = dot(motion, push) / speed**2, dot(motion, drag) / speed**2
            if hard > part:
                part, rises, slows = hard, 0.5 * dot(momentum, push) / energy, 0.5 * dot(momentum, drag) / energy
            speed_share = max(speed_share, part)
            share = min(share, faded(part, part * rises, part * slows, delay, ending))
        if share > holding and norm(push) > 1e-3:
            for row in range(3):
                mobility[row, row] += 1.0 / _HEAVIEST
            share = min(share, max(pressing_share(push, drag, mobility, most), holding))
    return speed_share, max(share, 0.0)


@_compiled()
def law_torques(
    constants: Array,
    mass_factor: Array,
    jacobian: Array,
    twist: Array,
    drift: Array,
    error: Array,
    posture_error: Array,
    v: Array,
) -> tuple[Array, Array, Array]:
    """τ of law (3) without the C + g of law (1) as the sum of three torques (n,), N m: stiffness, damping, and drift.

    (1) + (2) as Jᵀ Λ (ẍ_cmd − J M⁻¹ τ₀) + τ₀, since Nᵀ = I − Jᵀ Λ J M⁻¹.

    Parameters
    ----------
    mass_factor
        Cholesky factor L of M, (n, n).
    jacobian, twist, drift
        J (m, n), ẋ (m,) and J̇ q̇ (m,).
    error
        Δx, (m,).
    posture_error, v
        Δq (n,), rad, and q̇ (n,), rad/s. q_d = 0 makes law (2) that of law (6).
    """
    m, n = jacobian.shape
    # J M⁻¹ Jᵀ = Y Yᵀ with Y = J L⁻ᵀ, and J M⁻¹ τ₀ = Y L⁻¹ τ₀.
    rows = np.empty((m, n))
    for row in range(m):
        fill(rows[row], solve_lower(mass_factor, jacobian[row]))
    mobility = np.empty((m, m))
    for row in range(m):
        for column in range(row + 1):
            product = 0.0
            for k in range(n):
                product += rows[row, k] * rows[column, k]
            mobility[row, column] = mobility[column, row] = product
    driving = -constants[Constant.NULL_STIFFNESS] * posture_error
    braking = -constants[Constant.NULL_DAMPING] * v
    pull, drag = times(rows, solve_lower(mass_factor, driving)), times(rows, solve_lower(mass_factor, braking))
    wanted = np.empty((3, m))
    for row in range(m):
        wanted[0, row] = -constants[Constant.TASK_STIFFNESS, 0] * error[row] - pull[row]
        wanted[1, row] = -constants[Constant.TASK_DAMPING, 0] * twist[row] - drag[row]
        wanted[2, row] = -drift[row]
    wrenches = solve_bounded(mobility, wanted, constants[Constant.SINGULARITY_FLOOR, 0])
    driving += times(jacobian.T, wrenches[0])
    braking += times(jacobian.T, wrenches[1])
    return driving, braking, times(jacobian.T, wrenches[2])


@_compiled()
def repulsion_torques(constants: Array, mass_matrix: Array, q: Array, v: Array) -> tuple[Array, Array]:
    """Torques (n,) in N m that push joints out of a margin before their position limits, and that brake them there.

    The sum grows with the square of the depth, so that it starts without a step. At the position limit it is the given
    share of the joint's torque limit, or what accelerates the joint with `_REPULSION`. It brakes a joint that
    approaches the limit, with damping that grows in the same way, and pushes one that does not: that push is one of
    those that the caps bound.
    """
    n = len(q)
    lower, upper = constants[Constant.LOWER_THRESHOLD], constants[Constant.UPPER_THRESHOLD]
    strength, damping = constants[Constant.REPULSION_STRENGTH], constants[Constant.REPULSION_DAMPING]
    pushing, stopping = np.zeros(n), np.zeros(n)
    for i in range(n):
        side = 1.0 if q[i] - upper[i] >= lower[i] - q[i] else -1.0
        depth = min(max(q[i] - upper[i], lower[i] - q[i]) / REPULSION_MARGIN, 1.5)
        if depth > 0.0:
            approach = max(side * v[i], 0.0)
            share = approach / (approach + _APPROACH)
            spring = min(strength[i], _REPULSION * mass_matrix[i, i]) * depth
            pushing[i] = -side * depth * spring * (1.0 - share)
            stopping[i] = -side * depth * (spring * share + damping[i] * approach)
    return pushing, stopping


@_compiled(_RESULT, _MATRIX, _VECTOR, _VECTOR, float64)
def limit_torque(constants: Array, torque: Array, previous: Array, period: float) -> Array:
    """Limit the torque (n,), N m, that follows `previous` after `period` seconds: to caps and rates; caps win.

    All joints advance by the same share of their change. If only the joints beyond their rate were held back, the
    torques would change their direction and drive the arm where nothing wants it. All NaN where `torque` is not finite.
    """
    n = len(torque)
    rate, cap = constants[Constant.TORQUE_RATE], constants[Constant.TORQUE_CAP]
    limited, share, total = np.empty(n), 1.0, 0.0
    for i in range(n):
        total += torque[i]
        limited[i] = min(max(torque[i], -cap[i]), cap[i])
        way, step = abs(limited[i] - previous[i]), rate[i] * period
        if way > step:
            share = min(share, step / way)
    if not np.isfinite(total):
        return np.full(n, np.nan)
    for i in range(n):
        if share < 1.0:
            limited[i] = previous[i] + share * (limited[i] - previous[i])
        limited[i] = min(max(limited[i], -cap[i]), cap[i])
    return limited


@_compiled(_RESULT, _VECTOR, _VECTOR, _MATRIX)
def yielded(tension: Array, most: Array, compliance: Array) -> Array:
    """The tension (n,), N m, of a spring after it has yielded: within `most` (n,) in each joint.

    Of all tensions within, the nearest one in the norm of the stored energy ½ τᵀ K⁻¹ τ, which therefore does not grow:
    associated plasticity. Coordinate descent from the clipped tension; `compliance` is K⁻¹ (n, n), rad/(N m).
    """
    n = len(tension)
    found = np.minimum(np.maximum(tension, -most), most)
    for _ in range(_YIELD_SWEEPS):
        for i in range(n):
            slope = 0.0
            for k in range(n):
                slope += compliance[i, k] * (found[k] - tension[k])
            found[i] = min(max(found[i] - slope / compliance[i, i], -most[i]), most[i])
    return found


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
        Share of the push that is permitted, see `_CALMING`.
    previous, period
        The last torque sent (n,), N m, and the time since then, s.
    found
        (7,), overwritten with Δx as `pose_error` gives it, and the greatest share of `body_shares`.
    """
    n, task_rows = len(v), int(constants[Constant.TASK_ROWS, 0])
    deviation = pose_error(position, rotation, reference_position, reference_rotation, task_rows)
    fill(found, deviation)
    rows = controlled(np.column_stack((jacobian, twist, drift, deviation)), rotation, task_rows)
    factor, regular = factorise(mass_matrix, 0.0)
    if not regular:
        return np.full(n, np.nan)
    posture_error = np.empty(n)
    for i in range(n):
        posture_error[i] = min(max(q[i] - reference_posture[i], -_POSTURE_REACH), _POSTURE_REACH)
    driving, braking, rest = law_torques(
        constants, factor, rows[:, :n], rows[:, n], rows[:, n + 1], rows[:, n + 2], posture_error, v
    )
    pushing, stopping = repulsion_torques(constants, mass_matrix, q, v)
    for i in range(n):
        driving[i] += pushing[i]
    found[6], push = body_shares(constants, placements, links, points, q, v, factor, driving, braking)
    torque, share = np.empty(n), constants[Constant.GRAVITY_SHARE]
    push, calming = authority * push, min(_CALMING * authority, 1.0)
    for i in range(n):
        torque[i] = push * driving[i] + share[i] * gravity[i]
        torque[i] += calming * (braking[i] + rest[i] + stopping[i] + bias[i] - gravity[i])
    return limit_torque(constants, torque, previous, period)
