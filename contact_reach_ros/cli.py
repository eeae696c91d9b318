"""The command `contact-reach`."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from contact_reach_ros import __version__
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.planning.settings import BRAX_PIPELINES

BAD_INPUT = 2


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    # As in nodes/: before anything imports NumPy.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    options = _parser().parse_args(arguments)
    try:
        code = options.run(options)
        # What is still buffered: at the interpreter's end an error could not be caught.
        sys.stdout.flush()
        sys.exit(code)
    except BrokenPipeError:
        # Nobody reads on, as with `| head`. The code is the one that Rich, which writes the tables, has for it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except ContactReachError as error:
        print(f"contact-reach: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        sys.exit(130)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="contact-reach", description="Safe contact on the way to a goal, for a redundant arm under ROS 2."
    )
    parser.add_argument("--version", action="version", version=f"contact-reach {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    demo = commands.add_parser("demo", help="bring the stack up, send a goal, record a bag and judge the result")
    demo.add_argument("--scene", default="ball", help="a name in config/scenes, or a YAML file (default: ball)")
    demo.add_argument("--goal", nargs=3, type=float, metavar=("X", "Y", "Z"), help="flange position, m, base frame")
    demo.add_argument("--seed", type=int, default=0, help="seed of the scene and the sensor noise (default: 0)")
    demo.add_argument("--lockstep", action="store_true", help="simulated time that waits for every node")
    demo.add_argument("--timeout", type=float, default=30.0, help="time to reach the goal, s (default: 30)")
    demo.add_argument("--output", type=Path, default=Path("bags"), help="where bag, plot and log go (default: bags)")
    demo.add_argument("--parameters", default="", help="parameter file for the nodes (default: the package's)")
    demo.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    demo.add_argument("--view", action="store_true", help="serve a page for browsers, and stay up until Ctrl-C")
    demo.set_defaults(run=_demo)

    view = commands.add_parser("view", help="serve a page for browsers that shows the running stack, or a bag")
    view.add_argument("bag", nargs="?", type=Path, metavar="BAG", help="bag to show (default: the running stack)")
    view.add_argument("--port", type=int, help="port of the page (default: 8080)")
    view.add_argument("--address", help="address to listen on; others than 127.0.0.1 need a token (default: 127.0.0.1)")
    view.add_argument("--token", help="what browsers must know, see msg_docs/viewer.md (default: none)")
    view.add_argument("--bags", type=Path, help="folder whose bags the page offers (default: bags)")
    view.add_argument("--dark", action="store_true", default=None, help="a dark page")
    view.add_argument("--parameters", type=Path, help="parameter file for the viewer (default: the package's)")
    view.set_defaults(run=_view)

    doctor = commands.add_parser("doctor", help="check machine, software and the running stack before a run")
    doctor.add_argument("--quick", action="store_true", help="a short timer test, and no planner")
    doctor.add_argument("--parameters", default="", help="parameter file for the nodes (default: the package's)")
    doctor.add_argument(
        "--discovery", default="host", choices=("host", "subnet"), help="how far to look for nodes (default: host)"
    )
    doctor.add_argument("--bags", type=Path, default=Path("bags"), help="where bags will go (default: bags)")
    doctor.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    doctor.set_defaults(run=_doctor)

    report = commands.add_parser("report", help="a page about one bag or several: one HTML file for any browser")
    report.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="bags: directories or mcap files")
    report.add_argument("-o", "--output", type=Path, metavar="FILE", help="the page (default: beside the first bag)")
    report.add_argument("--json", type=Path, metavar="FILE", help="write the numbers as JSON")
    report.add_argument("--csv", type=Path, metavar="DIR", help="write tables of all samples")
    report.add_argument(
        "--with",
        dest="other",
        type=Path,
        metavar="FILE",
        help="parameter file: draw what it would have done, too",
    )
    report.set_defaults(run=_report)

    replay = commands.add_parser("replay", help="execute the nodes of a bag again, and say what differs")
    replay.add_argument("bag", type=Path, metavar="BAG", help="a bag: directory or mcap file")
    replay.add_argument("--recompute", action="store_true", help="run controller and observer on what they took in")
    replay.add_argument("--plan", type=int, metavar="N", help="make plan number N again instead")
    replay.add_argument("--with", dest="other", type=Path, metavar="FILE", help="parameter file with other settings")
    replay.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    replay.set_defaults(run=_replay)

    fault = commands.add_parser("fault", help="make things go wrong in the running stack", add_help=False)
    # Its own parser is made where rclpy may be imported, and knows the rest.
    fault.add_argument("-h", "--help", dest="wants_help", action="store_true")
    fault.add_argument("arguments", nargs=argparse.REMAINDER)
    fault.set_defaults(run=_fault)

    _add_bag(commands.add_parser("bag", help="look into a recording, or repair it").add_subparsers)

    bench = commands.add_parser("bench", help="measure on this machine")
    benches = bench.add_subparsers(required=True, metavar="WHAT")
    control = benches.add_parser(
        "control", help="arithmetic of controller and observer, per tick; with --seconds how the stack keeps its time"
    )
    control.add_argument("--ticks", type=int, default=20000, help="ticks of arithmetic to measure (default: 20000)")
    control.add_argument("--seconds", type=float, help="run the stack in real time for so long instead")
    control.add_argument("--load", type=int, default=0, help="with so many processes that never sleep (default: 0)")
    control.add_argument("--scene", default="ball", help="a name or a YAML file (default: ball)")
    control.add_argument(
        "--pages", type=int, default=0, help="compare with so many pages of the viewer open (default: 0, no viewer)"
    )
    control.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    control.set_defaults(run=_bench_control)
    bags = benches.add_parser("bags", help="lost messages, and what recording, replaying and analysing bags costs")
    bags.add_argument("--seconds", type=float, default=60.0, help="of recording five 1 kHz topics (default: 60)")
    bags.add_argument("--minutes", type=float, default=10.0, help="length of the bag to be analysed (default: 10)")
    bags.add_argument("--bag", type=Path, help="a recording to make it of (default: the sample of the package)")
    bags.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    bags.set_defaults(run=_bench_bags)
    foam = benches.add_parser(
        "foam", help="stiffness of the walls in plant and planner, and what simulating them costs"
    )
    foam.add_argument("--scene", default="wall", help="scene with walls: a name or a YAML file (default: wall)")
    foam.add_argument("--seed", type=int, default=0, help="seed of the scene (default: 0)")
    foam.add_argument("--force", type=float, default=10.0, help="what nodes are pressed with, N (default: 10)")
    foam.add_argument("--fit", action="store_true", help="find the planner's stiffness that agrees best")
    foam.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    foam.set_defaults(run=_bench_foam)
    observer = benches.add_parser(
        "observer", help="how soon pushes are seen, and how seldom free motion is taken for one"
    )
    observer.add_argument(
        "--minutes",
        type=float,
        default=60.0,
        help="simulated free motion in which false stops are counted (default: 60)",
    )
    observer.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    observer.add_argument("--plot", type=Path, metavar="FILE", help="draw pushes seen against false contacts")
    observer.set_defaults(run=_bench_observer)
    planner = benches.add_parser("planner", help="time and steps of plans along closed-loop runs, and comparisons")
    planner.add_argument("--scene", nargs="+", metavar="SCENE", help="names or YAML files (default: free, ball, wall)")
    planner.add_argument("--plans", type=int, default=50, help="warm-started plans per scene, at least (default: 50)")
    planner.add_argument("--seed", type=int, default=0, help="seed of the first run and of the solver (default: 0)")
    planner.add_argument(
        "--brax",
        nargs="*",
        default=list(BRAX_PIPELINES),
        choices=BRAX_PIPELINES,
        help="Brax's pipelines to compare with; each takes a minute to compile (default: all)",
    )
    planner.add_argument("--quick", action="store_true", help="show that it runs, with a tiny budget")
    planner.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    planner.add_argument(
        "--plot", type=Path, metavar="FILE", help="measure and draw how the time grows with k, H and nodes"
    )
    planner.set_defaults(run=_bench_planner)
    model = benches.add_parser("model", help="the planner's transfer model against the simulated robot")
    model.add_argument("--states", type=int, default=500, help="random states and actions (default: 500)")
    model.add_argument("--seed", type=int, default=0, help="of states and actions (default: 0)")
    model.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    model.set_defaults(run=_bench_model)
    chosen = benches.add_parser("setting", help="whole episodes for each value of one of the planner's settings")
    chosen.add_argument("name", help="a parameter of section 'planning', as in contact_weight; or latency")
    chosen.add_argument("values", nargs="+", metavar="VALUE", help="values that it takes")
    chosen.add_argument("--scene", nargs="+", default=["ball", "wall"], help="names or YAML files (default: ball wall)")
    chosen.add_argument("--targets", type=int, default=10, help="episodes per scene and value (default: 10)")
    chosen.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    chosen.set_defaults(run=_bench_setting)
    faults = benches.add_parser("faults", help="episodes in which things go wrong at random")
    faults.add_argument("--episodes", type=int, default=200, help="how many (default: 200)")
    faults.add_argument("--seed", type=int, default=0, help="of the first episode (default: 0)")
    faults.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    faults.set_defaults(run=_bench_faults)
    table1 = benches.add_parser("table1", help="the paper's Table I: every method in every scene")
    table1.add_argument(
        "--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: those of the paper)"
    )
    table1.add_argument(
        "--goals", nargs="+", metavar="GOAL", help="hold the orientation, or leave it free (default: both)"
    )
    table1.add_argument("--methods", nargs="+", metavar="METHOD", help="see docs/results.md (default: all)")
    table1.add_argument("--targets", type=int, default=10, help="targets per scene (default: 10)")
    table1.add_argument("--repeats", type=int, default=3, help="episodes per target (default: 3)")
    table1.add_argument("--seed", type=int, default=0, help="of the first target (default: 0)")
    table1.add_argument("--timeout", type=float, default=20.0, help="simulated time to reach a goal, s (default: 20)")
    table1.add_argument(
        "--latency", type=float, metavar="SECONDS", help="time of a plan (default: measured beforehand)"
    )
    table1.add_argument("--workers", type=int, metavar="W", help="processes (default: one per core)")
    table1.add_argument(
        "--scheduler", metavar="ADDRESS", help="a Dask scheduler, whose workers run the episodes instead"
    )
    table1.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    table1.add_argument("--resume", action="store_true", help="go on with the run of --json FILE")
    table1.add_argument("--results", type=Path, metavar="FILE", help="write a page of results, as docs/results.md")
    table1.add_argument("--report-only", action="store_true", help="run nothing, report what is in --json FILE")
    table1.add_argument(
        "--other", type=Path, metavar="FILE", help="with --report-only: a run with other goals, to compare with"
    )
    table1.set_defaults(run=_bench_table1)
    fig4 = benches.add_parser("fig4", help="the paper's Fig. 4: where the arm goes with each method, as a picture")
    fig4.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: free ball wall)")
    _add_figure_options(fig4, "contact_reach reference_posture rrt_star", "docs/fig4.png")
    fig4.set_defaults(run=_bench_fig4)
    fig5 = benches.add_parser("fig5", help="the paper's Fig. 5: contact force over time, with pictures of the arm")
    fig5.add_argument("--scene", default="wall", help="scene: a name or a YAML file (default: wall)")
    _add_figure_options(fig5, "contact_reach reference_posture", "docs/fig5.png")
    fig5.add_argument("--seeds", type=int, default=1, help="compare the largest forces of so many seeds (default: 1)")
    fig5.set_defaults(run=_bench_fig5)
    solver = benches.add_parser("solver", help="Algorithm 1 against plain CMA-ES and many gradient steps")
    solver.add_argument("--scene", default="wall", help="scene: a name or a YAML file (default: wall)")
    solver.add_argument("--seeds", type=int, default=20, help="states to start from (default: 20)")
    solver.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    solver.set_defaults(run=_bench_solver)
    return parser


def _add_bag(add_subparsers: Callable[..., Any]) -> None:
    actions = add_subparsers(required=True, metavar="WHAT")
    info = actions.add_parser("info", help="topics, rates, gaps and lost messages of a bag")
    info.add_argument("bag", type=Path, metavar="BAG", help="a directory with metadata.yaml, or one mcap file")
    info.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    info.set_defaults(run=_bag_info)
    repair = actions.add_parser("repair", help="make a complete bag of what can be read of a damaged one")
    repair.add_argument("bag", type=Path, metavar="BAG", help="a directory, or one mcap file; it is left as it is")
    repair.add_argument("--output", type=Path, metavar="DIR", help="the new bag (default: BAG_repaired)")
    repair.set_defaults(run=_bag_repair)


def _add_figure_options(figure: argparse.ArgumentParser, methods: str, output: str) -> None:
    """Options that both figures have, with the methods and the file that are the default."""
    figure.add_argument("--methods", nargs="+", metavar="METHOD", help=f"as for table1 (default: {methods})")
    figure.add_argument("--seed", type=int, default=0, help="of the target and what stands around (default: 0)")
    figure.add_argument("--latency", type=float, default=0.04, metavar="SECONDS", help="time of a plan (default: 0.04)")
    figure.add_argument("--renderer", default="auto", help="auto, egl, osmesa or matplotlib (default: auto)")
    figure.add_argument("--output", type=Path, default=Path(output), help=f"the picture (default: {output})")
    figure.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")


def _demo(options: argparse.Namespace) -> int:
    # rclpy is only needed, and only has to be installed, for the commands that use it.
    from contact_reach_ros.nodes.demo import DemoOptions, run_demo

    return run_demo(
        DemoOptions(
            scene=options.scene,
            seed=options.seed,
            goal=None if options.goal is None else tuple(options.goal),
            lockstep=options.lockstep,
            timeout=options.timeout,
            parameters=options.parameters,
            view=options.view,
            output=options.output,
            json=options.json,
        )
    )


def _view(options: argparse.Namespace) -> int:
    from contact_reach_ros.nodes.viewer import view

    chosen = {name: getattr(options, name) for name in ("bag", "port", "address", "token", "bags", "dark")}
    return view({name: value for name, value in chosen.items() if value is not None}, options.parameters)


def _doctor(options: argparse.Namespace) -> int:
    from contact_reach_ros.doctor.run import DoctorOptions, run_doctor

    return run_doctor(
        DoctorOptions(
            quick=options.quick,
            parameters=options.parameters,
            discovery=options.discovery,
            bags=options.bags,
            json=options.json,
        )
    )


def _bag_info(options: argparse.Namespace) -> int:
    from contact_reach_ros.recording.bag_info import bag_info

    bag_info(options.bag, options.json)
    return 0


def _bag_repair(options: argparse.Namespace) -> int:
    from contact_reach_ros.recording.repair import repair_bag

    repair = repair_bag(options.bag, options.output)
    for note in repair.notes:
        print(f"note: {note}")
    print(f"{repair.message_count} messages of {repair.topic_count} topics are in {repair.bag}")
    return 0


def _report(options: argparse.Namespace) -> int:
    from contact_reach_ros.recording.report import ReportOptions, run_report

    return run_report(ReportOptions(tuple(options.bags), options.output, options.json, options.csv, options.other))


def _replay(options: argparse.Namespace) -> int:
    from contact_reach_ros.errors import SettingsError
    from contact_reach_ros.recording.reexecution import RecomputeOptions, run_recompute

    if not options.recompute and options.plan is None:
        raise SettingsError(
            "replay needs --recompute here; to publish the messages of a bag again: "
            f"ros2 run contact_reach_ros replay {options.bag}"
        )
    return run_recompute(RecomputeOptions(options.bag, options.other, options.plan, options.json))


def _fault(options: argparse.Namespace) -> int:
    from contact_reach_ros.nodes.faults import make_parser

    arguments = ["--help"] if options.wants_help else options.arguments
    chosen = make_parser("contact-reach fault").parse_args(arguments)
    chosen.act(chosen)
    return 0


def _bench_control(options: argparse.Namespace) -> int:
    if options.seconds is not None:
        from contact_reach_ros.experiments.control_report import ControlBench
        from contact_reach_ros.nodes.control_bench import bench_control_stack

        bench = ControlBench(options.seconds, options.load, options.scene, pages=options.pages)
        bench_control_stack(bench, options.json)
        return 0
    from contact_reach_ros.experiments.bench_control import bench_control

    bench_control(options.ticks, options.json)
    return 0


def _bench_bags(options: argparse.Namespace) -> int:
    from contact_reach_ros.experiments.bench_bags import BagsBench, bench_bags

    bench_bags(BagsBench(options.seconds, options.minutes, options.bag), options.json)
    return 0


def _bench_foam(options: argparse.Namespace) -> int:
    from contact_reach_ros.experiments.bench_foam import bench_foam

    bench_foam(options.scene, options.seed, options.force, options.fit, options.json)
    return 0


def _bench_observer(options: argparse.Namespace) -> int:
    from contact_reach_ros.experiments.bench_observer import bench_observer

    bench_observer(options.minutes, options.json, options.plot)
    return 0


def _bench_planner(options: argparse.Namespace) -> int:
    from contact_reach_ros.experiments.bench_planner import PlannerBench, bench_planner
    from contact_reach_ros.scenes.files import matching_scene_names

    scenes = tuple(options.scene or matching_scene_names())
    if options.quick:
        bench = PlannerBench.quick(scenes, options.seed)
    else:
        bench = PlannerBench(scenes, plans=options.plans, seed=options.seed, brax=tuple(options.brax))
    bench_planner(bench, options.json, options.plot)
    return 0


def _bench_model(options: argparse.Namespace) -> int:
    from contact_reach_ros.experiments.bench_model import bench_model

    bench_model(options.states, options.seed, options.json)
    return 0


def _bench_setting(options: argparse.Namespace) -> int:
    import yaml

    from contact_reach_ros.experiments.bench_setting import bench_setting

    values = [yaml.safe_load(value) for value in options.values]
    bench_setting(options.name, values, options.scene, options.targets, options.json)
    return 0


def _bench_faults(options: argparse.Namespace) -> int:
    from contact_reach_ros.experiments.bench_faults import bench_faults

    return 1 if bench_faults(options.episodes, options.seed, options.json)["violations"] else 0


def _bench_table1(options: argparse.Namespace) -> int:
    from contact_reach_ros.errors import SettingsError
    from contact_reach_ros.experiments.bench_table1 import Table1, bench_table1, report_table1

    if options.report_only:
        if options.json is None:
            raise SettingsError("--report-only needs --json FILE, the result of a finished run")
        report_table1(options.json, options.results, options.other)
        return 0
    if options.other is not None:
        raise SettingsError("--other needs --report-only")
    standard = Table1()
    bench = Table1(
        scenes=tuple(options.scenes or standard.scenes),
        goals=tuple(options.goals or standard.goals),
        methods=tuple(options.methods or standard.methods),
        targets=options.targets,
        repeats=options.repeats,
        seed=options.seed,
        timeout=options.timeout,
        latency=options.latency,
        workers=options.workers,
        scheduler=options.scheduler,
    )
    bench_table1(bench, options.json, options.results, options.resume)
    return 0


def _bench_fig4(options: argparse.Namespace) -> int:
    from contact_reach_ros.experiments.bench_fig4 import Fig4, bench_fig4

    standard = Fig4()
    bench = Fig4(
        scenes=tuple(options.scenes or standard.scenes),
        methods=tuple(options.methods or standard.methods),
        seed=options.seed,
        latency=options.latency,
        renderer=options.renderer,
    )
    bench_fig4(bench, options.output, options.json)
    return 0


def _bench_fig5(options: argparse.Namespace) -> int:
    from contact_reach_ros.experiments.bench_fig5 import Fig5, bench_fig5

    bench = Fig5(
        scene=options.scene,
        methods=tuple(options.methods or Fig5().methods),
        seed=options.seed,
        seeds=options.seeds,
        latency=options.latency,
        renderer=options.renderer,
    )
    bench_fig5(bench, options.output, options.json)
    return 0


def _bench_solver(options: argparse.Namespace) -> int:
    from contact_reach_ros.experiments.bench_solver import bench_solver

    bench_solver(options.scene, options.seeds, options.json)
    return 0


if __name__ == "__main__":
    main()
