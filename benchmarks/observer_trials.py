"""How the momentum observer answers to pushes of known strength and to motions that touch nothing."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from benchmarks.free_motion import START, FreeMotion
from contact_reach_ros.arm import Arm, Array, JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.safety import RELEASE_DEBOUNCE, SafetySettings
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.simulation.plant import TICK, Actuation, Plant
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings, Scene

MID_ARM = (3, 4, 5)
"""Links that are pushed."""
SCALES = tuple(float(scale) for scale in np.geomspace(0.2, 5.0, 33))
"""Factors on the thresholds of a contact along the ROC curve."""
PUSH_TICKS = 100
"""Length of a push."""
RISE = 1.0 - math.exp(-1.0)
"""Share of a step that a filter of first order has reached after its time constant."""

_BETWEEN_S = (0.5, 1.0)
"""Least and greatest time between pushes, s."""
_EPISODE_S = 60.0
"""Free motion is cut into pieces of this length, each with a hand-over of its own."""


def step_63_error(arm: Arm, joint: int) -> float:
    """By what share of 1/K the residual of a joint takes longer to 63 % of a torque step; the arm is its model."""
    start, settings = np.array(arm.home), ObserverSettings()
    plant = Plant(
        Scene("step", arm, 0, start, np.zeros(3), mismatch=dataclasses.replace(NO_MISMATCH, noise_scale=0.0)),
        friction=(0.0, 0.0),
    )
    plant.set_actuation(Actuation.COMMANDED)
    observer, model = Observer(arm, settings, ContactBudget()), RobotModel(arm)
    observer.update(JointState(0, start, np.zeros(arm.n), np.full(arm.n, np.nan)))
    external = 0.05 * arm.torque_limits[joint] * np.eye(arm.n)[joint]
    shares = [0.0]
    while shares[-1] < RISE:
        q, v = plant.data.qpos[: arm.n].copy(), plant.data.qvel[: arm.n].copy()
        model.update(q, v)
        # Held softly, each joint for itself: what holds it is known, what pushes it is not.
        command = model.bias - model.mass_matrix.diagonal() * (400.0 * (q - start) + 40.0 * v)
        plant.step(command + external)
        observer.update(plant.read()._replace(torque=command))
        shares.append(float(observer.momentum.residual[joint] / external[joint]))
    ticks = len(shares) - 2 + (RISE - shares[-2]) / (shares[-1] - shares[-2])
    return ticks * TICK * settings.momentum.gain - 1.0


@dataclasses.dataclass(frozen=True)
class Push:
    """What was seen of one push.

    Attributes
    ----------
    latency
        From the first step with the force to the state at which a contact was reported, s; NaN if there was none.
    stopped
        Whether it would have stopped the arm.
    link_right
        Whether its link was named right at its end; None if it was not seen.
    exceedance
        (n,) after each step, as `exceedance`.
    """

    latency: float
    stopped: bool
    link_right: bool | None
    exceedance: Array


def push_often(
    arm: Arm,
    strength: float,
    count: int,
    budget: ContactBudget,
    period: float = TICK,
    mismatch: MismatchSettings | None = None,
    settings: ObserverSettings | None = None,
) -> list[Push]:
    """Push the moving arm with `strength` N on random links at mid-arm; it differs from its model by default."""
    mismatch = mismatch or MismatchSettings()
    motion = _started(arm, 0, budget, period, mismatch, settings)
    random = np.random.default_rng(1)
    pushes: list[Push] = []
    while len(pushes) < count:
        pause = motion.plant.time + random.uniform(*_BETWEEN_S)
        while (motion.plant.time < pause or motion.monitor.in_contact) and not motion.controller_stopped:
            motion.tick()
        if motion.controller_stopped:
            motion = _started(arm, len(pushes), budget, period, mismatch, settings)
        else:
            pushes.append(_push(motion, strength, random, period))
    return pushes


def _started(
    arm: Arm,
    seed: int,
    budget: ContactBudget,
    period: float,
    mismatch: MismatchSettings,
    settings: ObserverSettings | None,
) -> FreeMotion:
    """A moving arm after the hand-over."""
    motion = FreeMotion(arm, mismatch, seed, budget, period, settings)
    while motion.plant.time < START or not motion.is_handed_over:
        motion.tick()
    return motion


def _push(motion: FreeMotion, strength: float, random: np.random.Generator, period: float) -> Push:
    plant, monitor = motion.plant, motion.monitor
    apply, link = random_push(plant, strength, random)
    ratios, latency = [], math.nan
    stops = monitor.stops
    for tick in range(round(PUSH_TICKS * TICK / period)):
        apply()
        motion.tick()
        ratios.append(exceedance(motion))
        if monitor.in_contact and math.isnan(latency):
            latency = (tick + 1) * period
    seen = not math.isnan(latency)
    named = motion.observer.locate(motion.state.q).link if seen else None
    plant.data.xfrc_applied[:] = 0.0
    stopped = monitor.stops > stops
    # The arm goes on: a stop does not reach the controller here.
    monitor.stop_reason = ""
    return Push(latency, stopped, named == link if seen else None, np.array(ratios))


def random_push(plant: Plant, strength: float, random: np.random.Generator) -> tuple[Callable[[], None], str]:
    """A force across a random link at mid-arm, and the link's name; call it before each step.

    A frictionless contact is normal to the link's capsule, so its force acts across the axis and through it.
    """
    model, data = plant.model, plant.data
    arm = plant.scene.arm
    capsules = [capsule for capsule in arm.capsules if capsule.link in MID_ARM]
    capsule = capsules[random.integers(len(capsules))]
    link = arm.link_names[capsule.link - 1]
    body = model.body(link).id
    start, end = np.array(capsule.start), np.array(capsule.end)
    local = start + random.uniform() * (end - start)
    along = data.xmat[body].reshape(3, 3) @ (end - start) / np.linalg.norm(end - start)
    force = random.standard_normal(3)
    force -= along * (force @ along)
    force *= strength / np.linalg.norm(force)

    def apply() -> None:
        point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ local
        data.xfrc_applied[body, :3] = force
        data.xfrc_applied[body, 3:] = np.cross(point - data.xipos[body], force)

    return apply, link


def exceedance(motion: FreeMotion) -> float:
    """Largest share of a joint's threshold of a contact that its sudden external torque has."""
    budget = motion.monitor.budget
    limits = np.array(budget.contact_thresholds) + np.array(budget.contact_per_speed) * np.abs(motion.state.v)
    return float((np.abs(motion.monitor.sudden) / limits).max())


