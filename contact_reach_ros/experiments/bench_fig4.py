"""`contact-reach bench fig4`: where the arm goes with every method, as in Fig. 4 of the paper."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.experiments.figures import (
    DPI,
    WIDTH,
    FigureOptions,
    Report,
    check,
    direction_to_camera,
    outcome,
    pixels,
    record,
    run_method,
    save,
    say_renderer,
    table,
    write_report,
)
from contact_reach_ros.experiments.grid import Setup
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.experiments.watched_episode import WatchedEpisode
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.palette import GREY, METHOD_COLOURS, SKY_BLUE
from contact_reach_ros.rendering.camera import frame
from contact_reach_ros.rendering.parts import arm_shapes, floor, obstacle_shapes, path_shapes, target_shapes
from contact_reach_ros.rendering.renderer import Picture, render
from contact_reach_ros.rendering.shapes import Shape
from contact_reach_ros.rendering.view import Ghost, View
from contact_reach_ros.scenes.files import read_scene

Runs = Mapping[str, WatchedEpisode]

SCENES = ("free", "ball", "wall")
METHODS_SHOWN = ("contact_reach", "reference_posture", "rrt_star")

_WIDEST_PANEL = 4.5
_PICTURE_RATIO = 0.9
_TITLE, _LINE = 0.3, 0.19
"""Heights of a title and of a line of text, inches."""
_START_OPACITY, _END_OPACITY = 0.3, 0.35


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
    check(bench, output)
    setup = setup or Setup(budget=load_budget())
    scenes = {scene.name: scene for scene in map(read_scene, bench.scenes)}
    if len(scenes) < len(bench.scenes):
        raise SettingsError(f"--scenes {' '.join(bench.scenes)}: expected different names")
    runs = {
        name: {method: run_method(method, scene, bench, setup, bench.seed) for method in bench.methods}
        for name, scene in scenes.items()
    }
    width = min(_WIDEST_PANEL, WIDTH / len(runs))
    rendering = render([_view(each, *pixels(width, _PICTURE_RATIO * width)) for each in runs.values()], bench.renderer)
    say_renderer(rendering)
    save(_figure(runs, rendering.pictures, width), output)
    report = {
        "bench": "fig4",
        "options": dataclasses.asdict(bench),
        "renderer": rendering.renderer,
        "machine": machine(),
        "episodes": {name: {method: record(run, setup) for method, run in each.items()} for name, each in runs.items()},
    }
    write_report(report, file)
    rows = [[name, method, outcome(run)] for name, each in runs.items() for method, run in each.items()]
    print(table(["scene", "method", "time, largest force"], rows))
    return report


def _view(runs: Runs, width: int, height: int) -> View:
    first, *others = runs.values()
    scene = first.scene
    start = arm_shapes(scene.start, GREY)
    ghosts = [Ghost(start, _START_OPACITY)]
    fixed: list[Shape] = [*obstacle_shapes(scene, first.last_obstacles), *target_shapes(scene.target)]
    for method, run in runs.items():
        path = np.concatenate([run.result.start_position[None], run.result.positions])
        fixed += path_shapes(path, METHOD_COLOURS[method])
        if run in others and len(run.result.joints):
            ghosts.append(Ghost(arm_shapes(run.result.joints[-1], METHOD_COLOURS[method]), _END_OPACITY))
    if len(first.result.joints):
        fixed += arm_shapes(first.result.joints[-1])
    shapes = [*fixed, *(shape for ghost in ghosts for shape in ghost.shapes)]
    return View(fixed, frame(shapes, width, height, direction_to_camera(scene)), floor(), ghosts)


def _figure(runs: Mapping[str, Runs], pictures: list[Picture], width: float) -> Figure:
    """One column per scene: its name, the picture, and what came of each method."""
    most = max(len(each) for each in runs.values())
    below, above = (most + 0.6) * _LINE, _TITLE
    common = 2.0 * _LINE
    picture_height = _PICTURE_RATIO * width
    total_width, total_height = width * len(runs), common + below + picture_height + above
    figure = Figure(figsize=(total_width, total_height), dpi=DPI, facecolor="white")
    for column, ((name, each), picture) in enumerate(zip(runs.items(), pictures, strict=True)):
        box = (column / len(runs), (common + below) / total_height, 1.0 / len(runs), picture_height / total_height)
        axes = figure.add_axes(box)
        axes.set_axis_off()
        axes.imshow(picture, interpolation="none", aspect="auto")
        axes.set_title(name, fontsize=11, weight="bold")
        axes.legend(
            handles=[_handle(method, run) for method, run in each.items()],
            loc="upper left",
            bbox_to_anchor=(0.02, 0.0),
            frameon=False,
            fontsize=8.5,
            labelspacing=0.25,
            borderaxespad=0.0,
            handlelength=1.6,
        )
    first = next(iter(next(iter(runs.values()))))
    figure.legend(
        handles=[
            Patch(color=GREY, alpha=_START_OPACITY, label="start"),
            Patch(facecolor="#dddddd", edgecolor="#888888", label=f"end, {first}"),
            Patch(color="#888888", alpha=0.6, label="ends of the others in their colours"),
            Line2D([], [], color=SKY_BLUE, marker="o", markersize=7, linestyle="none", label="target"),
        ],
        loc="lower center",
        ncols=4,
        frameon=False,
        fontsize=8.5,
        borderaxespad=0.3,
        handlelength=1.4,
    )
    return figure


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
        label=f"{method}: {outcome(run)}",
    )
