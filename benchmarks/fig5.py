"""`contact-reach bench fig5`: the contact force over time, with pictures of the arm, as in Fig. 5 of the paper."""

from __future__ import annotations

import string
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from contact_reach_ros.arrays import Array
from contact_reach_ros.drawing.camera import Camera, frame
from contact_reach_ros.drawing.offscreen import Picture, find_backend, render
from contact_reach_ros.drawing.palette import BLACK, GREY, METHOD_COLOURS, WHITE
from contact_reach_ros.drawing.parts import (
    arm_shapes,
    environment_shapes,
    floor,
    obstacle_shapes,
    path_shapes,
    target_shapes,
)
from contact_reach_ros.drawing.shapes import Shape
from contact_reach_ros.drawing.view import View
from benchmarks import figures
from benchmarks.figures import DPI, WIDTH, FigureOptions, WatchedEpisode
from benchmarks.grid import Setup
from benchmarks.output import Report, say, table, write_report
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.world.files import read_scene

Runs = Mapping[str, WatchedEpisode]

METHODS_SHOWN = ("contact_reach", "reference_posture")

TOUCHED = 0.05
"""Force that counts as contact, N."""

_COLUMNS = 3
_AT_THE_END = 0.1
"""A largest force this short before the end, s, has no picture of its own."""
_FORCE_SCALE = 0.05
"""Length of a force's arrow, m/N."""
_ARROW: dict[str, Any] = {
    "color": BLACK,
    "linewidth": 1.3,
    "path_effects": [patheffects.withStroke(linewidth=2.8, foreground=WHITE)],
}
_FOAM_OPACITY = 0.4
_PICTURE_RATIO = 0.72
_CURVES = 2.5
"""Height of the axes with the curves, inches."""
_LINE = 0.2
_DIGITS = 4


@dataclass(frozen=True)
class Fig5(FigureOptions):
    """What is run; `scene` is a name or a YAML file."""

    methods: tuple[str, ...] = METHODS_SHOWN
    scene: str = "wall"


@dataclass(frozen=True)
class Moment:
    """A moment of a method's episode that has a picture, at a tick of its result."""

    method: str
    name: str
    tick: int

    @property
    def time(self) -> float:
        """Since the goal was given, s."""
        return (self.tick + 1) * TICK


def bench_fig5(bench: Fig5, output: Path, file: Path | None, setup: Setup | None = None) -> Report:
    """Run every method, draw the figure to `output`, print a table and write JSON with the profiles to `file`.

    Raises
    ------
    SettingsError, RenderingError
        If an option cannot be used, or `output` cannot be written.
    SceneError
        If the scene cannot be made.
    """
    figures.check(bench, output)
    renderer = find_backend()
    setup = setup or Setup(budget=load_budget())
    scene_file = read_scene(bench.scene)
    runs = {method: figures.run_method(method, scene_file, bench, setup) for method in bench.methods}
    records = {method: figures.record(run, setup) for method, run in runs.items()}
    chosen = {method: _moments(method, run) for method, run in runs.items()}
    pictured = [moment for moments in chosen.values() for moment in moments]
    views = _views(runs, pictured)
    pictures = render(views, renderer)
    say(f"pictures by {renderer}")
    permitted = setup.budget.permitted_force
    figures.save(_figure(runs, pictured, views, pictures, permitted), output)
    report = {
        **figures.report_of("fig5", bench, renderer),
        "permitted_force_N": permitted,
        "tick_s": TICK,
        "episodes": records,
        "moments": {
            method: [{"name": moment.name, "time_s": round(moment.time, 3)} for moment in moments]
            for method, moments in chosen.items()
        },
        "profiles_N": {method: _profile(run).tolist() for method, run in runs.items()},
    }
    write_report(report, file)
    rows = [[method, figures.outcome(run), f"{records[method]['contact_impulse']:.2f}"] for method, run in runs.items()]
    print(table(["method", "time, largest force", "impulse [N s]"], rows))
    return report


def _profile(run: WatchedEpisode) -> Array:
    """Force on the body that is pressed hardest, after each tick, N."""
    return np.round(run.result.contact_forces, _DIGITS)


def _moments(method: str, run: WatchedEpisode) -> list[Moment]:
    """First contact, largest force and end; only the end if nothing was touched, none if nothing happened.

    Where the force is largest at the end, half of it is shown instead.
    """
    forces = run.result.contact_forces
    if not len(forces):
        return []
    last, peak = len(forces) - 1, int(forces.argmax())
    end = Moment(method, "end", last)
    if forces[peak] <= TOUCHED:
        return [end]
    largest = Moment(method, "largest force", peak)
    if (last - peak) * TICK < _AT_THE_END:
        largest = Moment(method, "half of the largest force", int(np.argmax(forces >= 0.5 * forces[peak])))
    return [Moment(method, "first contact", int(np.argmax(forces > TOUCHED))), largest, end]


def _views(runs: Runs, moments: list[Moment]) -> list[View]:
    if not moments:
        return []
    scene = next(iter(runs.values())).scene
    width = WIDTH / _COLUMNS
    stages = [_shapes(runs[moment.method], moment) for moment in moments]
    every = [shape for stage in stages for shape in stage]
    # With one camera for all, only motion makes the pictures differ.
    camera: Camera = frame(every, *figures.pixels(width, _PICTURE_RATIO * width), figures.direction_to_camera(scene))
    return [View(stage, camera, floor()) for stage in stages]


