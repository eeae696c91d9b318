"""`contact-reach bench fig4`: the paths of all methods, as in Fig. 4 of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arrays import Array
from contact_reach_ros.drawing.camera import Camera, frame
from contact_reach_ros.drawing.offscreen import Picture, find_backend, render
from contact_reach_ros.drawing.palette import GREY, METHOD_COLOURS, SKY_BLUE, WHITE
from contact_reach_ros.drawing.parts import arm_shapes, environment_shapes, floor, obstacle_shapes, target_shapes
from contact_reach_ros.drawing.shapes import Shape
from contact_reach_ros.drawing.view import Ghost, View
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.experiments import figures
from contact_reach_ros.experiments.figures import DPI, WIDTH, FigureOptions, WatchedEpisode
from contact_reach_ros.experiments.grid import Setup
from contact_reach_ros.experiments.output import Report, say, table, write_report
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.world.files import read_scene

Runs = Mapping[str, WatchedEpisode]

SCENES = ("free", "ball", "wall")
METHODS_SHOWN = ("contact_reach", "reference_posture", "rrt_star")

_WIDEST_PANEL = 4.5
_PICTURE_RATIO = 0.9
_GAP = 0.1
"""Between pictures, inches."""
_TITLE, _LINE = 0.3, 0.19
"""Heights of a title and of a line of text, inches."""
_START_OPACITY, _END_OPACITY = 0.3, 0.4
_DIFFERENT = 0.1
"""Distance at which postures look different, m."""
_THICKEST, _THINNEST = 4.0, 1.4
"""Widths of the paths, points."""
_TARGET: dict[str, Any] = {
    "color": SKY_BLUE,
    "marker": "o",
    "markersize": 7.0,
    "markeredgecolor": WHITE,
    "linestyle": "none",
}


@dataclass(frozen=True)
class Fig4(FigureOptions):
    """What is run; `scenes` are names or YAML files."""

    methods: tuple[str, ...] = METHODS_SHOWN
    scenes: tuple[str, ...] = SCENES


def bench_fig4(bench: Fig4, output: Path, file: Path | None, setup: Setup | None = None) -> Report:
    """Run every method once in every scene, draw the figure to `output`, print a table and write JSON to `file`.

    Raises
    ------
    SettingsError, RenderingError
        If an option cannot be used, or `output` cannot be written.
    SceneError
        If a scene cannot be made.
    """
    figures.check(bench, output)
    setup = setup or Setup(budget=load_budget())
    scenes = {scene.name: scene for scene in map(read_scene, bench.scenes)}
    if len(scenes) < len(bench.scenes):
        raise SettingsError(f"--scenes {' '.join(bench.scenes)}: expected different names")
    renderer = find_backend()
    runs = {
        name: {method: figures.run_method(method, scene, bench, setup) for method in bench.methods}
        for name, scene in scenes.items()
    }
    width = min(_WIDEST_PANEL, WIDTH / len(runs))
    views = [_view(each, *figures.pixels(width - _GAP, _PICTURE_RATIO * width)) for each in runs.values()]
    pictures = render(views, renderer)
    say(f"pictures by {renderer}")
    figures.save(_figure(runs, views, pictures, width), output)
    report = {
        **figures.report_of("fig4", bench, renderer),
        "episodes": {
            name: {method: figures.record(run, setup) for method, run in each.items()} for name, each in runs.items()
        },
    }
    write_report(report, file)
    rows = [[name, method, figures.outcome(run)] for name, each in runs.items() for method, run in each.items()]
    print(table(["scene", "method", "time, largest force"], rows))
    return report


def _view(runs: Runs, width: int, height: int) -> View:
    """Start and ends of the arm, and the obstacles as the first method left them."""
    first = next(iter(runs.values()))
    scene = first.scene
    arm = scene.arm
    ends = {method: run.result.joints[-1] for method, run in runs.items() if len(run.result.joints)}
    around = [*obstacle_shapes(scene, first.last_obstacles), *environment_shapes(scene)]
    fixed: list[Shape] = [*around, *target_shapes(scene.target)]
    ghosts = [Ghost(arm_shapes(arm, scene.start, GREY), _START_OPACITY)]
    drawn: list[Array] = []
    for method, joints in ends.items():
        # Arms in almost the same place would blur each other.
        if all(_apart(arm, joints, other) > _DIFFERENT for other in drawn):
            if drawn:
                ghosts.append(Ghost(arm_shapes(arm, joints, METHOD_COLOURS[method]), _END_OPACITY))
            else:
                fixed += arm_shapes(arm, joints)
            drawn.append(joints)
    shapes = [*fixed, *(shape for ghost in ghosts for shape in ghost.shapes)]
    return View(fixed, frame(shapes, width, height, figures.direction_to_camera(scene)), floor(), ghosts)


def _apart(arm: Arm, first: Array, second: Array) -> float:
    """How far the origins of the links are apart in two postures, at most, m."""
    between = np.subtract(link_frames(arm, first)[1], link_frames(arm, second)[1])
    return float(np.linalg.norm(between, axis=1).max())


def _figure(runs: Mapping[str, Runs], views: list[View], pictures: list[Picture], width: float) -> Figure:
    """One column per scene: its name, the picture, and the outcome of each method."""
    most = max(len(each) for each in runs.values())
    below, above, common = (most + 0.5) * _LINE, _TITLE, 1.5 * _LINE
    picture_height = _PICTURE_RATIO * width
    total_width, total_height = width * len(runs), common + below + picture_height + above
    figure = Figure(figsize=(total_width, total_height), dpi=DPI, facecolor=WHITE)
    for column, ((name, each), view, picture) in enumerate(zip(runs.items(), views, pictures, strict=True)):
        low, share = (common + below) / total_height, 1.0 / len(runs)
        box = (column * share, low, share - _GAP / total_width, picture_height / total_height)
        axes = figures.show(figure, box, view, picture)
        _draw_paths(axes, view.camera, each)
        axes.set_title(name, fontsize=11, weight="bold")
        axes.legend(
            handles=[_handle(method, run) for method, run in each.items()],
            loc="upper left",
            bbox_to_anchor=(0.02, -0.02),
            frameon=False,
            fontsize=8.5,
            labelspacing=0.25,
            borderaxespad=0.0,
            handlelength=1.6,
        )
    first, *rest = next(iter(runs.values()))
    others = [
        Patch(color=METHOD_COLOURS[method], alpha=_END_OPACITY, label="end of another method, if elsewhere")
        for method in rest[:1]
    ]
    figure.legend(
        handles=[
            Patch(color=GREY, alpha=_START_OPACITY, label="start"),
            Patch(facecolor="#e4e5e6", edgecolor="#888888", label=f"end of {first}"),
            *others,
            Line2D([], [], label="target", **_TARGET),
        ],
        loc="lower center",
        ncols=4,
        frameon=False,
        fontsize=8.5,
        borderaxespad=0.3,
        handlelength=1.4,
        columnspacing=1.2,
    )
    return figure


def _draw_paths(axes: Axes, camera: Camera, runs: Runs) -> None:
    """Paths of the flange on top of everything, each thinner than the one before: some run in the same place."""
    widths = np.linspace(_THICKEST, _THINNEST, len(runs))
    for width, (method, run) in zip(widths, runs.items(), strict=True):
        if len(run.result.positions):
            path = camera.project(np.concatenate([run.result.start_position[None], run.result.positions]))[0]
            halo = [patheffects.withStroke(linewidth=width + 1.2, foreground=WHITE)]
            axes.plot(*path.T, color=METHOD_COLOURS[method], linewidth=width, path_effects=halo)
    target = camera.project(next(iter(runs.values())).scene.target)[0]
    axes.plot(*target, **_TARGET)
    axes.set_xlim(0, camera.width)
    axes.set_ylim(0, camera.height)


def _handle(method: str, run: WatchedEpisode) -> Line2D:
    """A line as the path, or a cross where there is none that leads to the target."""
    reached = run.result.reached
    return Line2D(
        [],
        [],
        color=METHOD_COLOURS[method],
        linewidth=3.0,
        linestyle="-" if reached else "none",
        marker="" if reached else "x",
        markeredgewidth=2.0,
        label=f"{method}: {figures.outcome(run)}",
    )
