"""The running stack moves the arm through the goals of an identification, and its joint states are recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import Arm, Array, JointState, link_frames
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.drives.settings import FRANKA, FRANKA_STATES
from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.identification.recording import Recording, recording_of
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.obstacle_reader import ObstacleMarkerReader
from contact_reach_ros.messages.serialized import JointStateReader
from contact_reach_ros.messages.topics import Qos
from contact_reach_ros.ros.client import StackClient
from contact_reach_ros.ros.inbox import LARGEST_SCENE
from contact_reach_ros.ros.interfaces import ADAPTER, OBSERVER, PLANNER
from contact_reach_ros.world.collision import clearances, nearest
from contact_reach_ros.world.goal import POSE, Target
from contact_reach_ros.world.spheres import Spheres

_QOS = Qos(2000)
"""Joint states of two seconds may wait to be read."""
_HEARD_S = 4.0
_GOAL_S = 8.0
"""Time of the robot's clock for a goal; then comes the next one, reached or not."""
CLEARANCE = 0.1
"""Least distance of obstacles from the arm on its way, m."""

_GOALS = (
    ((0.00, 0.12, 0.05), (0.0, 0.0, 1.5)),
    ((0.05, -0.12, -0.05), (0.5, 0.0, -1.5)),
    ((-0.10, 0.10, 0.00), (-0.5, 0.0, 1.0)),
    ((0.05, 0.00, 0.10), (0.0, 0.7, -1.0)),
    ((0.00, -0.15, 0.00), (0.0, -0.5, 0.0)),
    ((-0.05, 0.15, 0.10), (0.5, 0.5, 1.5)),
    ((0.05, 0.00, -0.05), (-0.5, -0.5, -1.5)),
    ((-0.08, -0.12, 0.08), (0.0, 0.5, 1.0)),
    ((0.05, 0.12, 0.00), (0.3, -0.5, -1.0)),
    ((0.00, 0.00, 0.00), (0.0, 0.0, 0.0)),
)
"""Offsets from the home pose: m in the base frame, and rotations in that of the tip, rad."""
_TOLERANCE = 0.002
"""How deep the arm's capsules may lie in each other, m: they are rounder than links."""

_STEPS = 20
"""Postures on the way between two goals at which the clearance is checked."""


def excite(client: StackClient) -> tuple[Recording, Mapping[str, Mapping[str, Any]]]:
    """Move the arm of a client's stack and return its states, and the settings of the nodes.

    On Ctrl-C the arm is held where it is. Raises `ContactReachError` if the stack does not answer, the arm may not be
    moved, has no room, or is stopped on the way.
    """
    client.wait_until_ready()
    client.wait_for(lambda: [] if OBSERVER in client.settings else ["settings of the observer"])
    is_franka = client.settings.get(ADAPTER, {}).get("kind") == FRANKA
    topic = topics.JOINT_STATES._replace(name=FRANKA_STATES) if is_franka else topics.JOINT_STATES
    reader = JointStateReader(client.arm.joint_names, topic.name)
    states: list[JointState] = []
    client.inbox.add(topic, lambda data: states.append(reader.read(data)), _QOS, serialized=True)
    client.wait_for(lambda: [] if states else [topic.name])
    if client.settings[PLANNER].get("goal_orientation") != POSE:
        raise InputError(
            "the motion turns the wrist: start the stack with --set planner:goal_orientation=pose, or give a bag"
        )
    check_clearance(client.arm, states[-1].q, _obstacles(client))
    states.clear()
    before = _contacts(client)
    try:
        _move(client)
    except KeyboardInterrupt:
        if states:
            client.send_goal(*RobotModel(client.arm).tip_pose(states[-1].q))
            client.until(lambda: client.goal_state is not None, _HEARD_S)
        print("interrupted: the arm is held where it is", flush=True)
        raise
    if contacts := _contacts(client) - before:
        print(f"the observer reported contact {contacts} times; what touched the arm spoils the fit", flush=True)
    return recording_of(states), client.settings


def _obstacles(client: StackClient) -> Spheres:
    """What stands around the arm; raises `InputError` if that has to be known and is not."""
    reader = ObstacleMarkerReader(client.arm.base_frame)
    found: list[Spheres] = []
    client.inbox.add(
        topics.OBSTACLES, lambda data: found.append(reader.read(data)), serialized=True, largest=LARGEST_SCENE
    )
    if not client.until(lambda: bool(found), _HEARD_S) and client.settings[PLANNER].get("require_obstacles", True):
        raise InputError("nothing heard on obstacles: it is not known whether the arm has room")
    return found[-1] if found else Spheres.none()


def _contacts(client: StackClient) -> int:
    """Number of contacts that the observer has reported."""
    return int(client.diagnostics.get(OBSERVER, {}).get("contacts", 0))


def _move(client: StackClient) -> None:
    """Send one goal after the other; raises `ContactReachError` if one is refused, or the arm is stopped."""
    ways = goals(client.arm)
    for number, (position, rotation) in enumerate(ways, 1):
        print(f"goal {number} of {len(ways)}", flush=True)
        outcome = client.go(position, rotation)
        if outcome.done:
            outcome = client.watch(_GOAL_S)
        if client.stops or not (outcome.done or outcome.text.startswith("not settled")):
            hint = "" if client.stops else "; if nothing touched the arm, move it more slowly: contact-reach speed 0.5"
            raise ContactReachError(f"goal {number} of the motion: {outcome.text}{hint}")


def goals(arm: Arm) -> list[tuple[Array, Array]]:
    """Positions (3,), m, and rotations (3, 3) of the tip in the base frame."""
    rotations, origins = link_frames(arm, arm.home)
    return [(origins[-1] + offset, rotations[-1] @ pin.exp3(np.array(turn))) for offset, turn in _GOALS]


def check_clearance(arm: Arm, q: Array, obstacles: Spheres) -> None:
    """Check that the arm has room for the goals, on straight ways of the joints between them from `q` (n,), rad.

    Raises `InputError` if a goal cannot be reached, or an obstacle is nearer than `CLEARANCE`.
    """
    before = q
    for number, (position, rotation) in enumerate(goals(arm), 1):
        goal = Target(position, rotation).of_task(arm.task)
        postures = solve_ik(arm, position, goal.rotation, np.stack([before, np.array(arm.home)]), 0.05, goal.only_axis)
        if not len(postures):
            raise InputError(f"goal {number} of the motion is out of this arm's reach: give a bag instead (--bag)")
        between = before + np.linspace(0.0, 1.0, _STEPS)[:, None] * (postures[0] - before)
        gap = min(float(clearances(arm, each, obstacles).min()) for each in between) if len(obstacles) else CLEARANCE
        if gap < CLEARANCE:
            raise InputError(
                f"an obstacle would be {gap:.2f} m from the arm on the way to goal {number}; the motion needs "
                f"{CLEARANCE:g} m: clear the space, or give a bag of another motion (--bag)"
            )
        worst = min(nearest(arm, between, obstacles.environment), default=None)
        if worst is not None and worst.distance < -_TOLERANCE:
            raise InputError(f"on the way to goal {number} {worst}; give a bag of another motion (--bag)")
        before = postures[0]
