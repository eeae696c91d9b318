"""`contact-reach bench observer`: how soon a push is seen, and how seldom free motion is taken for one."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from contact_reach_ros.errors import InputError
from contact_reach_ros.experiments.free_motion import START, FreeMotion
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.observer.location import ContactLocator
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings
from contact_reach_ros.observer.safety import SafetySettings
from contact_reach_ros.palette import BLUE, GREY, VERMILION
from contact_reach_ros.plant.plant import TICK, Actuation, Plant
from contact_reach_ros.plant.settings import JointSettings, SensorSettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.scene import NO_MISMATCH, MismatchSettings, Scene
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

LATENCY_TARGETS_MS = {"p50": 8.0, "p95": 20.0}
LEVEL = "contact"
"""That detects a push: told at the thresholds of a contact."""
MID_ARM = (3, 4, 5)
"""Links that are pushed."""
PUSH = 50.0
LIGHT_PUSH = 10.0
"""N."""
PUSHES = 300
SCALES = tuple(float(scale) for scale in np.geomspace(0.2, 5.0, 33))
"""Factors on the thresholds of a contact along the ROC curve."""
MAX_MINUTES = 6000.0

_TICK_NS = int(TICK * NANOSECONDS)
_EPISODE_S = 60.0
"""Free motion is cut into pieces of this length, each with a hand-over of its own."""
_MATCHING_MINUTES = 2.0
"""At most, in which the arm is its model: for comparison only."""
_PUSH_TICKS = 100
_BETWEEN_S = (0.5, 1.0)
_PROMPT_MS = LATENCY_TARGETS_MS["p95"]
_RISE = 1.0 - math.exp(-1.0)


def bench_observer(minutes: float, file: Path | None, plot: Path | None) -> dict[str, Any]:
    """Measure, print a table, write JSON to `file` and the ROC curve to `plot`.

    Parameters
    ----------
    minutes
        Simulated free motion in which false stops are counted.

    Raises
    ------
    InputError
        If `minutes` is not above zero and at most `MAX_MINUTES`.
    """
    if not 0.0 < minutes <= MAX_MINUTES:
        raise InputError(f"minutes = {minutes:g}: expected a number above 0, at most {MAX_MINUTES:g}")
    began = time.process_time()
    budget, settings = load_budget(), MomentumSettings()
    steps = [step_63_error(joint, settings) for joint in range(iiwa14.N_JOINTS)]
    pushes = push_often(PUSH, PUSHES, budget)
    light = push_often(LIGHT_PUSH, PUSHES // 2, budget)
    pushed_s = time.process_time() - began
    differing = move_freely(MismatchSettings(), minutes, budget)
    matching = move_freely(NO_MISMATCH, min(minutes, _MATCHING_MINUTES), budget)
    report = {
        "machine": machine(),
        "gain": settings.gain,
        "level": LEVEL,
        "step_63_error": max(steps, key=abs),
        "step_63_error_by_joint": steps,
        "free_rms_nm": {
            "mismatch": differing.rms,
            "matching": matching.rms,
            "max": max(differing.rms),
            "largest_mismatch": differing.largest,
            "largest_matching": matching.largest,
        },
        **_pushed(pushes),
        "light_push": {"force_N": LIGHT_PUSH, **_pushed(light)},
        "minutes": minutes,
        "false_stops": differing.stops,
        "false_stops_per_hour": len(differing.stops) * 60.0 / minutes,
        "false_contacts_per_hour": differing.contacts * 60.0 / minutes,
        "cpu_s": {"steps and pushes": pushed_s, "in all": time.process_time() - began},
        "roc": _roc(pushes, differing, minutes),
    }
    print(_table(report))
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")
    if plot is not None:
        _draw(report["roc"], plot)
    return report


def step_63_error(joint: int, settings: MomentumSettings) -> float:
    """By what share of 1/K the residual of a joint takes longer to 63 % of a torque step; the arm is its model."""
    start = np.array(iiwa14.HOME_POSITION)
    plant = Plant(
        Scene("step", 0, start, np.zeros(3)),
        SensorSettings(position_noise=0.0, position_resolution=0.0, velocity_noise=0.0, torque_noise=0.0),
        JointSettings(viscous_friction=0.0, coulomb_friction=0.0),
    )
    plant.set_actuation(Actuation.COMMANDED)
    observer, model = MomentumObserver(settings, RobotModel()), RobotModel()
    observer.update(start, np.zeros(iiwa14.N_JOINTS), None, 0)
    external = 0.05 * iiwa14.TORQUE_LIMITS[joint] * np.eye(iiwa14.N_JOINTS)[joint]
    shares = [0.0]
    while shares[-1] < _RISE:
        arm = slice(0, iiwa14.N_JOINTS)
        q, v = plant.data.qpos[arm].copy(), plant.data.qvel[arm].copy()
        model.update(q, v)
        # Held softly, each joint for itself: what holds it is known, what pushes it is not.
        command = model.bias - model.mass_matrix.diagonal() * (400.0 * (q - start) + 40.0 * v)
        plant.step(command + external)
        reading = plant.read()
        residual = observer.update(reading.position, reading.velocity, command, plant.steps * _TICK_NS)
        shares.append(float(residual[joint] / external[joint]))
    ticks = len(shares) - 2 + (_RISE - shares[-2]) / (shares[-1] - shares[-2])
    return ticks * TICK * settings.gain - 1.0


@dataclasses.dataclass(frozen=True)
class Push:
    """What was seen of one push.

    Attributes
    ----------
    latency
        From the first step with the force to the state that told a contact, s; NaN if none did.
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


