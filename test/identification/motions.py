"""Motions of an arm whose torques are known exactly: sums of sines through Pinocchio's inverse dynamics."""

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.identification.recording import Recording, Samples
from contact_reach_ros.observer.settings import COULOMB_SPEED, MomentumSettings

ARM = load_arm()
MOMENTUM = MomentumSettings().resolve(ARM)
COULOMB, VISCOUS, OFFSET = np.linspace(0.2, 0.8, 7), np.linspace(1.0, 0.4, 7), np.linspace(-0.3, 0.3, 7)


def motion(seconds: float, period: float, seed: int = 0, joints=range(ARM.n)) -> tuple[np.ndarray, ...]:
    """Times, positions, velocities and accelerations of these joints about home; the others rest."""
    random = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, period)
    q = np.tile(np.array(ARM.home), (len(times), 1))
    v, a = np.zeros_like(q), np.zeros_like(q)
    for joint in joints:
        for rate in random.uniform(0.5, 2.5, 3):
            size, phase = random.uniform(0.1, 0.25), random.uniform(0.0, 6.3)
            q[:, joint] += size * np.sin(rate * times + phase)
            v[:, joint] += size * rate * np.cos(rate * times + phase)
            a[:, joint] -= size * rate**2 * np.sin(rate * times + phase)
    return times, q, v, a


def torques(arm: Arm, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """What moves this arm, with the friction and the offsets above."""
    model = RobotModel(arm).pinocchio
    data = model.createData()
    rigid = np.array([pin.rnea(model, data, *state).copy() for state in zip(q, v, a, strict=True)])
    return rigid + COULOMB * np.tanh(v / COULOMB_SPEED) + VISCOUS * v + OFFSET


def recording(arm: Arm, seconds: float, period: float = 0.004, noise: float = 0.02) -> Recording:
    """The states of such a motion."""
    times, q, v, a = motion(seconds, period)
    measured = torques(arm, q, v, a) + noise * np.random.default_rng(0).standard_normal(q.shape)
    return Recording(np.rint(1e9 * times).astype(np.int64), q, v, measured)


def samples(arm: Arm, seconds: float, seed: int = 0, joints=range(ARM.n)) -> Samples:
    """Samples of such a motion without noise, 50 a second."""
    _, q, v, a = motion(seconds, 0.02, seed, joints)
    direction, moves = np.tanh(v / COULOMB_SPEED), np.abs(v) > 0.05
    return Samples(q, v, a, torques(arm, q, v, a), direction, moves, np.zeros(len(q), int))
