"""What the paper's figure needs beside its drawing: episodes with what pictures need of them, options, files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from contact_reach_ros.arms import load_arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.drawing.camera import FRONT_SIDE, SIDE
from contact_reach_ros.drawing.offscreen import Picture
from contact_reach_ros.drawing.view import View
from contact_reach_ros.errors import RenderingError, SettingsError
from benchmarks.baselines.method import Method
from benchmarks.baselines.methods import METHODS
from benchmarks.episode import EpisodeOptions, run_episode
from benchmarks.episode_result import EpisodeResult
from benchmarks.grid import Setup, concrete_scene, episode_seeds, prepared
from benchmarks.machine import machine
from benchmarks.metrics import measure
from benchmarks.output import Report, say
from contact_reach_ros.simulation.plant import TICK, Contacts, Plant
from contact_reach_ros.world.scene import Scene, SceneFile
from contact_reach_ros.world.spheres import rest_positions

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
        Of target and obstacles; with repeat 0 of a table, it seeds solver and noise.
    latency
        Of the plans, s: a constant, so that the figure does not depend on the machine.
    """

    methods: tuple[str, ...]
    seed: int = 0
    latency: float = 0.04


@dataclasses.dataclass(frozen=True, eq=False)
class WatchedEpisode:
    """An episode, from the moment the goal was given.

    Attributes
    ----------
    scene
        That it took place in.
    result
        Of `run_episode`.
    obstacles
        (n, K, 3) where the obstacles are after each tick of the result, m, in the order of `rest_positions`.
    contacts
        (n) contacts with the arm after each tick.
    """

    scene: Scene
    result: EpisodeResult
    obstacles: Array
    contacts: list[Contacts]

    @property
    def peak_force(self) -> float:
        """Largest contact force on one body, N."""
        return float(self.result.contact_forces.max(initial=0.0))


def watch_episode(scene: Scene, method: Method, options: EpisodeOptions) -> WatchedEpisode:
    """Run an episode as `run_episode` does and keep what pictures need."""
    settle_ticks = round(options.settle / TICK)
    obstacles: list[Array] = []
    contacts: list[Contacts] = []

    def watch(tick: int, plant: Plant) -> None:
        # The result does not hold the time before the goal was given either.
        if tick >= settle_ticks:
            obstacles.append(plant.obstacle_positions())
            contacts.append(plant.contacts())

    result = run_episode(scene, method, options, watch)
    moved = np.reshape(obstacles, (len(obstacles), *rest_positions(scene).shape))
    return WatchedEpisode(scene, result, moved, contacts)


def check(options: FigureOptions, output: Path) -> None:
    """Refuse bad options before anything is run.

    Raises
    ------
    SettingsError
        If a method is unknown, a value is out of range, or `output` is no PNG file.
    RenderingError
        If there can be no folder for `output`.
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
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(output, error) from error


def run_method(method: str, file: SceneFile, options: FigureOptions, setup: Setup) -> WatchedEpisode:
    """Run a method once, the orientation of the start held."""
    scene = concrete_scene(file, load_arm(setup.arm), options.seed)
    solver_seed, noise_seed = episode_seeds(options.seed, repeat=0)
    ready = prepared(method, file, setup)
    ready.reseed(solver_seed)
    watched = watch_episode(scene, ready, setup.options(method, "hold", options.latency, noise_seed))
    say(f"{scene.name}, {method}: {outcome(watched)}")
    return watched


def outcome(watched: WatchedEpisode) -> str:
    """Time and largest force in a few words."""
    result = watched.result
    if result.failure:
        return "no path found"
    force = f"{watched.peak_force:.1f} N"
    if result.reached:
        return f"{result.time:.2f} s, {force}"
    return f"{'stopped' if result.stop_reason else 'not reached'}, {force}"


def record(watched: WatchedEpisode, setup: Setup) -> Report:
    """Figures of an episode, as JSON has them."""
    gains, permitted_force = setup.controller.impedance, setup.budget.permitted_force
    metrics = measure(watched.result, watched.scene.target, setup.planning, gains, permitted_force)
    return dataclasses.asdict(metrics)


def report_of(bench: str, options: FigureOptions, renderer: str) -> Report:
    """What the reports of all figures begin with."""
    return {"bench": bench, "options": dataclasses.asdict(options), "renderer": renderer, "machine": machine()}


def show(figure: Figure, box: tuple[float, float, float, float], view: View, picture: Picture) -> Axes:
    """Add a picture to a figure, with axes in its camera's pixels; `box` is left, bottom, width and height."""
    axes = figure.add_axes(box)
    axes.set_axis_off()
    axes.imshow(picture, extent=(0, view.camera.width, 0, view.camera.height), aspect="auto")
    return axes


def direction_to_camera(scene: Scene) -> tuple[float, float, float]:
    """Direction to a camera that sees into the gap between walls, if there are any."""
    return SIDE if any(obstacle.is_deformable for obstacle in scene.obstacles) else FRONT_SIDE


def pixels(width: float, height: float) -> tuple[int, int]:
    """Of a picture that fills so many inches of a figure."""
    return round(DPI * width), round(DPI * height)


def save(figure: Figure, output: Path) -> None:
    """Write a figure as a PNG of few colours, a third as large as with all of them.

    Raises
    ------
    RenderingError
        If the file cannot be written.
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Image.fromarray(np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    try:
        few = picture.quantize(_COLOURS, dither=Image.Dither.NONE)
        few.save(output, optimize=True, dpi=(DPI, DPI))
    except OSError as error:
        raise _unwritable(output, error) from error
    say(f"{output}: {output.stat().st_size / 1000:.0f} kB")


def _unwritable(output: Path, error: OSError) -> RenderingError:
    return RenderingError(f"{output}: cannot be written ({error.strerror}); name a file that can be")
