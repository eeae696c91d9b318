"""The demo: bring the stack up, send a goal as a user's node would, watch, record, and judge what happened."""

from __future__ import annotations

import functools
import json
import sys
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import rclpy
from rclpy.node import Node

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import BagError, ContactReachError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.bringup import STARTUP_TIMEOUT_S
from contact_reach_ros.nodes.interruption import Interruption
from contact_reach_ros.nodes.managed import initialise
from contact_reach_ros.nodes.processes import RECORDER, StackOptions, page_address, processes
from contact_reach_ros.nodes.supervisor import Supervisor
from contact_reach_ros.nodes.watcher import DISCOVERY_S, Watcher
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.speed_limit import least_duration
from contact_reach_ros.recording.plot import SUCCESS_DISTANCE
from contact_reach_ros.recording.summary import Episode, EpisodeSummary
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.units import NANOSECONDS

INTERRUPTED = 130

_LOOK_S = 0.1
_LINE_S = 1.0
_DYING_S = 0.5
_AFTERWARDS_NS = 300_000_000
_LAG_S = 5.0
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
"""What the judgement of a demo rests on."""


@dataclass(frozen=True)
class DemoOptions:
    """What the command line asks for."""

    scene: str = "ball"
    seed: int = 0
    goal: tuple[float, float, float] | None = None
    lockstep: bool = False
    timeout: float = 30.0
    """Time of the robot's clock in which the goal must be reached, s."""
    settle: float = 1.2
    """Time of the robot's clock that is recorded after the goal was reached, s."""
    parameters: str = ""
    """Parameter file for the nodes; the package's own when empty."""
    view: bool = False
    """Whether to serve the viewer's page, and to stay up after the episode until Ctrl-C."""
    output: Path = Path("bags")
    json: Path | None = None


def run_demo(options: DemoOptions) -> int:
    """Run the demo; returns the exit code: 0 only if the goal was reached and nothing stopped the arm.

    Raises
    ------
    ContactReachError
        If the scene, the goal or the settings are refused.
    """
    goal = None if options.goal is None else np.array(options.goal)
    scene = make_scene(read_scene(options.scene), options.seed, goal)
    name = f"demo_{scene.name}_{options.seed}_{datetime.now():%Y%m%d_%H%M%S}"
    options.output.mkdir(parents=True, exist_ok=True)
    bag = options.output.resolve() / name
    stack = StackOptions(
        scene=options.scene,
        seed=options.seed,
        target="" if options.goal is None else " ".join(map(str, options.goal)),
        lockstep=options.lockstep,
        bag=str(bag),
        parameters=options.parameters,
        view=options.view,
    )
    interruption = Interruption()
    initialise(["demo"])
    node = Node("demo")
    supervisor = Supervisor(node, processes(stack), stack.parameter_file, interruption, bag.with_suffix(".log"))
    model = RobotModel()
    interrupted, failure = False, ""
    end_ns: int | None = None
    try:
        end_ns = _drive_to_goal(supervisor, Watcher(node, supervisor, model, scene.target), options)
        if options.view:
            _stay_up(supervisor)
    except KeyboardInterrupt:
        # With the page, it is the way to end what has been judged already.
        interrupted = end_ns is None or not options.view
    except ContactReachError as error:
        failure = str(error)
    finally:
        interruption.ignore()
        _say("ending the stack", done=True)
        supervisor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    if failure:
        print(f"demo: {failure}", file=sys.stderr)
    summary = _judge(bag, model, end_ns, options)
    if interrupted:
        return INTERRUPTED
    return 0 if summary is not None and summary.success and not failure else 1


