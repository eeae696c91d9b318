"""The running stack moves the arm through the goals of an identification, and its joint states are recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rclpy.node import Node

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.bringup.operating import Operator
from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.identification.excitation import check_clearance, goals
from contact_reach_ros.identification.recording import Recording, recording_of
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.obstacle_reader import AssumedMaterial, ObstacleMarkerReader
from contact_reach_ros.messages.serialized import JointStateReader
from contact_reach_ros.messages.topics import Qos
from contact_reach_ros.planning.node_settings import PlannerNodeSettings
from contact_reach_ros.ros.inbox import LARGEST_SCENE
from contact_reach_ros.ros.interfaces import OPERATOR
from contact_reach_ros.ros.process import bare_node
from contact_reach_ros.world.spheres import Spheres

_DEPTH = 2000
"""Joint states that may wait to be read: those of two seconds."""
_HEARD_S = 4.0
_GOAL_S = 8.0
"""Time of the robot's clock for a goal; then comes the next one, reached or not."""
_NEEDED = ("planner", "observer")


def excite(discovery: str = "host", namespace: str = "") -> tuple[Recording, Mapping[str, Mapping[str, Any]]]:
    """Move the arm and return its states, and the settings of the nodes.

    On Ctrl-C the arm is held where it is. Raises `ContactReachError` if no stack answers, the arm may not be moved, has
    no room, or is stopped on the way.
    """
    with bare_node(OPERATOR, discovery, namespace=namespace) as node:
        operator = _Exciter(node)
        try:
            operator.prepare()
            try:
                operator.move()
            except KeyboardInterrupt:
                operator.hold()
                print("interrupted: the arm is held where it is", flush=True)
                raise
            return recording_of(operator.states), operator.settings
        finally:
            operator.close()


class _Exciter(Operator):
    """A user's node that sends the goals, and hears joint states and obstacles.

    Attributes
    ----------
    states
        Joint states so far.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self.states: list[JointState] = []
        self._obstacles: Spheres | None = None

    def prepare(self) -> None:
        """Wait until everything is heard, and check that the arm may be moved.

        Raises `ContactReachError` if it may not.
        """
        self.find_stack()
        self._until(lambda: all(name in self.settings for name in _NEEDED), _HEARD_S)
        missing = [name for name in _NEEDED if name not in self.settings]
        if missing:
            raise ContactReachError(f"no settings from {missing[0]}: contact-reach doctor")
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name, with_effort=True)
        material = AssumedMaterial.of(PlannerNodeSettings())
        self._obstacle_reader = ObstacleMarkerReader(self.arm.base_frame, material)
        self._inbox.add(topics.JOINT_STATES, self._on_state, Qos(_DEPTH), serialized=True)
        self._inbox.add(topics.OBSTACLES, self._on_obstacles, serialized=True, largest=LARGEST_SCENE)
        self._until(lambda: bool(self.states) and self._obstacles is not None, _HEARD_S)
        if not self.states:
            raise ContactReachError("no joint states: contact-reach doctor")
        if self.settings["planner"].get("goal_orientation") != "pose":
            raise InputError(
                "the motion turns the wrist: start the stack with --set planner:goal_orientation=pose, or give a bag"
            )
        if self._obstacles is None and self.settings["planner"].get("require_obstacles", True):
            raise InputError("nothing heard on obstacles: it is not known whether the arm has room")
        check_clearance(self.arm, self.states[-1].q, self._obstacles or Spheres.none())
        self.states.clear()

    def move(self) -> None:
        """Send one goal after the other; raises `ContactReachError` if one is refused, or the arm is stopped."""
        ways = goals(self.arm)
        for number, (position, rotation) in enumerate(ways, 1):
            print(f"goal {number} of {len(ways)}", flush=True)
            outcome = self.go(position, rotation)
            if outcome.done:
                outcome = self.watch(_GOAL_S)
            if self.stops or not (outcome.done or outcome.text.startswith("not settled")):
                hint = (
                    "" if self.stops else "; if nothing touched the arm, move it more slowly: contact-reach speed 0.5"
                )
                raise ContactReachError(f"goal {number} of the motion: {outcome.text}{hint}")

    def hold(self) -> None:
        """Make the present pose the goal, and wait until the planner has it."""
        if self.states:
            self.send_goal(*RobotModel(self.arm).tip_pose(self.states[-1].q))
            self._until(lambda: self._goal_state is not None, _HEARD_S)

    def _on_state(self, data: bytes) -> None:
        self.states.append(self._reader.read(data))

    def _on_obstacles(self, data: bytes) -> None:
        self._obstacles = self._obstacle_reader.read(data)