def _shapes(run: WatchedEpisode, moment: Moment) -> list[Shape]:
    """The arm, the obstacles, the target and the path so far."""
    result, tick = run.result, moment.tick
    path = np.concatenate([result.start_position[None], result.positions[: tick + 1]])
    return [
        *arm_shapes(run.scene.arm, result.joints[tick]),
        *obstacle_shapes(run.scene, run.obstacles[tick], _FOAM_OPACITY),
        *environment_shapes(run.scene),
        *target_shapes(run.scene.target),
        *path_shapes(path, METHOD_COLOURS[moment.method]),
    ]


def _resultants(run: WatchedEpisode, tick: int) -> tuple[Array, Array]:
    """Points (n, 3), m, and forces (n, 3) on the arm, N: the sum on each link that is touched, in the contacts' middle.

    The middle is that of the points weighted with their forces.
    """
    contacts = run.contacts[tick]
    weights = np.linalg.norm(contacts.forces, axis=1)
    points, forces = [], []
    for link in np.unique(contacts.links[weights > 0.0]):
        here = contacts.links == link
        points.append(np.average(contacts.points[here], axis=0, weights=weights[here]))
        forces.append(contacts.forces[here].sum(axis=0))
    return np.reshape(points, (-1, 3)), np.reshape(forces, (-1, 3))


def _figure(runs: Runs, moments: list[Moment], views: list[View], pictures: list[Picture], permitted: float) -> Figure:
    """A row of pictures for each method, below them the curves."""
    moments_of = {method: [moment for moment in moments if moment.method == method] for method in runs}
    shown = [method for method, its in moments_of.items() if its]
    letters = dict(zip(moments, string.ascii_lowercase, strict=False))
    width = WIDTH / _COLUMNS
    picture_height, title = _PICTURE_RATIO * width, 1.2 * _LINE
    bottom, top = 2.2 * _LINE, (0.3 + len(runs)) * _LINE
    height = len(shown) * (picture_height + title) + top + _CURVES + bottom
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, facecolor=WHITE)
    for moment, view, picture in zip(moments, views, pictures, strict=True):
        row = shown.index(moment.method)
        column = _COLUMNS + moments_of[moment.method].index(moment) - len(moments_of[moment.method])
        low = height - (row + 1) * (picture_height + title)
        box = (column / _COLUMNS, low / height, 1.0 / _COLUMNS, picture_height / height)
        axes = figures.show(figure, box, view, picture)
        _draw_forces(axes, view.camera, *_resultants(runs[moment.method], moment.tick))
        force = runs[moment.method].result.contact_forces[moment.tick]
        label = f"({letters[moment]}) {moment.name}: {moment.time:.2f} s, {force:.1f} N"
        axes.set_title(label, fontsize=9, color=METHOD_COLOURS[moment.method], pad=3.0)
    left, right = 0.6, 0.15
    curves = figure.add_axes((left / WIDTH, bottom / height, 1.0 - (left + right) / WIDTH, _CURVES / height))
    _draw_curves(curves, runs, letters, permitted)
    return figure


def _draw_forces(axes: Axes, camera: Camera, points: Array, forces: Array) -> None:
    """Arrows that end where the forces act, on top of the foam around them."""
    starts, ends = camera.project(points - _FORCE_SCALE * forces)[0], camera.project(points)[0]
    for start, end in zip(starts, ends, strict=True):
        arrow = FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=7.0, shrinkA=0.0, shrinkB=0.0, **_ARROW)
        axes.add_patch(arrow)


def _draw_curves(axes: Axes, runs: Runs, letters: Mapping[Moment, str], permitted: float) -> None:
    for method, run in runs.items():
        forces = run.result.contact_forces
        time = TICK * np.arange(1, len(forces) + 1)
        label = f"{method}: {figures.outcome(run)}"
        axes.plot(time, forces, color=METHOD_COLOURS[method], linewidth=1.5, label=label)
    axes.axhline(permitted, color=GREY, linewidth=1.0, linestyle="--", label=f"permitted, {permitted:g} N")
    methods = list(runs)
    for moment, letter in letters.items():
        colour = METHOD_COLOURS[moment.method]
        row = len(methods) - 1 - methods.index(moment.method)
        axes.axvline(moment.time, color=colour, linewidth=1.0, linestyle=":")
        axes.annotate(
            f"({letter})",
            (moment.time, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0.0, 2.0 + 72.0 * _LINE * 0.8 * row),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            color=colour,
        )
    axes.set_xlabel("time since the goal [s]", fontsize=9)
    axes.set_ylabel("force on the most loaded body [N]", fontsize=9)
    axes.set_xlim(left=0.0)
    arrow = f"force on a body, {100 * _FORCE_SCALE:g} cm/N"
    axes.plot([], [], color=BLACK, marker=r"$\rightarrow$", markersize=14.0, linestyle="none", label=arrow)
    axes.legend(loc="best", fontsize=8.0, framealpha=1.0, edgecolor="none", borderaxespad=0.2)
    axes.set_ylim(bottom=0.0)
    axes.tick_params(labelsize=8.5)
    axes.grid(True, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
