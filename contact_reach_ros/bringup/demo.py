"""The demo: bring the stack up, send a goal as a user's node would, watch, record, and judge what happened."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.bringup.follower import Follower
from contact_reach_ros.bringup.processes import BringupOptions, page_address, processes, stack_arm
from contact_reach_ros.bringup.stack_processes import StackProcesses
from contact_reach_ros.errors import BagError, ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.report.bag import ReportBag, as_json, metrics, quantity, read_report_bag
from contact_reach_ros.report.episode import SUCCESS_DISTANCE
from contact_reach_ros.report.page import page
from contact_reach_ros.resources import write_text
from contact_reach_ros.ros.graph import refuse_beside_another
from contact_reach_ros.ros.interfaces import DEMO
from contact_reach_ros.ros.process import bare_node
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.scene_file import read_scene

INTERRUPTED = 130

_LOOK_S = 0.1
_LINE_S = 1.0
_DYING_S = 0.5
_AFTERWARDS_NS = 300_000_000
_LAG_S = 5.0
_SETTLE_S = 1.2
"""Time of the robot's clock that is recorded after the goal was reached, s."""
_MISSED_SHARE = 0.02
"""More missed ticks than a robot's driver ever has: the machine does not simulate the arm in real time."""
_RECORDED = (
    topics.JOINT_STATES,
    topics.COMMANDS,
    topics.EXTERNAL_TORQUE,
    topics.SIM_CONTACTS,
    topics.SAFETY_STATE,
    topics.DIAGNOSTICS,
    topics.REFERENCE_POSE,
    topics.GOAL_POSE,
)
"""Topics from which a demo is judged."""


@dataclass(frozen=True)
class DemoOptions:
    """Options of the command line."""

    arm: str = ""
    """Name of the arm, or the path of its file; empty leaves it to the parameter file."""
    scene: str = "ball"
    seed: int = 45
    """With which the arm touches the ball."""
    goal: tuple[float, float, float] | None = None
    lockstep: bool = False
    timeout: float = 30.0
    """Time of the robot's clock in which the goal must be reached, s."""
    parameters: str = ""
    """Parameter file for the nodes; the package's own when empty."""
    view: bool = False
    """Whether to serve the viewer's page, and to stay up after the episode until Ctrl-C."""
    output: Path = Path("bags")
    json: Path | None = None


def run_demo(options: DemoOptions) -> int:
    """Run the demo; returns the exit code: 0 only if the goal was reached and nothing stopped the arm.

    A run that failed because the machine missed too many ticks is repeated in lockstep, unless the page is served.
    Raises `ContactReachError` if the scene, the goal or the settings are refused.
    """
    code, missed = _run(options)
    if options.lockstep or options.view or code in (0, INTERRUPTED) or missed <= _MISSED_SHARE:
        return code
    print(
        f"\nThis machine is too slow, or too busy, to simulate the arm in real time: {missed:.0%} of the ticks were "
        "missed. The same demo again in simulated time (--lockstep):\n",
        flush=True,
    )
    code, _ = _run(dataclasses.replace(options, lockstep=True))
    return code


def _run(options: DemoOptions) -> tuple[int, float]:
    """Run the demo once; returns the exit code and the share of missed ticks, 0 after a failure of the stack."""
    name = f"demo_{read_scene(options.scene).name}_{options.seed}_{datetime.now():%Y%m%d_%H%M%S}"
    bag = options.output.resolve() / name
    bringup = BringupOptions(
        scene=options.scene,
        lockstep=options.lockstep,
        bag=str(bag),
        parameters=options.parameters,
        view=options.view,
        robot=options.arm,
        overrides=(
            f"driver:seed={options.seed}",
            *([] if options.goal is None else [f"driver:target={' '.join(map(str, options.goal))}"]),
            *(["driver:waits_for_goal=true"] if options.lockstep else []),
        ),
    )
    table = processes(bringup)
    interrupted, failure = False, ""
    end_ns: int | None = None
    with bare_node(DEMO) as node:
        began = time.monotonic()
        goal = None if options.goal is None else np.array(options.goal)
        model = RobotModel(stack_arm(bringup))
        scene = make_scene(read_scene(options.scene), model.arm, options.seed, goal)
        refuse_beside_another(node, [process.name for process in table], began)
        options.output.mkdir(parents=True, exist_ok=True)
        follower = Follower(node, model, scene.target, _RECORDED)
        log = bag.with_suffix(".log")
        with StackProcesses(follower, table, bringup.parameter_file, log) as stack:
            try:
                end_ns = _drive_to_goal(stack, follower, options)
                if options.view:
                    _stay_up(stack)
            except KeyboardInterrupt:
                # With the page, Ctrl-C ends a stack whose episode is over.
                interrupted = end_ns is None or not options.view
            except ContactReachError as error:
                failure = str(error)
            _say("ending the stack", done=True)
    if failure:
        print(f"demo: {failure}", file=sys.stderr)
    found = _judge(bag, end_ns, options)
    if interrupted:
        return INTERRUPTED, 0.0
    if failure or found is None:
        return 1, 0.0
    missed, ticks = (metrics(found)[name][0] for name in ("ticks missed", "ticks"))
    return (0 if found.good else 1), missed / (missed + ticks or 1.0)