def push_often(strength: float, count: int, budget: ContactBudget) -> list[Push]:
    """Push the moving arm, which differs from its model, with `strength` N on random links at mid-arm."""
    motion = _started(0, budget)
    locator = ContactLocator(RobotModel(), budget.contact_thresholds)
    random = np.random.default_rng(1)
    pushes: list[Push] = []
    while len(pushes) < count:
        pause = motion.plant.time + random.uniform(*_BETWEEN_S)
        while (motion.plant.time < pause or motion.monitor.in_contact) and not motion.controller_stopped:
            motion.tick()
        if motion.controller_stopped:
            motion = _started(len(pushes), budget)
        else:
            pushes.append(_push(motion, locator, strength, random, budget))
    return pushes


def _started(seed: int, budget: ContactBudget) -> FreeMotion:
    """An arm that differs from its model, after the hand-over."""
    motion = FreeMotion(MismatchSettings(), seed, budget)
    while motion.plant.time < START:
        motion.tick()
    return motion


def _push(
    motion: FreeMotion, locator: ContactLocator, strength: float, random: np.random.Generator, budget: ContactBudget
) -> Push:
    plant, monitor = motion.plant, motion.monitor
    apply, link = _random_push(plant, strength, random)
    ratios, latency = [], math.nan
    stops = monitor.stops
    for tick in range(_PUSH_TICKS):
        apply()
        motion.tick()
        ratios.append(exceedance(motion, budget))
        if monitor.in_contact and math.isnan(latency):
            latency = (tick + 1) * TICK
    seen = not math.isnan(latency)
    named = locator.locate(motion.position, monitor.sudden).link if seen else None
    plant.data.xfrc_applied[:] = 0.0
    stopped = monitor.stops > stops
    # The arm goes on: a stop does not reach the controller here.
    monitor.stop_reason = ""
    return Push(latency, stopped, named == link if seen else None, np.array(ratios))


def _random_push(plant: Plant, strength: float, random: np.random.Generator) -> tuple[Callable[[], None], str]:
    """A force across a random link at mid-arm, and the link's name; call it before each step.

    A frictionless contact is normal to the link's capsule, so its force acts across the axis and through it.
    """
    model, data = plant.model, plant.data
    capsules = [capsule for capsule in iiwa14.CAPSULES if capsule.link in MID_ARM]
    capsule = capsules[random.integers(len(capsules))]
    link = iiwa14.LINK_NAMES[capsule.link - 1]
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


