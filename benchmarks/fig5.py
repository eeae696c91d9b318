"""The paper's Fig. 5: the contact force over time, with pictures of the arm."""

from __future__ import annotations

import dataclasses
import string
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from PIL import Image

from benchmarks.baselines.method import Method
from benchmarks.baselines.methods import METHODS
from benchmarks.episode import EpisodeOptions, run_episode
from benchmarks.episode_result import EpisodeResult
from benchmarks.grid import Setup, concrete_scene, episode_seeds, prepared
from benchmarks.metrics import measure
from benchmarks.offscreen import Picture, find_backend, render
from benchmarks.output import Report, command_line, given, machine, run_command, say, table, write_report
from benchmarks.view import (
    FRONT_SIDE,
    SIDE,
    Camera,
    View,
    arm_shapes,
    environment_shapes,
    floor,
    frame,
    obstacle_shapes,
    path_shapes,
    target_shapes,
)
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.drawing.palette import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY_BLUE, VERMILION, WHITE
from contact_reach_ros.drawing.shapes import Shape
from contact_reach_ros.errors import RenderingError, SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.simulation.plant import TICK, Contacts, Plant
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import SceneFile, read_scene
from contact_reach_ros.world.spheres import rest_positions

METHOD_COLOURS = {
    "contact_reach": BLUE,
    "reference_posture": VERMILION,
    "collision_free": PURPLE,
    "rrt_star": GREEN,
    "joint_torque": ORANGE,
    "cma_es": SKY_BLUE,
}
"""By the names in `baselines.methods.METHODS`; the others are black."""

TOUCHED = 0.05
"""Force that counts as contact, N."""

WIDTH = 9.0
"""Of the whole figure, inches."""
DPI = 200
"""Twice as many pixels as a page of a repository shows."""
_COLOURS = 256
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


@dataclass(frozen=True, eq=False)
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


Runs = Mapping[str, WatchedEpisode]


@dataclass(frozen=True)
class Fig5:
    """What is run and drawn.

    Attributes
    ----------
    methods
        Some of `METHODS`.
    scene
        Name or YAML file.
    seed
        Of target and obstacles; with repeat 0 of a table, it seeds solver and noise.
    latency
        Of the plans, s: a constant, so that the figure does not depend on the machine.
    output
        The picture, a PNG file.

    Raises
    ------
    SettingsError
        If a method is unknown, a value is out of range, or `output` is no PNG file.
    """

    methods: tuple[str, ...] = ("contact_reach", "reference_posture")
    scene: str = "wall"
    seed: int = 0
    latency: float = 0.04
    output: Path = Path("docs/fig5.png")

    def __post_init__(self) -> None:
        for method in self.methods:
            if method not in METHODS:
                raise SettingsError(f"--methods '{method}' is unknown; expected one of {', '.join(METHODS)}")
        if len(set(self.methods)) < len(self.methods):
            raise SettingsError(f"--methods {' '.join(self.methods)}: expected each of them once")
        if self.seed < 0:
            raise SettingsError(f"--seed {self.seed}: expected at least 0")
        if not 0.001 <= self.latency <= 1.0:
            raise SettingsError(f"--latency {self.latency:g}: expected 0.001 to 1 s")
        if self.output.suffix.lower() != ".png":
            raise SettingsError(f"--output {self.output}: expected a file that ends in .png")


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


def bench_fig5(bench: Fig5, file: Path | None, setup: Setup | None = None) -> Report:
    """Run every method, draw the figure, print a table and write JSON with the profiles to `file`.

    Raises
    ------
    RenderingError
        If OpenGL does not work here, or the picture cannot be written.
    SceneError
        If the scene cannot be made.
    """
    try:
        bench.output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(bench.output, error) from error
    renderer = find_backend()
    setup = setup or Setup(budget=load_budget())
    scene_file = read_scene(bench.scene)
    runs = {method: run_method(method, scene_file, bench, setup) for method in bench.methods}
    records = {method: record(run, setup) for method, run in runs.items()}
    chosen = {method: _moments(method, run) for method, run in runs.items()}
    pictured = [moment for moments in chosen.values() for moment in moments]
    views = _views(runs, pictured)
    pictures = render(views, renderer)
    say(f"pictures by {renderer}")
    permitted = setup.budget.permitted_force
    save(_figure(runs, pictured, views, pictures, permitted), bench.output)
    report = {
        "bench": "fig5",
        "options": {**dataclasses.asdict(bench), "output": str(bench.output)},
        "renderer": renderer,
        "machine": machine(),
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
    rows = [[method, outcome(run), f"{records[method]['contact_impulse']:.2f}"] for method, run in runs.items()]
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
    camera: Camera = frame(every, *pixels(width, _PICTURE_RATIO * width), direction_to_camera(scene))
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
        *path_shapes(path, _colour(moment.method)),
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
        axes = show(figure, box, view, picture)
        _draw_forces(axes, view.camera, *_resultants(runs[moment.method], moment.tick))
        force = runs[moment.method].result.contact_forces[moment.tick]
        label = f"({letters[moment]}) {moment.name}: {moment.time:.2f} s, {force:.1f} N"
        axes.set_title(label, fontsize=9, color=_colour(moment.method), pad=3.0)
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
        label = f"{method}: {outcome(run)}"
        axes.plot(time, forces, color=_colour(method), linewidth=1.5, label=label)
    axes.axhline(permitted, color=GREY, linewidth=1.0, linestyle="--", label=f"permitted, {permitted:g} N")
    methods = list(runs)
    for moment, letter in letters.items():
        colour = _colour(moment.method)
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


def run_method(method: str, file: SceneFile, options: Fig5, setup: Setup) -> WatchedEpisode:
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


def _colour(method: str) -> str:
    return METHOD_COLOURS.get(method, BLACK)


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


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scene", help="a name or a YAML file (default: wall)")
    methods = "as for table1 (default: contact_reach reference_posture)"
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help=methods)
    parser.add_argument("--seed", type=int, help="of the target and the obstacles (default: 0)")
    parser.add_argument("--latency", type=float, metavar="SECONDS", help="time of a plan (default: 0.04)")
    parser.add_argument("--output", type=Path, help="the picture (default: docs/fig5.png)")
    options = given(parser, arguments)
    file = options.pop("file", None)
    bench_fig5(Fig5(**options), file)


if __name__ == "__main__":
    run_command(main)
