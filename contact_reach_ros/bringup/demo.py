"""The demo: bring the stack up, send a goal as a user's node would, watch, record, and judge what happened."""

from __future__ import annotations

import dataclasses
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.bringup.processes import resolved, stack_arm
from contact_reach_ros.bringup.settings import BringupOptions
from contact_reach_ros.bringup.stack_processes import StackProcesses
from contact_reach_ros.errors import BagError, ContactReachError, InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.goal_state import describe
from contact_reach_ros.planning.goal_progress import GoalPhase
from contact_reach_ros.resources import write_json
from contact_reach_ros.ros.client import StackClient
from contact_reach_ros.ros.interfaces import CONTROLLER, DEMO, VIEWER
from contact_reach_ros.ros.process import bare_node
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.settings import setting
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.viewer.settings import page_address
from contact_reach_ros.world.scene_file import read_scene

_say = partial(print, flush=True)
_LOOK_S = 0.1
_LINE_S = 1.0
_DYING_S = 0.5
_TIMEOUT_S = 60.0
"""Time of the robot's clock in which the goal must be reached, s."""
_SETTLE_S = 1.2
"""Time of the robot's clock that is recorded after the arm has settled, s."""
_MISSED_SHARE = 0.02
"""More missed ticks than a robot's driver ever has: the machine does not simulate the arm in real time."""


@dataclass(frozen=True)
class DemoOptions(BringupOptions):
    """Options of the command line; with `view` the stack stays up after the episode until Ctrl-C."""

    seed: int = setting(
        45, "seed of scene and sensor noise; with the default the arm touches the ball", minimum=0, maximum=2**31 - 1
    )
    goal: tuple[float, ...] | None = setting(None, "flange position, base frame", unit="m", optional_length=3)
    output: str = setting("bags", "where bag, plot and log go")
    json: str = setting("", "file for the result; none when empty")


def run_demo(options: DemoOptions) -> int:
    """Run the demo; returns the exit code: 0 only if the goal was reached and nothing stopped the arm.

    A run that failed because the machine missed too many ticks is repeated in lockstep, unless the page is served.
    Raises `ContactReachError` if the scene, the goal or the settings are refused.
    """
    code, missed = _run(options)
    if options.lockstep or options.view or code == 0 or missed <= _MISSED_SHARE:
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
    bag = Path(options.output).resolve() / name
    overrides = (
        f"driver:seed={options.seed}",
        *([] if options.goal is None else [f"driver:target={' '.join(map(str, options.goal))}"]),
        *(["driver:waits_for_goal=true"] if options.lockstep else []),
    )
    bringup = resolved(dataclasses.replace(options, bag=str(bag), overrides=overrides), DEMO)
    failure = ""
    with bare_node(DEMO) as node:
        goal = None if options.goal is None else np.array(options.goal)
        scene = make_scene(read_scene(options.scene), stack_arm(bringup), options.seed, goal)
        client = StackClient(node)
        with StackProcesses(client, bringup, bag.with_suffix(".log")) as stack:
            try:
                _drive_to_goal(stack, client, scene.target, options.view)
                if options.view:
                    _say("the episode is over; the stack stays up for the page until Ctrl-C")
                    with suppress(KeyboardInterrupt):
                        while True:
                            stack.watch(_LOOK_S)
            except InputError:
                # A stack that was discovered late is refused as one that was seen before the first process.
                raise
            except ContactReachError as error:
                failure = str(error)
            _say("ending the stack")
    if failure:
        print(f"demo: {failure}", file=sys.stderr)
    judged = _judge(bag, options)
    return (1, 0.0) if failure else judged


def _drive_to_goal(stack: StackProcesses, client: StackClient, target: Array, view: bool) -> None:
    """Send the goal (3,), m, and watch until it is reached or over, the arm is stopped or the time is up."""
    began = time.monotonic()
    stack.bring_up(_say)
    stack.wait_to_start(client)
    if view:
        client.wait_for(lambda: [] if VIEWER in client.settings else [f"{topics.SETTINGS.name} of the {VIEWER}"])
        _say(f"the page is at {page_address(client.settings[VIEWER]['port'])}")
    _say(f"stack active after {time.monotonic() - began:.1f} s; goal {np.round(target, 3).tolist()} m")
    client.send_goal(target, stamp_ns=stack.stamp_ns)
    client.wait_for(lambda: [] if client.goal_state else [topics.GOAL_STATE.name])
    end_ns, said, said_at = stack.stamp_ns + round(_TIMEOUT_S * NANOSECONDS), "", 0.0
    while (state := client.goal_state) is not None:
        now = time.monotonic()
        if client.stops or state.phase.is_over:
            # When a dying process is the reason, it is named rather than what followed.
            stack.watch(_DYING_S)
        if state.phase is GoalPhase.SETTLED:
            end_ns = min(end_ns, stack.stamp_ns + round(_SETTLE_S * NANOSECONDS))
        is_over = bool(client.stops) or state.phase.is_over or stack.stamp_ns > end_ns
        doing = f"stopped by {client.why_stopped}" if client.stops else client.safety[CONTROLLER]
        line = f"{describe(state)}; {doing}"
        if line != said and (is_over or now - said_at >= _LINE_S):
            _say(line)
            said, said_at = line, now
        if is_over:
            return
        stack.watch(_LOOK_S)


def _judge(bag: Path, options: DemoOptions) -> tuple[int, float]:
    """Read the bag, print its numbers and write plot and JSON; returns the exit code and the share of missed ticks."""
    # Loaded before the stack, they would delay its start by as much as a node does.
    from contact_reach_ros.report.bag import ReportBag, as_json, metrics, quantity
    from contact_reach_ros.report.plot import draw_episode

    try:
        found = ReportBag(bag, bag.name, _TIMEOUT_S, _SETTLE_S)
    except BagError as error:
        print(f"no summary of {bag}: {error}", file=sys.stderr)
        return 1, 0.0
    plot = bag.with_suffix(".png")
    draw_episode(found, f"scene {options.scene}, seed {options.seed}: {found.verdict}", plot)
    numbers = metrics(found)
    quantities = {name: quantity(*value) for name, value in numbers.items()}
    print()
    for label, text in {"result": found.verdict, **quantities, "bag": bag, "plot": plot}.items():
        print(f"  {label:40}{text}")
    if options.json:
        write_json(Path(options.json), as_json(found))
    missed, ticks = (numbers[name][0] for name in ("ticks missed", "ticks"))
    return (0 if found.good else 1), missed / (missed + ticks or 1.0)
