"""The commands `contact-reach bench ...`.

Only options that are given are passed on, by their names: the defaults are those of the benches.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from contact_reach_ros.arms import DEFAULT_ARM
from contact_reach_ros.control.settings import TASK_ROWS
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.settings import BRAX_PIPELINES

if TYPE_CHECKING:
    from contact_reach_ros.experiments.grid_run import Running


def add_benches(bench: argparse.ArgumentParser) -> None:
    """Add all benches to the parser of `contact-reach bench`."""
    benches = bench.add_subparsers(required=True, metavar="WHAT")

    def add(name: str, run: Callable[..., int | None], help_text: str) -> argparse.ArgumentParser:
        parser = benches.add_parser(name, help=help_text, argument_default=argparse.SUPPRESS)
        parser.add_argument("--json", dest="file", type=Path, metavar="FILE", help="write the result as JSON")
        parser.set_defaults(run=run)
        return parser

    control = add(
        "control",
        _control,
        "arithmetic of controller and observer, per tick; with --seconds how the stack keeps its time",
    )
    control.add_argument("--ticks", type=int, help="ticks of arithmetic to measure (default: 20000)")
    control.add_argument("--seconds", type=float, help="run the stack in real time for so long instead")
    control.add_argument("--load", type=int, help="with so many processes that never sleep (default: 0)")
    control.add_argument("--scene", help="a name or a YAML file (default: ball)")
    bags = add("bags", _plain("bench_bags"), "lost messages, and what recording, replaying and analysing bags costs")
    bags.add_argument("--seconds", type=float, help="of recording five 1 kHz topics (default: 60)")
    bags.add_argument("--minutes", type=float, help="length of the bag to be analysed (default: 10)")
    bags.add_argument("--bag", type=Path, help="a recording to make it of (default: the sample of the package)")
    foam = add(
        "foam", _plain("bench_foam"), "stiffness of the walls in plant and planner, and what simulating them costs"
    )
    foam.add_argument("--scene", help="scene with walls: a name or a YAML file (default: wall)")
    foam.add_argument("--seed", type=int, help="seed of the scene (default: 0)")
    foam.add_argument("--force", type=float, help="what nodes are pressed with, N (default: 10)")
    foam.add_argument("--fit", action="store_true", help="find the planner's stiffness that agrees best")
    observer = add(
        "observer", _plain("bench_observer"), "how soon pushes are seen, and how seldom free motion is taken for one"
    )
    observer.add_argument(
        "--minutes", type=float, help="simulated free motion in which false stops are counted (default: 60)"
    )
    instead = observer.add_mutually_exclusive_group()
    instead.add_argument(
        "--rate", type=float, nargs="+", metavar="HZ", help="compare rates of joint states, as 100 200 500 1000"
    )
    instead.add_argument("--slow", action="store_true", help="pushes that grow slowly, joint by joint")
    instead.add_argument("--identified", action="store_true", help="before and after an identification of the arm")
    observer.add_argument("--commanded", action="store_true", help="observe from commands, not from measured torques")
    observer.add_argument(
        "--friction", type=float, metavar="FACTOR", help="on the joint friction of the simulated arm (default: 3)"
    )
    observer.add_argument("--plot", type=Path, metavar="FILE", help="draw pushes seen against false contacts")
    planner = add("planner", _planner, "time and steps of plans along closed-loop runs, and comparisons")
    planner.add_argument(
        "--scene", dest="scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: free, ball, wall)"
    )
    planner.add_argument("--plans", type=int, help="warm-started plans per scene, at least (default: 50)")
    planner.add_argument("--seed", type=int, help="seed of the first run and of the solver (default: 0)")
    planner.add_argument(
        "--brax",
        nargs="*",
        choices=BRAX_PIPELINES,
        help="Brax's pipelines to compare with, which takes minutes; nothing for none (default: generalized)",
    )
    planner.add_argument("--quick", action="store_true", help="show that it runs, with a tiny budget")
    planner.add_argument(
        "--limit", action="store_true", help="instead, a solver step against what the core can do, part by part"
    )
    planner.add_argument(
        "--candidates", type=int, nargs="+", metavar="K", help="instead, batches of so many candidates, ours and Brax's"
    )
    planner.add_argument("--cpus", type=int, default=1, help="cores that share the candidates (default: 1)")
    planner.add_argument(
        "--plot", type=Path, metavar="FILE", help="measure and draw how the time grows with k, H, nodes and cores"
    )
    model = add("model", _model, "the planner's transfer model against the simulated robot")
    model.add_argument("--states", type=int, help="random states and actions (default: 500)")
    model.add_argument("--seed", type=int, help="of states and actions (default: 0)")
    model.add_argument(
        "--against",
        nargs="+",
        choices=BRAX_PIPELINES,
        help="instead, roll out the plans of closed-loop runs with Brax's pipelines and with MuJoCo",
    )
    model.add_argument("--scene", dest="scenes", nargs="+", help="with --against: scenes (default: free ball wall)")
    model.add_argument("--plans", type=int, help="with --against: plans per scene (default: 12)")
    setting = add("setting", _setting, "whole episodes for each value of a setting of the planner or a gain")
    setting.add_argument("name", help="a parameter of section 'planning' or 'impedance', as contact_weight; or latency")
    setting.add_argument("values", nargs="+", type=yaml.safe_load, metavar="VALUE", help="values that it takes")
    setting.add_argument("--scene", dest="scenes", nargs="+", help="names or YAML files (default: ball wall)")
    setting.add_argument("--methods", nargs="+", metavar="METHOD", help="as for table1 (default: contact_reach)")
    setting.add_argument("--targets", type=int, help="episodes per scene, method and value (default: 10)")
    setting.add_argument("--seed", type=int, help="of the first target (default: 0)")
    setting.add_argument(
        "--with", dest="others", nargs="+", metavar="NAME=VALUE", help="other settings, the same for each value"
    )
    setting.add_argument("--spheres", type=int, help="that plans take into account (default: as many as the scene has)")
    faults = add("faults", _faults, "episodes in which things go wrong at random")
    faults.add_argument("--episodes", type=int, help="how many (default: 200)")
    faults.add_argument("--seed", type=int, help="of the first episode (default: 0)")
    stops = add("stops", _plain("bench_stops"), "how fast and how far the arm sinks when it is stopped")
    stops.add_argument("--postures", type=int, help="random postures of each scene (default: 200)")
    stops.add_argument("--scenes", nargs="+", metavar="SCENE", help="whose mismatch it has (default: ball_mismatch)")
    smoothness = add("smoothness", _plain("bench_smoothness"), "vibration of the commanded torques, jerk of the tip")
    smoothness.add_argument(
        "--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: free ball wall)"
    )
    smoothness.add_argument("--seeds", type=int, help="runs per scene and ramp (default: 10)")
    smoothness.add_argument("--seed", type=int, help="of the first run (default: 0)")
    smoothness.add_argument(
        "--ramps", type=float, nargs="+", metavar="SECONDS", help="of the references (default: 0, and the shipped one)"
    )
    table1 = add("table1", _table1, "the paper's Table I: every method in every scene")
    table1.add_argument(
        "--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: those of the paper)"
    )
    table1.add_argument(
        "--goals", nargs="+", metavar="GOAL", help="hold the orientation, or leave it free (default: both)"
    )
    table1.add_argument("--methods", nargs="+", metavar="METHOD", help="see docs/baselines.md (default: four)")
    table1.add_argument("--task", choices=TASK_ROWS, help="what law (1) controls (default: pose)")
    table1.add_argument("--targets", type=int, help="targets per scene (default: 70)")
    table1.add_argument("--repeats", type=int, help="episodes per target (default: 1)")
    table1.add_argument("--seed", type=int, help="of the first target (default: 0)")
    table1.add_argument("--timeout", type=float, help="simulated time to reach a goal, s (default: 20, or 60)")
    table1.add_argument("--latency", type=float, metavar="SECONDS", help="time of a plan (default: the preset's)")
    table1.add_argument("--report-only", action="store_true", help="run nothing, report what is in --json FILE")
    table1.add_argument(
        "--beside", type=Path, nargs="+", metavar="FILE", help="with --plot: further runs, with other presets"
    )
    clutter = add("clutter", _clutter, "random scenes with several soft bodies, every method")
    clutter.add_argument("--scenes", type=int, help="how many (default: 100)")
    clutter.add_argument("--seed", type=int, help="of the first; below 10000 for tuning (default: 10000)")
    clutter.add_argument("--methods", nargs="+", metavar="METHOD", help="see docs/results.md (default: eight)")
    clutter.add_argument("--timeout", type=float, help="simulated time to reach a goal, s (default: 60)")
    for grid in (table1, clutter):
        grid.add_argument("--preset", help="configuration: paper_linear, paper_hinge or shipped (default: shipped)")
    for grid in (setting, table1, clutter):
        grid.add_argument("--resume", action="store_true", help="go on with the run of --json FILE")
        grid.add_argument("--plot", type=Path, metavar="FILE", help="draw the table")
    for any_arm in (planner, setting, smoothness, table1):
        any_arm.add_argument(
            "--arm", metavar="ARM", help="a name, or the path of a URDF or YAML file (default: iiwa14)"
        )
    floor = add("floor", _plain("bench_floor"), "the least force with which the arm can get through a scene")
    floor.add_argument("--scene", help="a name or a YAML file (default: wall)")
    floor.add_argument("--targets", type=int, help="how many (default: 5)")
    floor.add_argument("--seed", type=int, help="of the first target (default: 20)")
    page = add("page", _page, "all tables and figures of docs/results.md, in one run that can be interrupted")
    page.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the runs; goes on with them")
    page.add_argument("--parts", nargs="+", metavar="PART", help="only these, by the names that --dry-run lists")
    page.add_argument("--quick", action="store_true", help="everything in small, in at most ten minutes")
    page.add_argument("--dry-run", action="store_true", help="run nothing, list the parts and what they take")
    page.add_argument("--report-only", action="store_true", help="run nothing, report what is there")
    page.add_argument("--write", type=Path, metavar="FILE", help="replace tables in this page, and figures beside it")
    for spread in (faults, stops, smoothness, setting, table1, clutter, floor, page):
        spread.add_argument(
            "--workers", type=int, metavar="W", help="processes on this machine (default: one per core)"
        )
        spread.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler, whose workers run it instead")
    fig5 = add("fig5", _fig5, "the paper's Fig. 5: contact force over time, with pictures of the arm")
    fig5.add_argument("--scene", help="scene: a name or a YAML file (default: wall)")
    fig5.add_argument(
        "--methods", nargs="+", metavar="METHOD", help="as for table1 (default: contact_reach reference_posture)"
    )
    fig5.add_argument("--seed", type=int, help="of the target and what stands around (default: 0)")
    fig5.add_argument("--latency", type=float, metavar="SECONDS", help="time of a plan (default: 0.04)")
    fig5.add_argument("--output", type=Path, help="the picture (default: docs/fig5.png)")
    solver = add("solver", _plain("bench_solver"), "Algorithm 1 and other solvers at equal wall time")
    solver.add_argument("--scene", dest="scenes", nargs="+", help="names or YAML files (default: ball wall)")
    solver.add_argument("--states", type=int, help="to start from in each scene (default: 40)")
    solver.add_argument("--seconds", type=float, help="for each search (default: 0.1)")
    solver.add_argument(
        "--steps", action="store_true", help="instead, after ten steps each, in several configurations of Algorithm 1"
    )
    solver.add_argument("--plot", type=Path, metavar="FILE", help="draw the costs over time")


def _plain(bench: str) -> Callable[..., None]:
    """Call the function that has the name of its module with all options."""

    def run(**options: Any) -> None:
        getattr(import_module(f"contact_reach_ros.experiments.{bench}"), bench)(**options)

    return run


def _control(ticks: int = 20000, seconds: float | None = None, file: Path | None = None, **options: Any) -> None:
    if seconds is None:
        from contact_reach_ros.experiments.bench_control import bench_control

        bench_control(ticks, file)
    else:
        # The one bench that needs ROS in this process.
        from contact_reach_ros.experiments.bench_control_stack import bench_control_stack
        from contact_reach_ros.experiments.control_report import ControlBench

        bench_control_stack(ControlBench(seconds, **options), file)


def _planner(
    scenes: list[str] | None = None,
    seed: int = 0,
    quick: bool = False,
    limit: bool = False,
    candidates: Sequence[int] = (),
    cpus: int = 1,
    arm: str = DEFAULT_ARM,
    file: Path | None = None,
    plot: Path | None = None,
    **options: Any,
) -> None:
    from contact_reach_ros.experiments.bench_planner import PlannerBench, bench_planner
    from contact_reach_ros.world.files import matching_scene_names

    names = tuple(scenes or matching_scene_names())
    bench = PlannerBench.quick(names, seed) if quick else PlannerBench(names, seed=seed, **options)
    settings = dataclasses.replace(bench.settings, cpus=cpus)
    bench = dataclasses.replace(bench, limit=limit, candidates=tuple(candidates), arm=arm, settings=settings)
    bench_planner(bench, file, plot)


def _model(against: list[str] | None = None, **options: Any) -> None:
    name = "bench_model" if against is None else "bench_referee"
    wrong = {"scenes", "plans"} & set(options) if against is None else {"states"} & set(options)
    if wrong:
        raise SettingsError("--scene and --plans go with --against, --states without it")
    _plain(name)(**options, **({} if against is None else {"against": against}))


def _faults(**options: Any) -> int:
    from contact_reach_ros.experiments.bench_faults import bench_faults

    return 1 if bench_faults(**options)["violations"] else 0


def _table1(report_only: bool = False, beside: Sequence[Path] = (), plot: Path | None = None, **options: Any) -> None:
    from contact_reach_ros.experiments.bench_table1 import Table1, bench_table1, report_table1
    from contact_reach_ros.experiments.output import read_report
    from contact_reach_ros.experiments.pictures import plot_table1

    running, options = _running(options)
    if not report_only:
        report = bench_table1(Table1(**_tuples(options)), running)
    elif running.file is None:
        raise SettingsError("--report-only needs --json FILE, the result of a finished run")
    else:
        report = report_table1(running.file)
    if plot is not None:
        plot_table1([report, *(read_report(file, "table1") for file in beside)], plot)


def _clutter(plot: Path | None = None, **options: Any) -> None:
    from contact_reach_ros.experiments.bench_clutter import Clutter, bench_clutter
    from contact_reach_ros.experiments.pictures import plot_clutter

    running, options = _running(options)
    report = bench_clutter(Clutter(**_tuples(options)), running)
    if plot is not None:
        plot_clutter(report, plot)


def _setting(others: Sequence[str] = (), scenes: Sequence[str] = (), plot: Path | None = None, **options: Any) -> None:
    from contact_reach_ros.experiments.bench_setting import Sweep, bench_setting
    from contact_reach_ros.experiments.pictures import plot_setting

    running, options = _running(options)
    given = {name: value for name, value in (("others", others), ("scenes", scenes)) if value}
    report = bench_setting(Sweep(**_tuples({**options, **given})), running)
    if plot is not None:
        plot_setting(report, plot)


def _page(parts: Sequence[str] = (), **options: Any) -> None:
    from contact_reach_ros.experiments.bench_page import bench_page

    bench_page(parts=parts, **options)


def _running(options: dict[str, Any]) -> tuple[Running, dict[str, Any]]:
    """How to run a grid, and the other options."""
    from contact_reach_ros.experiments.grid_run import Running

    own = ("file", "resume", "workers", "scheduler")
    return Running(**{name: options[name] for name in own if name in options}), {
        name: value for name, value in options.items() if name not in own
    }


def _fig5(output: Path = Path("docs/fig5.png"), file: Path | None = None, **options: Any) -> None:
    from contact_reach_ros.experiments.bench_fig5 import Fig5, bench_fig5

    bench_fig5(Fig5(**_tuples(options)), output, file)


def _tuples(options: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}
