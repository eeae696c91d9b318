"""What a user does with a stack from the command line: `contact-reach goto`, `home`, `speed`, ...

Each returns its exit code: 0 done, 1 refused or not done; a `ContactReachError` stands for 2, no stack or bad input.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.planning.settings import SPEED_SCALE
from contact_reach_ros.ros.client import Outcome, StackClient
from contact_reach_ros.ros.interfaces import PLANNER
from contact_reach_ros.world.goal import POSE


def goto(
    client: StackClient,
    position: Sequence[float],
    rpy: Sequence[float] | None = None,
    wait: bool = False,
    timeout: float = 30.0,
) -> int:
    """Send a goal, and wait until it is taken or refused.

    Parameters
    ----------
    client
        Of the stack.
    position
        (3,) m of the flange, base frame.
    rpy
        Orientation of the flange: rotations (3,), rad, about the base frame's x, y and z axes, in that order. None
        where the planner's setting `goal_orientation` needs none.
    wait
        Also wait until the flange has settled there.
    timeout
        For that, s of the robot's clock.
    """
    client.wait_until_ready()
    orientation = client.settings[PLANNER].get("goal_orientation")
    if (rpy is not None) != (orientation == POSE):
        remedy = "give the orientation with --rpy" if rpy is None else "give no --rpy, or start it with pose"
        raise ContactReachError(f"the planner has goal_orientation = {orientation}: {remedy}")
    rotation = None if rpy is None else pin.rpy.rpyToMatrix(*rpy)
    return _go(client, np.array(position, float), rotation, wait, timeout)


def home(client: StackClient, wait: bool = False, timeout: float = 30.0) -> int:
    """Send the flange to where it is in the arm's home posture, as `goto`; the posture itself is the planner's choice.

    The orientation is that of the home posture if the planner takes orientations from goals.
    """
    from contact_reach_ros.arm.model import RobotModel

    client.wait_until_ready()
    return _go(client, *RobotModel(client.arm).tip_pose(np.array(client.arm.home)), wait, timeout)


def speed(client: StackClient, scale: float) -> int:
    """Let the planner use this share, 0.01 to 1, of the speed that its bounds permit, from the next plan on."""
    outcome = client.change(PLANNER, {SPEED_SCALE: scale})
    return _report(outcome if not outcome.done else Outcome(True, f"{SPEED_SCALE} = {scale:g}"))


def stop(client: StackClient) -> int:
    """Stop the arm."""
    return _report(client.stop())


def reset(client: StackClient, asked_ns: int) -> int:
    """Release all stops; while that is refused, as before the arm is at rest, it is tried again for some seconds.

    Those that came after the command was given stay, see `StackClient.release_all`.
    """
    return _report(client.release_all(asked_ns=asked_ns))


def _go(client: StackClient, position: Array, rotation: Array | None, wait: bool, timeout: float) -> int:
    outcome = client.go(position, rotation)
    if outcome.done and wait:
        print(outcome.text, flush=True)
        try:
            outcome = client.watch(timeout)
        except KeyboardInterrupt:
            print("the arm goes on to the goal; to stop it: contact-reach stop")
            raise
    return _report(outcome)


def _report(outcome: Outcome) -> int:
    print(outcome.text)
    return 0 if outcome.done else 1