def _drive_to_goal(stack: StackProcesses, follower: Follower, options: DemoOptions) -> int:
    """Send the goal and watch until it is reached, the arm is stopped or the time is over; returns the last stamp."""
    began = time.monotonic()
    if options.view:
        _say(f"the page will be at {page_address(stack.parameter_file)}", done=True)
    stack.bring_up(lambda line: _say(f"{time.monotonic() - began:5.1f} s   {line}"))
    follower.wait_to_start(stack)
    goal = np.round(follower.target, 3).tolist()
    _say(f"stack active after {time.monotonic() - began:.1f} s; goal {goal} m", done=True)
    follower.send_goal(follower.target, stamp_ns=follower.stamp_ns)
    sent_ns = follower.stamp_ns
    reached_ns: int | None = None
    said_at = 0.0
    while True:
        stack.watch(_LOOK_S)
        now = time.monotonic()
        if sys.stdout.isatty() or now - said_at >= _LINE_S:
            _say(follower.line(sent_ns), done=not sys.stdout.isatty())
            said_at = now
        if reached_ns is None and follower.distance <= SUCCESS_DISTANCE:
            reached_ns = follower.stamp_ns
        settled = reached_ns is not None and follower.stamp_ns - reached_ns > _SETTLE_S * NANOSECONDS
        if follower.stops:
            # When a dying process is the reason, it is named rather than the stop.
            stack.watch(_DYING_S)
        if settled or follower.stops or follower.stamp_ns - sent_ns > options.timeout * NANOSECONDS:
            _say(follower.line(sent_ns), done=True)
            end_ns = follower.stamp_ns
            # The bag's times may lag behind in simulated time: calls that end the stack must come after the end.
            give_up = now + _LAG_S
            while follower.stamp_ns < end_ns + _AFTERWARDS_NS and not follower.stops and time.monotonic() < give_up:
                follower.spin(_LOOK_S)
            return end_ns


def _stay_up(stack: StackProcesses) -> None:
    """Leave the stack to the users of the page until Ctrl-C."""
    _say("the episode is over; the stack stays up for the page until Ctrl-C", done=True)
    while True:
        stack.watch(_LOOK_S)


def _judge(bag: Path, end_ns: int | None, options: DemoOptions) -> ReportBag | None:
    """Read the bag, print its numbers and write its report and JSON; None if there is nothing to judge."""
    try:
        found = read_report_bag(bag, bag.name, end_ns, options.timeout, _SETTLE_S)
    except BagError as error:
        print(f"no summary of {bag}: {error}", file=sys.stderr)
        return None
    report = bag.with_suffix(".html")
    write_text(report, page([found]))
    numbers = {name: quantity(*value) for name, value in metrics(found).items()}
    print()
    for label, text in {"result": found.verdict, **numbers, "bag": bag, "report": report}.items():
        print(f"  {label:40}{text}")
    if options.json is not None:
        write_text(options.json, json.dumps(as_json(found), indent=2, allow_nan=False) + "\n")
    return found


def _say(line: str, done: bool = False) -> None:
    """Show progress on one line of a terminal; elsewhere print finished steps only."""
    if sys.stdout.isatty():
        print(f"\r\033[K{line}", end="\n" if done else "", flush=True)
    elif done:
        print(line, flush=True)
