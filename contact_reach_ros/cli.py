"""The command `contact-reach`."""

from __future__ import annotations

import argparse
import errno
import io
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.removed import removed_command
from contact_reach_ros.resources import PACKAGE, VERSION

BAD_INPUT = 2


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    # As in nodes/: before anything imports NumPy.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Names may have letters that a terminal's encoding lacks.
            stream.reconfigure(errors="backslashreplace")
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        if refusal := removed_command(words):
            raise InputError(refusal)
        options = vars(_parser().parse_args(words))
        run = options.pop("run")
        code = run(**options)
        # What is still buffered: at the interpreter's end an error could not be caught.
        sys.stdout.flush()
        sys.exit(code or 0)
    except OSError as error:
        if error.errno not in (errno.EPIPE, errno.ENOSPC) or error.filename is not None:
            raise
        # Nobody reads on, as with `| head`, or there is no room for more.
        if error.errno != errno.EPIPE:
            print(f"contact-reach: the output cannot be written: {error.strerror}", file=sys.stderr)
        # The code is the one that Rich, which writes the tables, has for it.
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
    parser.add_argument("--version", action="version", version=f"contact-reach {VERSION}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, run: Callable[..., int | None], help_text: str) -> argparse.ArgumentParser:
        # Only options that are given reach `run`: their defaults are those of what it calls.
        command = commands.add_parser(name, help=help_text, argument_default=argparse.SUPPRESS)
        command.set_defaults(run=run)
        return command

    demo = add("demo", _demo, "bring the stack up, send a goal, record a bag and judge the result")
    _add_arm(demo)
    demo.add_argument("--scene", help="a name in config/scenes, or a YAML file (default: ball)")
    demo.add_argument("--goal", nargs=3, type=float, metavar=("X", "Y", "Z"), help="flange position, m, base frame")
    demo.add_argument("--seed", type=int, help="seed of the scene and the sensor noise (default: 45)")
    demo.add_argument("--lockstep", action="store_true", help="simulated time that waits for every node")
    demo.add_argument("--output", help="where bag, report and log go (default: bags)")
    demo.add_argument("--parameters", help="parameter file for the nodes (default: the package's)")
    demo.add_argument("--json", metavar="FILE", help="write the result as JSON")
    demo.add_argument("--view", action="store_true", help="serve a page for browsers, and stay up until Ctrl-C")

    up = add(
        "up",
        _later("bringup.bringup:up"),
        "start the stack and supervise it until Ctrl-C: what the executable bringup does",
    )
    _add_robot(up)
    up.add_argument("--scene", help="a name in config/scenes, or a YAML file (default: ball)")
    up.add_argument("--lockstep", action="store_true", help="simulated time that waits for every node")
    up.add_argument("--bag", metavar="DIR", help="record a bag (default: none)")
    up.add_argument("--no-driver", dest="driver", action="store_false", help="do not simulate: a real robot is there")
    _add_discovery(up, "who hears the nodes")
    _add_namespace(up)
    up.add_argument("--view", action="store_true", help="serve a page for browsers")
    up.add_argument(
        "--set",
        dest="overrides",
        nargs="+",
        action="extend",
        metavar="NODE:PARAMETER=VALUE",
        help="parameters besides the file's",
    )

    goto = add(
        "goto",
        _on_stack("bringup.commands:goto"),
        "send a goal to the running stack, and wait until it is taken or refused",
    )
    where = "flange position: x, y and z, m, base frame"
    goto.add_argument("position", nargs=3, type=float, metavar=("X", "Y", "Z"), help=where)
    goto.add_argument(
        "--rpy",
        nargs=3,
        type=float,
        metavar=("R", "P", "Y"),
        help="orientation of the flange: rotations about the base frame's x, y and z, rad; for a planner with "
        "goal_orientation: pose",
    )
    home = add(
        "home", _on_stack("bringup.commands:home"), "send the flange to where it is in the arm's home posture, as goto"
    )
    for moving in (goto, home):
        moving.add_argument("--wait", action="store_true", help="also wait until it has settled there")
        moving.add_argument("--timeout", type=_seconds, help="time for that, s of the robot's clock (default: 30)")
        _add_stack(moving)
    speed = add(
        "speed",
        _on_stack("bringup.commands:speed"),
        "let the planner of the running stack use a share of its speed, from the next plan on",
    )
    speed.add_argument("scale", type=float, metavar="SHARE", help="of the speed that the bounds permit, 0.01 to 1")
    _add_stack(speed)
    stop = add(
        "stop", _on_stack("bringup.commands:stop"), "stop the arm of the running stack, compliantly, until reset"
    )
    _add_stack(stop)
    reset = add(
        "reset",
        _on_stack("bringup.commands:reset"),
        "release all stops of the running stack; the arm then waits for a new goal",
    )
    # Now: until the stack is found, somebody may stop the arm.
    reset.set_defaults(asked_ns=time.time_ns())
    _add_stack(reset)

    identify = add(
        "identify",
        _identify,
        "fit tool, friction and torque offsets to a motion, and write parameter files",
    )
    where = "recording of free motion (default: the running stack moves the arm, for about a minute)"
    identify.add_argument("--bag", type=_path, metavar="BAG", help=where)
    identify.add_argument("--links", action="store_true", help="fit the weights of the links; the tool is as it is")
    identify.add_argument("--output", type=Path, metavar="FILE", help="parameter file (default: identified.yaml)")
    identify.add_argument("--parameters", type=Path, metavar="FILE", help="file whose other values it keeps")
    _add_stack(identify)

    view = add("view", _view, "serve a page for browsers that shows the running stack, or a bag")
    # Without a default of its own, argparse passes on the name of the suppressed one.
    view.add_argument("bag", nargs="?", default="", metavar="BAG", help="bag to show (default: the running stack)")
    _add_arm(view)
    view.add_argument("--port", type=int, help="port of the page, on this machine only (default: 8080)")
    view.add_argument("--parameters", type=Path, help="parameter file for the viewer (default: the package's)")
    _add_namespace(view)

    doctor = add(
        "doctor", _later("doctor.run:run_doctor"), "check machine, software and the running stack before a run"
    )
    _add_robot(doctor)
    _add_discovery(doctor, "how far to look for nodes")
    _add_namespace(doctor)
    _add_json(doctor)

    arm = commands.add_parser("arm", help="look at an arm's description").add_subparsers(required=True, metavar="WHAT")
    check = arm.add_parser("check", help="what a URDF says, lacks and leaves to rules")
    check.add_argument("name", metavar="ARM", help="a name, or the path of a URDF, xacro, MJCF or YAML file")
    check.add_argument("--table", type=Path, metavar="FILE", help="write all numbers as a table, a YAML file")
    check.set_defaults(run=_later("doctor.arm_check:check_arm"))

    report = add(
        "report", _later("report.page:run_report"), "a page about one bag or several: one HTML file for any browser"
    )
    report.add_argument("bags", nargs="+", type=_path, metavar="BAG", help="bags: directories or mcap files")
    report.add_argument("-o", "--output", type=Path, metavar="FILE", help="the page (default: beside the first bag)")
    _add_json(report)

    reexecute = add(
        "reexecute",
        _later("reexecution.command:run_reexecution"),
        "re-execute controller and observer, or the planner, on a bag, and report differences",
    )
    reexecute.add_argument("bag", type=_path, metavar="BAG", help="a bag: directory or mcap file")
    what = reexecute.add_mutually_exclusive_group()
    what.add_argument("--plan", type=int, metavar="N", help="solve plan number N again instead")
    what.add_argument("--with", dest="other", type=Path, metavar="FILE", help="parameter file with other settings")
    _add_json(reexecute)

    bag = commands.add_parser("bag", help="look into a recording").add_subparsers(required=True, metavar="WHAT")
    info = bag.add_parser("info", help="topics, rates, gaps and lost messages of a bag")
    info.add_argument("path", type=_path, metavar="BAG", help="a directory, or one mcap file")
    _add_json(info)
    info.set_defaults(run=_later("bags.command:bag_info"))

    fitness = _later("doctor.fitness:run_fitness")
    bench = add("bench", fitness, "how well this machine keeps the time of the running stack")
    seconds = "time in which missed ticks are counted, s; percentiles are of its last minute (default: 60)"
    bench.add_argument("--seconds", type=float, help=seconds)
    bench.add_argument("--load", type=int, help="programs beside the stack that never sleep (default: 0)")
    _add_json(bench)
    return parser


def _path(text: str) -> Path:
    if not text:
        # As of a variable that is not set; Path would make it the present folder.
        raise argparse.ArgumentTypeError("expected a path, not an empty text")
    return Path(text)


def _seconds(text: str) -> float:
    if not 0.0 < float(text) < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: expected a positive number")
    return float(text)


def _add_stack(command: argparse.ArgumentParser) -> None:
    _add_discovery(command, "how far to look for the stack")
    _add_namespace(command)


def _add_json(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", dest="file", type=Path, metavar="FILE", help="write the result as JSON")


def _add_discovery(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument("--discovery", choices=("host", "subnet"), help=f"{what} (default: host)")


def _add_arm(command: argparse.ArgumentParser) -> None:
    text = "name of the arm, or path of its URDF, xacro, MJCF or YAML file (default: the parameter file's, iiwa14)"
    command.add_argument("--arm", dest="robot", metavar="ARM", help=text)


def _add_robot(command: argparse.ArgumentParser) -> None:
    _add_arm(command)
    command.add_argument(
        "--state-rate", type=float, metavar="HZ", help="of joint states (default: the parameter file's)"
    )
    command.add_argument("--parameters", metavar="FILE", help="parameter file for the nodes (default: the package's)")
    command.add_argument("--adapter", metavar="KIND", help="adapter between controller and drive, see docs/adapter.md")


def _add_namespace(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--namespace", type=_namespace, metavar="NS", help="of the stack, such as left (default: none)"
    )


def _namespace(text: str) -> str:
    from contact_reach_ros.settings import NAME_RULE, ROS_NAME

    if text not in ("", "/") and not ROS_NAME.fullmatch(text):
        raise argparse.ArgumentTypeError(f"'{text}': expected a name {NAME_RULE}")
    return text


def _later(place: str) -> Callable[..., int | None]:
    """A function of this package, 'module:name', imported when it is called.

    The libraries of most take seconds, and rclpy only has to be installed for those that use it.
    """
    module, name = place.split(":")
    return lambda **options: getattr(import_module(f"{PACKAGE}.{module}"), name)(**options)  # type: ignore[no-any-return]


def _on_stack(place: str) -> Callable[..., Any]:
    """A function as `_later`, whose first argument is a client of the running stack."""

    def run(discovery: str = "host", namespace: str = "", **options: Any) -> Any:
        from contact_reach_ros.ros.client import connect

        with connect(discovery, namespace) as client:
            return _later(place)(client=client, **options)

    return run


def _demo(**options: Any) -> int:
    from contact_reach_ros.bringup.demo import DemoOptions, run_demo

    return run_demo(DemoOptions.from_mapping(options, "demo"))


def _identify(discovery: str = "host", namespace: str = "", **options: Any) -> int:
    from contact_reach_ros.identification.command import run_identification

    # With a bag, rclpy need not be installed.
    excite = _on_stack("bringup.excitation:excite")
    return run_identification(lambda: excite(discovery, namespace), **options)


def _view(parameters: Path | None = None, namespace: str = "", **chosen: Any) -> int:
    from contact_reach_ros.nodes.viewer import view

    return view(chosen, parameters, namespace)


if __name__ == "__main__":
    main()
