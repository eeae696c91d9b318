"""The tables of a report: every sample, as CSV."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from contact_reach_ros.arrays import Array
from contact_reach_ros.bags.signals import Series
from contact_reach_ros.report.bag import ReportBag


def write_tables(bag: ReportBag, directory: Path) -> None:
    """Write joint_states, commands, external_torque, contact_force, distance, plans and events, each as CSV.

    Times are in s since the goal was sent, or since the first joint state without one. Quantities that the bag lacks
    get no file.
    """
    directory.mkdir(parents=True, exist_ok=True)
    signals = bag.signals
    names = [f"A{joint + 1}" for joint in range(signals.position.values.shape[1])]
    states = [signals.position.values, signals.velocity.values, signals.effort.values]
    heads = [f"{what}_{name}_{unit}" for what, unit in (("q", "rad"), ("v", "rad_s"), ("tau", "Nm")) for name in names]
    _write(directory / "joint_states.csv", bag, signals.position.time, np.concatenate(states, axis=1), heads)
    _series(directory / "commands.csv", bag, signals.command, [f"tau_{name}_Nm" for name in names])
    _series(directory / "external_torque.csv", bag, signals.external_torque, [f"tau_{name}_Nm" for name in names])
    _series(
        directory / "contact_force.csv", bag, signals.contact_force, [f"{n}_N" for n in signals.contact_force.names]
    )
    if bag.episode is not None:
        _series(directory / "distance.csv", bag, bag.episode.distance, ["distance_m"])
    with (directory / "events.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time_s", "level", "source", "message"])
        for event in signals.safety:
            writer.writerow([f"{event.time - bag.zero:.6f}", event.level, event.name, event.message])
    if signals.plans:
        keys = list(dict.fromkeys(key for plan in signals.plans for key in plan.numbers))
        with (directory / "plans.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["time_s", "stop_reason", *keys])
            for plan in signals.plans:
                numbers = [plan.numbers.get(key, "") for key in keys]
                writer.writerow([f"{plan.time - bag.zero:.6f}", plan.stop_reason, *numbers])


def _series(file: Path, bag: ReportBag, series: Series, names: Sequence[str]) -> None:
    _write(file, bag, series.time, series.values, names)


def _write(file: Path, bag: ReportBag, time: Array, values: Array, names: Sequence[str]) -> None:
    if not len(time):
        return
    rows = np.column_stack([time - bag.zero, values])
    np.savetxt(file, rows, fmt="%.9g", delimiter=",", header=",".join(["time_s", *names]), comments="")
