"""The running stack moves the arm through the goals of an identification, and its joint states are recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.identification.recording import Recording, recording_of
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import JointStateReader
from contact_reach_ros.messages.topics import Qos
from contact_reach_ros.ros.client import PLANNER, StackClient, connect
from contact_reach_ros.world.goal import POSE

_OBSERVER = "observer"
_QOS = Qos(2000)
"""Joint states of two seconds may wait to be read."""
_HEARD_S = 4.0
_GOAL_S = 8.0
"""Time of the robot's clock for a goal; then comes the next one, reached or not."""

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


def excite(discovery: str = "host", namespace: str = "") -> tuple[Recording, Mapping[str, Mapping[str, Any]]]:
    """Move the arm and return its states, and the settings of the nodes.

    On Ctrl-C the arm is held where it is. Raises `ContactReachError` if no stack answers, the arm may not be moved, a
    goal is refused, or the arm is stopped on the way.
    """
    with connect(discovery, namespace) as client:
        client.wait_for(client.missing)
        client.wait_for(lambda: [] if _OBSERVER in client.settings else ["settings of the observer"])
        reader = JointStateReader(client.arm.joint_names, topics.JOINT_STATES.name, with_effort=True)
        states: list[JointState] = []
        client.inbox.add(topics.JOINT_STATES, lambda data: states.append(reader.read(data)), _QOS, serialized=True)
        client.wait_for(lambda: [] if states else [topics.JOINT_STATES.name])
        if client.settings[PLANNER].get("goal_orientation") != POSE:
            raise InputError(
                "the motion turns the wrist: start the stack with --set planner:goal_orientation=pose, or give a bag"
            )
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


def _contacts(client: StackClient) -> int:
    """Number of contacts that the observer has reported."""
    return int(client.diagnostics.get(_OBSERVER, {}).get("contacts", 0))


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
    return [(origins[-1] + offset, rotations[-1] @ Rotation.from_rotvec(turn).as_matrix()) for offset, turn in _GOALS]