def exceedance(motion: FreeMotion, budget: ContactBudget) -> float:
    """Largest share of a joint's threshold of a contact that its sudden external torque has."""
    limits = np.array(budget.contact_thresholds) + np.array(budget.contact_per_speed) * np.abs(motion.velocity)
    return float((np.abs(motion.monitor.sudden) / limits).max())


@dataclasses.dataclass(frozen=True)
class FreeRun:
    """What was seen although nothing touched the arm.

    Attributes
    ----------
    rms, largest
        Of the external torque, 7 values, Nm.
    stops
        Reasons of the stops.
    contacts
        How often a contact was told.
    onsets
        For each of `SCALES`, how often a contact would have been told with all thresholds scaled by it.
    """

    rms: list[float]
    largest: list[float]
    stops: list[str]
    contacts: int
    onsets: list[int]


def move_freely(mismatch: MismatchSettings, minutes: float, budget: ContactBudget) -> FreeRun:
    """Let the arm move for so long; after a stop, and each minute, it begins anew."""
    left = round(60.0 * minutes / TICK)
    squares, largest, states = np.zeros(iiwa14.N_JOINTS), np.zeros(iiwa14.N_JOINTS), 0
    stops: list[str] = []
    onsets = np.zeros(len(SCALES), int)
    contacts = seed = 0
    while left > 0:
        motion = FreeMotion(mismatch, seed, budget)
        ratios = []
        for residual in _episode(motion, min(left, round(_EPISODE_S / TICK))):
            left -= 1
            if motion.observer.known_for < budget.handover_time:
                continue
            states += 1
            squares += residual**2
            largest = np.maximum(largest, np.abs(residual))
            ratios.append(exceedance(motion, budget))
        onsets += _onsets(ratios)
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
    """The residual (7,) of each state until the end or a stop."""
    for _ in range(ticks):
        motion.tick()
        yield motion.observer.residual
        if motion.monitor.stopped or motion.controller_stopped:
            return


def _debounced(ratios: Sequence[float] | Array) -> Array:
    """What each state and those before it, as many as the debounce takes, have all reached."""
    states = SafetySettings().contact_debounce
    padded = np.concatenate([np.zeros(states - 1), np.asarray(ratios, float)])
    return np.lib.stride_tricks.sliding_window_view(padded, states).min(axis=1)


def _onsets(ratios: Sequence[float]) -> Array:
    """For each of `SCALES`, how often it was exceeded anew, after a pause as long as a contact takes to end."""
    if not ratios:
        return np.zeros(len(SCALES), int)
    reached = _debounced(ratios)
    counts = []
    for scale in SCALES:
        (above,) = np.nonzero(reached > scale)
        counts.append(int(above.size > 0) + int((np.diff(above) > SafetySettings().release_debounce).sum()))
    return np.array(counts)


def _pushed(pushes: Sequence[Push]) -> dict[str, Any]:
    latencies = np.array([1e3 * push.latency for push in pushes])
    seen = latencies[np.isfinite(latencies)]
    named = [push.link_right for push in pushes if push.link_right is not None]
    quantiles = np.quantile(seen, [0.5, 0.95, 1.0]).tolist() if seen.size else [math.nan] * 3
    return {
        "pushes": len(pushes),
        "detection_latency_ms": dict(zip(("p50", "p95", "max"), quantiles, strict=True)),
        "missed_contacts": int(len(pushes) - seen.size),
        "stopped_share": float(np.mean([push.stopped for push in pushes])),
        "link_right_share": float(np.mean(named)) if named else math.nan,
    }


def _roc(pushes: Sequence[Push], free: FreeRun, minutes: float) -> dict[str, list[float]]:
    """Pushes seen promptly and contacts told falsely, over factors on the thresholds of a contact."""
    prompt = round(1e-3 * _PROMPT_MS / TICK)
    peaks = np.array([_debounced(push.exceedance[:prompt]).max() for push in pushes])
    return {
        "scale": list(SCALES),
        "seen_share": [float((peaks > scale).mean()) for scale in SCALES],
        "false_contacts_per_hour": [count * 60.0 / minutes for count in free.onsets],
    }