@dataclasses.dataclass(frozen=True)
class FreeRun:
    """What was seen although nothing touched the arm.

    Attributes
    ----------
    rms, largest
        (n,) of the external torque, Nm.
    stops
        Reasons of the stops.
    contacts
        How often a contact was reported.
    onsets
        For each of `SCALES`, how often a contact would have been reported with all thresholds scaled by it.
    """

    rms: list[float]
    largest: list[float]
    stops: list[str]
    contacts: int
    onsets: list[int]


def move_freely(
    arm: Arm,
    mismatch: MismatchSettings,
    minutes: float,
    budget: ContactBudget,
    period: float = TICK,
    settings: ObserverSettings | None = None,
) -> FreeRun:
    """Let the arm move for so long; after a stop, and each minute, it begins again."""
    left = round(60.0 * minutes / period)
    squares, largest, states = np.zeros(arm.n), np.zeros(arm.n), 0
    stops: list[str] = []
    onsets = np.zeros(len(SCALES), int)
    contacts = seed = 0
    while left > 0:
        motion = FreeMotion(arm, mismatch, seed, budget, period, settings)
        ratios = []
        for residual in _episode(motion, min(left, round(_EPISODE_S / period))):
            left -= 1
            if not motion.is_handed_over:
                continue
            states += 1
            squares += residual**2
            largest = np.maximum(largest, np.abs(residual))
            ratios.append(exceedance(motion))
        onsets += count_onsets(ratios)
        contacts += motion.monitor.contacts
        if motion.monitor.stopped:
            stops.append(f"seed {seed}, {motion.plant.time:.3f} s: {motion.monitor.stop_reason}")
        elif motion.controller_stopped:
            # Not the observer's fault, but it may not be passed over either.
            stops.append(f"seed {seed}, {motion.plant.time:.3f} s, controller: {motion.controller_stopped}")
        seed += 1
    rms = np.sqrt(squares / max(states, 1))
    return FreeRun(rms.tolist(), largest.tolist(), stops, contacts, onsets.tolist())


def _episode(motion: FreeMotion, ticks: int) -> Iterator[Array]:
    """The residual (n,) of each state until the end or a stop."""
    for _ in range(ticks):
        motion.tick()
        yield motion.observer.momentum.residual
        if motion.monitor.stopped or motion.controller_stopped:
            return


def debounced(ratios: Sequence[float] | Array) -> Array:
    """What each state and those before it, as many as the debounce takes, have all reached."""
    states = SafetySettings().contact_debounce
    padded = np.concatenate([np.zeros(states - 1), np.asarray(ratios, float)])
    return np.lib.stride_tricks.sliding_window_view(padded, states).min(axis=1)


def least_push(pushes: Sequence[Push], strength: float) -> dict[str, float]:
    """The force, N, that would just have been seen: half of the pushes, and 95 % of them, need no more."""
    forces = [strength / debounced(push.exceedance).max() for push in pushes]
    p50, p95 = np.quantile(forces, [0.5, 0.95]).tolist()
    return {"p50": p50, "p95": p95}


def count_onsets(ratios: Sequence[float]) -> Array:
    """For each of `SCALES`, how often it was exceeded again after a pause as long as a contact takes to end."""
    if not ratios:
        return np.zeros(len(SCALES), int)
    reached = debounced(ratios)
    counts = []
    for scale in SCALES:
        (above,) = np.nonzero(reached > scale)
        counts.append(int(above.size > 0) + int((np.diff(above) > RELEASE_DEBOUNCE).sum()))
    return np.array(counts)