def _drive_to_goal(supervisor: Supervisor, watcher: Watcher, options: DemoOptions) -> int:
    """Send the goal and watch until it is reached, the arm is stopped or the time is over; returns the last stamp."""
    began = time.monotonic()
    if options.view:
        _say(f"the page will be at {page_address(supervisor.parameter_file)}", done=True)
    supervisor.bring_up(STARTUP_TIMEOUT_S, lambda line: _say(f"{time.monotonic() - began:5.1f} s   {line}"))
    supervisor.wait_heard(RECORDER, _RECORDED, DISCOVERY_S)
    # Planner and recorder have to hear goals before there is one.
    watcher.wait_ready(listeners=2)
    _say(
        f"stack active after {time.monotonic() - began:.1f} s; goal {np.round(watcher.target, 3).tolist()} m", done=True
    )
    watcher.send_goal()
    sent_ns = watcher.stamp_ns
    reached_ns: int | None = None
    said_at = 0.0
    while True:
        supervisor.spin(_LOOK_S)
        supervisor.check()
        now = time.monotonic()
        if sys.stdout.isatty() or now - said_at >= _LINE_S:
            _say(watcher.line(sent_ns), done=not sys.stdout.isatty())
            said_at = now
        if reached_ns is None and watcher.distance <= SUCCESS_DISTANCE:
            reached_ns = watcher.stamp_ns
        settled = reached_ns is not None and watcher.stamp_ns - reached_ns > options.settle * NANOSECONDS
        if watcher.stopped:
            # When a dying process is the reason, it is named rather than the stop.
            supervisor.spin(_DYING_S)
            supervisor.check()
        if settled or watcher.stopped or watcher.stamp_ns - sent_ns > options.timeout * NANOSECONDS:
            _say(watcher.line(sent_ns), done=True)
            end_ns = watcher.stamp_ns
            # The bag's times may lag behind in simulated time: what is done to end the stack must come after the end.
            give_up = now + _LAG_S
            while watcher.stamp_ns < end_ns + _AFTERWARDS_NS and not watcher.stopped and time.monotonic() < give_up:
                supervisor.spin(_LOOK_S)
            return end_ns


def _stay_up(supervisor: Supervisor) -> None:
    """Leave the stack to the users of the page until Ctrl-C."""
    _say("the episode is over; the stack stays up for the page until Ctrl-C", done=True)
    while True:
        supervisor.check()
        supervisor.spin(_LOOK_S)


def _judge(bag: Path, model: RobotModel, end_ns: int | None, options: DemoOptions) -> EpisodeSummary | None:
    """Read the bag, print the summary and write plot and JSON; None if there is nothing to judge."""
    least = functools.partial(least_duration, planning=PlanningSettings(), impedance=ImpedanceSettings())
    try:
        episode = Episode(bag, least, end_ns)
    except BagError as error:
        print(f"no summary: {error}", file=sys.stderr)
        return None
    summary = episode.summary()
    verdict = "reached" if summary.reached else "not reached"
    if summary.safety_events:
        verdict += ", stopped"
    title = f"scene {options.scene}, seed {options.seed}: {verdict}"
    plot = episode.plot(bag.with_suffix(".png"), title, load_budget())
    report = {**summary.as_json(), "bag": str(bag), "plot": str(plot)}
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    _print_summary(verdict, summary, bag, plot)
    return summary


def _print_summary(verdict: str, summary: EpisodeSummary, bag: Path, plot: Path) -> None:
    trip, plan = summary.round_trip_us, summary.plan_ms
    rows = [
        ("goal", f"{verdict}, final error {1000 * summary.final_error_m:.1f} mm"),
        ("time", f"{summary.duration_s:.2f} s for {summary.distance_m:.3f} m, {summary.time_ratio:.2f} x the limit"),
        ("contact force", f"{summary.max_contact_force_N:.1f} N at most on one body"),
        ("external torque", f"{summary.max_external_torque_Nm:.1f} Nm at most on one joint"),
        ("ticks", f"{summary.ticks}, missed {summary.missed_ticks}"),
        ("round trip", f"p50 {trip['p50']:.0f}, p99 {trip['p99']:.0f}, p99.9 {trip['p999']:.0f} us"),
        ("plans", f"p50 {plan['p50']:.1f}, p95 {plan['p95']:.1f}, max {plan['max']:.1f} ms"),
        ("plan age", f"{summary.plan_age_ms_max:.0f} ms at most"),
        *(("stop", f"{stop['source']}: {stop['reason']}") for stop in summary.safety_events),
        ("bag", str(bag)),
        ("plot", str(plot)),
    ]
    print()
    for label, text in rows:
        print(f"  {label:16}{text}")


def _say(line: str, done: bool = False) -> None:
    """Show progress on one line of a terminal; elsewhere only what is done stays worth a line."""
    if sys.stdout.isatty():
        print(f"\r\033[K{line}", end="\n" if done else "", flush=True)
    elif done:
        print(line, flush=True)