def _table(report: dict[str, Any]) -> str:
    rms, largest = report["free_rms_nm"], report["free_rms_nm"]
    latency, light = report["detection_latency_ms"], report["light_push"]
    targets = ", ".join(f"{name} {value:g}" for name, value in LATENCY_TARGETS_MS.items())

    def joints(values: Sequence[float]) -> str:
        return "".join(f"{value:7.2f}" for value in values)

    return "\n".join(
        [
            f"time to {100 * _RISE:.0f} % of a step less 1/K: largest {100 * report['step_63_error']:+.1f} % of it",
            f"free motion, A1 to A7, Nm         {joints(rms['mismatch'])}  rms with mismatch",
            f"                                  {joints(largest['largest_mismatch'])}  largest with mismatch",
            f"                                  {joints(rms['matching'])}  rms when the arm is its model",
            f"                                  {joints(largest['largest_matching'])}  largest",
            f"{report['pushes']} pushes of {PUSH:g} N at mid-arm, level {LEVEL}: latency ms "
            f"p50 {latency['p50']:.1f}  p95 {latency['p95']:.1f}  max {latency['max']:.1f} (targets: {targets}); "
            f"{report['missed_contacts']} missed; link right {100 * report['link_right_share']:.0f} %; "
            f"{100 * report['stopped_share']:.0f} % would stop the arm",
            f"{light['pushes']} pushes of {LIGHT_PUSH:g} N: latency ms p50 {light['detection_latency_ms']['p50']:.1f}; "
            f"{light['missed_contacts']} missed within {_PUSH_TICKS * 1e3 * TICK:.0f} ms; "
            f"{100 * light['stopped_share']:.0f} % would stop the arm",
            f"{report['minutes']:g} min of free motion with mismatch: {len(report['false_stops'])} false stops, "
            f"{report['false_stops_per_hour']:.1f} per hour; {report['false_contacts_per_hour']:.1f} false contacts "
            f"per hour; CPU time in all {report['cpu_s']['in all']:.0f} s",
            *report["false_stops"],
        ]
    )


def _draw(roc: dict[str, list[float]], file: Path) -> None:
    figure = Figure(figsize=(9.0, 4.0), dpi=130)
    over_scale, curve = figure.subplots(1, 2)
    over_scale.semilogx(roc["scale"], roc["seen_share"], color=BLUE)
    over_scale.set_xlabel("factor on the thresholds of a contact")
    over_scale.set_ylabel(f"pushes of {PUSH:g} N seen within {_PROMPT_MS:g} ms", color=BLUE)
    ticks = [0.2, 0.5, 1.0, 2.0, 5.0]
    over_scale.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    over_scale.set_xticks([], minor=True)
    over_scale.axvline(1.0, color=GREY, linestyle=":")
    false = over_scale.twinx()
    false.semilogx(roc["scale"], roc["false_contacts_per_hour"], color=VERMILION)
    false.set_ylabel("false contacts per hour", color=VERMILION)
    false.set_yscale("symlog", linthresh=1.0)
    curve.plot(roc["false_contacts_per_hour"], roc["seen_share"], color=BLUE, marker=".")
    at = int(np.argmin(np.abs(np.log(roc["scale"]))))
    curve.plot(
        roc["false_contacts_per_hour"][at], roc["seen_share"][at], "o", color=VERMILION, label="contact budget as it is"
    )
    curve.set_xscale("symlog", linthresh=1.0)
    curve.set_xlabel("false contacts per hour of free motion")
    curve.set_ylabel(f"pushes of {PUSH:g} N seen within {_PROMPT_MS:g} ms")
    curve.legend(loc="lower right", frameon=False)
    for panel in (over_scale, curve):
        panel.grid(True, color="#dddddd", linewidth=0.6)
    figure.tight_layout()
    FigureCanvasAgg(figure)
    try:
        figure.savefig(file)
    except (OSError, ValueError) as error:
        raise InputError(f"plot '{file}' cannot be written: {error}") from error
