"""Vibration of the commanded torques that reaches the gears, and jerk of the tip."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt, welch

from benchmarks.output import Report, command_line, given, machine, run_command, say, table, write_report
from benchmarks.workers import run_each
from contact_reach_ros.arm import Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import DEFAULT_ARM, load_arm
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.goal import Goal
from contact_reach_ros.world.scene_file import read_scene

SCENES = ("free", "ball", "wall")
BANDS = ((20.0, 50.0), (50.0, 150.0), (20.0, 500.0))
"""Of the commanded torque, Hz: above 20 Hz it moves gears and not the arm."""
_CUT_OFF = 20.0
"""Of the tip's motion, Hz: beyond it the third derivative is that of the numbers' last digits."""
_EDGE = 100
"""Samples at either end at which the filter has too little to go by."""


class Case(NamedTuple):
    """One run."""

    scene: str
    seed: int
    ramp: float
    """`ImpedanceSettings.reference_ramp`, s."""
    arm: str = DEFAULT_ARM
    """Name of an arm, or path of its file."""


def jerk_rms(position: Array) -> float:
    """RMS of the third derivative of positions (k, 3), m, one each ms, up to 20 Hz: m/s³."""
    smooth = sosfiltfilt(butter(4, _CUT_OFF, fs=1.0 / TICK, output="sos"), position, axis=0)
    jerk = np.diff(smooth, 3, axis=0)[_EDGE:-_EDGE] / TICK**3
    return float(np.sqrt(np.square(jerk).sum(axis=1).mean()))


def band_rms(torque: Array, low: float, high: float) -> list[float]:
    """RMS of torques (k, n), N m, one each ms, between two frequencies, Hz, for each joint."""
    frequency, density = welch(torque, 1.0 / TICK, nperseg=min(1024, len(torque)), axis=0, detrend="linear")
    inside = (frequency >= low) & (frequency < high)
    rms: list[float] = np.sqrt(density[inside].sum(axis=0) * frequency[1]).tolist()
    return rms


def run_smoothness(case: Case) -> Report:
    """Reach a scene's goal once."""
    arm = load_arm(case.arm)
    scene = make_scene(read_scene(case.scene), arm, case.seed)
    robot = SimulatedRobot(scene, noise_seed=case.seed)
    settings = ControllerSettings(impedance=ImpedanceSettings(reference_ramp=case.ramp))
    stack = Stack(scene, robot=robot, controller=settings, seed=case.seed)
    model, data = RobotModel(arm), robot.plant.data
    torques: list[Array] = []
    tips: list[Array] = []

    def watch(tick: object) -> None:
        torque = getattr(tick, "torque", None)
        if torque is not None:
            torques.append(torque)
        tips.append(model.tip_pose(data.qpos[: arm.n])[0].copy())

    result = stack.run(Goal(scene.target), watch=watch)
    torque = np.array(torques)
    return {
        **case._asdict(),
        "reached": result.reached,
        "duration_s": result.duration,
        "largest_force_N": result.max_contact_force,
        "torque_rms_Nm": {f"{low:g}-{high:g} Hz": band_rms(torque, low, high) for low, high in BANDS},
        "largest_step_Nm": np.abs(np.diff(torque, axis=0)).max(axis=0).tolist(),
        "jerk_rms_m_s3": jerk_rms(np.array(tips)),
    }


def bench_smoothness(
    scenes: Sequence[str] = SCENES,
    seeds: int = 10,
    seed: int = 0,
    ramps: Sequence[float] = (0.0, ImpedanceSettings().reference_ramp),
    arm: str = DEFAULT_ARM,
    workers: int | None = None,
    file: Path | None = None,
) -> Report:
    """Reach the goals of `seeds` seeds from `seed` on, with each ramp of the references, s, and print a table.

    `arm`: its name, or the path of its file. `workers`: processes, by default one per core.

    Raises
    ------
    SettingsError
        If there is no seed, or an option is out of range.
    """
    if seeds < 1:
        raise SettingsError(f"--seeds {seeds}: expected at least 1")
    for ramp in ramps:
        ImpedanceSettings(reference_ramp=ramp)
    cases = [
        Case(scene, number, ramp, arm) for scene in scenes for ramp in ramps for number in range(seed, seed + seeds)
    ]
    records: list[Report] = []
    for record in run_each(run_smoothness, cases, workers):
        records.append(record)
        say(f"{len(records)} of {len(cases)} runs")
    report: Report = {"bench": "smoothness", "machine": machine(), "records": records}
    header = ["scene", "ramp, ms", "reached", "time, s", "largest force, N"]
    header += [f"torque {low:g} to {high:g} Hz, Nm" for low, high in BANDS]
    rows = []
    for scene in scenes:
        for ramp in ramps:
            own = [record for record in records if (record["scene"], record["ramp"]) == (scene, ramp)]
            bands = [[max(record["torque_rms_Nm"][name]) for record in own] for name in own[0]["torque_rms_Nm"]]
            rows.append(
                (
                    scene,
                    f"{1000 * ramp:g}",
                    f"{sum(record['reached'] for record in own)}/{len(own)}",
                    _spread([record["duration_s"] for record in own]),
                    _spread([record["largest_force_N"] for record in own]),
                    *(_spread(band) for band in bands),
                    _spread([record["jerk_rms_m_s3"] for record in own], digits=1),
                )
            )
    print("torque: of the joint with most, median (largest) over the seeds\n")
    print(table((*header, "jerk of the tip up to 20 Hz, m/s³"), rows))
    write_report(report, file)
    return report


def _spread(values: Sequence[float], digits: int = 2) -> str:
    return f"{np.nanmedian(values):.{digits}f} ({np.nanmax(values):.{digits}f})"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__, spread=True)
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: free ball wall)")
    parser.add_argument("--seeds", type=int, help="runs per scene and ramp (default: 10)")
    parser.add_argument("--seed", type=int, help="of the first run (default: 0)")
    ramps = "of the references (default: 0, and the shipped one)"
    parser.add_argument("--ramps", type=float, nargs="+", metavar="SECONDS", help=ramps)
    parser.add_argument("--arm", metavar="ARM", help="a name, or the path of a URDF or YAML file (default: iiwa14)")
    bench_smoothness(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
