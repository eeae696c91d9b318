"""What the figures of the paper have in common: episodes of one seed by several methods, and pictures of them."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from contact_reach_ros.baselines.methods import METHODS
from contact_reach_ros.errors import RenderingError, SettingsError
from contact_reach_ros.experiments.grid import Setup, concrete_scene, episode_seeds, prepared
from contact_reach_ros.experiments.journal import write_whole
from contact_reach_ros.experiments.metrics import measure
from contact_reach_ros.experiments.watched_episode import WatchedEpisode, watch_episode
from contact_reach_ros.palette import METHOD_COLOURS, WHITE, rgb
from contact_reach_ros.rendering.camera import FRONT_SIDE, SIDE
from contact_reach_ros.rendering.renderer import Rendering, check_renderer
from contact_reach_ros.scenes.scene import Scene, SceneFile

Array = NDArray[np.float64]
Report = dict[str, Any]

WIDTH = 9.0
"""Of a whole figure, inches."""
DPI = 200
"""Twice as many pixels as a page of a repository shows."""

_COLOURS = 256


@dataclasses.dataclass(frozen=True)
class FigureOptions:
    """How the episodes of a figure are run and drawn.

    Attributes
    ----------
    methods
        Some of `METHODS`.
    seed
        Of the target and of what stands around the arm; with repeat 0 of a table, it seeds solver and noise.
    latency
        Of the plans, s: a constant, so that the figure does not depend on the machine.
    renderer
        One of `RENDERERS`.
    """

    methods: tuple[str, ...]
    seed: int = 0
    latency: float = 0.04
    renderer: str = "auto"


def check(options: FigureOptions, output: Path) -> None:
    """Refuse what cannot be run or drawn, before anything is run.

    Raises
    ------
    SettingsError
        If a method is unknown, a value is out of range, or `output` is no PNG file.
    RenderingError
        If the renderer is unknown, or there can be no folder for `output`.
    """
    for method in options.methods:
        if method not in METHODS:
            raise SettingsError(f"--methods '{method}' is unknown; expected one of {', '.join(METHODS)}")
    if len(set(options.methods)) < len(options.methods):
        raise SettingsError(f"--methods {' '.join(options.methods)}: expected each of them once")
    if options.seed < 0:
        raise SettingsError(f"--seed {options.seed}: expected at least 0")
    if not 0.001 <= options.latency <= 1.0:
        raise SettingsError(f"--latency {options.latency:g}: expected 0.001 to 1 s")
    if output.suffix.lower() != ".png":
        raise SettingsError(f"--output {output}: expected a file that ends in .png")
    check_renderer(options.renderer)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(output, error) from error


def run_method(method: str, file: SceneFile, options: FigureOptions, setup: Setup, seed: int) -> WatchedEpisode:
    """Run a method on a seed, the orientation of the start held."""
    scene = concrete_scene(file, seed)
    solver_seed, noise_seed = episode_seeds(seed, repeat=0)
    planner = prepared(method, file, setup)
    planner.reseed(solver_seed)
    watched = watch_episode(scene, planner, setup.options(method, "hold", options.latency, noise_seed))
    say(f"{scene.name}, seed {seed}, {method}: {outcome(watched)}")
    return watched


def outcome(watched: WatchedEpisode) -> str:
    """Time and largest force in a few words."""
    result = watched.result
    if result.failure:
        return "no path found"
    force = f"{watched.peak_force:.1f} N"
    if result.reached:
        return f"{result.duration:.2f} s, {force}"
    return f"{'stopped' if result.stop_reason else 'not reached'}, {force}"


def record(watched: WatchedEpisode, setup: Setup) -> Report:
    """Figures of an episode, as JSON has them."""
    gains, permitted_force = setup.controller.impedance, setup.budget.permitted_force
    metrics = measure(watched.result, watched.scene.target, setup.planning, gains, permitted_force)
    return dataclasses.asdict(metrics)


def direction_to_camera(scene: Scene) -> tuple[float, float, float]:
    """From where one sees what happens in a scene: walls so that the gap between them shows."""
    return SIDE if scene.walls else FRONT_SIDE


def pixels(width: float, height: float) -> tuple[int, int]:
    """Of a picture that fills so many inches of a figure."""
    return round(DPI * width), round(DPI * height)


def say_renderer(rendering: Rendering) -> None:
    """Say what made the pictures, and what could not."""
    refused = f"; {'; '.join(rendering.refusals)}" if rendering.refusals else ""
    say(f"pictures by {rendering.renderer}{refused}")


def save(figure: Figure, output: Path) -> None:
    """Write a figure as a PNG of few colours, a third as large as with all of them.

    Raises
    ------
    RenderingError
        If the file cannot be written.
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = _few_colours(np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    try:
        picture.save(output, optimize=True, dpi=(DPI, DPI))
    except OSError as error:
        raise _unwritable(output, error) from error
    say(f"{output}: {output.stat().st_size / 1000:.0f} kB")


def _unwritable(output: Path, error: OSError) -> RenderingError:
    return RenderingError(f"{output}: cannot be written ({error.strerror}); name a file that can be")


def _few_colours(pixels: NDArray[np.uint8]) -> Image.Image:
    """A picture (height, width, 3) with 256 colours; those that mean something, and white, stay as they are."""
    kept = np.array([rgb(colour) for colour in (WHITE, *METHOD_COLOURS.values())])
    kept = np.rint(255.0 * kept).astype(np.uint8)
    few = Image.fromarray(pixels).quantize(_COLOURS - len(kept), dither=Image.Dither.NONE)
    indices = np.asarray(few).copy()
    for index, colour in enumerate(kept, start=_COLOURS - len(kept)):
        indices[(pixels == colour).all(axis=2)] = index
    rest = (few.getpalette() or [])[: 3 * (_COLOURS - len(kept))]
    rest += [0] * (3 * (_COLOURS - len(kept)) - len(rest))
    picture = Image.fromarray(indices)
    picture.putpalette([*rest, *kept.ravel().tolist()])
    return picture


def write_report(report: Report, file: Path | None) -> None:
    """Write a report as JSON, if there is a file for it."""
    if file is not None:
        write_whole(file, json.dumps(report, indent=1, allow_nan=False) + "\n")


def say(line: str) -> None:
    """A line on the error output."""
    print(line, file=sys.stderr, flush=True)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
