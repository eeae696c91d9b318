"""A user's node: hears what the stack reports, sends goals, and calls services."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from contact_reach_ros.arms import load_arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.bringup.goal_judgement import judge_goal
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose
from contact_reach_ros.messages.goal_state import describe, read_goal_state
from contact_reach_ros.messages.safety_state import is_stopped
from contact_reach_ros.messages.settings import read_settings
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.parameter_files import arm_in
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.ros.inbox import Inbox
from contact_reach_ros.ros.interfaces import OPERATOR, STOPPABLE
from contact_reach_ros.ros.process import bare_node
from contact_reach_ros.ros.qos import qos_profile
from contact_reach_ros.ros.stopping import Outcome
from contact_reach_ros.world.orientations import POSE

_PLANNER, _CONTROLLER = "planner", "controller"

_LOOK_S = 0.05
_FOUND_S = 4.0
"""Longer than participants take to announce themselves again, where the first answer was lost."""
_ANSWER_S = 3.0
_SETTLED_S = 1.0
"""Time without a new safety state after which all nodes have been heard."""
_JUDGED_S = 8.0
"""Longest time until diagnostics, which come once a second, show whether a goal is taken."""
_SILENCE_S = 5.0


@contextmanager
def operating(discovery: str, namespace: str) -> Iterator[Operator]:
    """Make an operator's node that looks for the stack within `discovery`, in a namespace."""
    with bare_node(OPERATOR, discovery, namespace=namespace) as node:
        operator = Operator(node)
        try:
            yield operator
        finally:
            operator.close()


class Operator:
    """A user's node.

    Attributes
    ----------
    arm
        The planner's, once its settings were heard.
    diagnostics
        Newest values by name, of each node.
    stops
        What stopped the arm, by node.
    settings
        Of each node that reported them, by full name.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.arm = load_arm()
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._goals = node.create_publisher(
            topics.GOAL_POSE.type, topics.GOAL_POSE.name, qos_profile(topics.GOAL_POSE.qos)
        )
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.stops: dict[str, str] = {}
        self._heard: set[str] = set()
        self._goal_ns = 0
        self._goal_state: GoalState | None = None
        """Of the goal with this stamp."""
        self.settings: dict[str, dict[str, Any]] = {}
        # Whoever sends malformed messages reports them itself.
        self._inbox = Inbox(node, lambda what, error: None)
        self._inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        self._inbox.add(topics.DIAGNOSTICS, self._on_diagnostics)
        self._inbox.add(topics.GOAL_STATE, self._on_goal_state, topics.ALL_EVENTS)
        self._inbox.add(topics.SETTINGS, self._on_settings, topics.ALL_EVENTS)

    def close(self) -> None:
        """Leave the executor."""
        self._executor.shutdown()

    def find_service(self, service: str) -> list[str]:
        """Wait until the controller offers a service, or for a second longer than until another node does.

        Returns the stoppable nodes, those that offer it first. Raises `ContactReachError` if no node does within some
        seconds.
        """
        clients = [self._node.create_client(Trigger, f"{name}/{service}") for name in STOPPABLE]
        found = self._until(lambda: any(client.service_is_ready() for client in clients), _FOUND_S)
        if found:
            self._until(clients[STOPPABLE.index(_CONTROLLER)].service_is_ready, _SETTLED_S)
        offers = {name: client.service_is_ready() for name, client in zip(STOPPABLE, clients, strict=True)}
        for client in clients:
            self._node.destroy_client(client)
        if not found:
            raise ContactReachError(_no_stack(self._node))
        return sorted(STOPPABLE, key=lambda name: not offers[name])

    def find_stack(self) -> None:
        """Wait until planner and controller have reported what they do, and the planner hears goals.

        Raises `ContactReachError` if they do not within some seconds.
        """
        wanted = (_PLANNER, _CONTROLLER)

        def is_there() -> bool:
            has_spoken = all(name in self.diagnostics for name in wanted) and _PLANNER in self.settings
            return has_spoken and bool(self._goals.get_subscription_count())

        if not self._until(lambda: bool(self._heard or self.diagnostics), _FOUND_S):
            raise ContactReachError(_no_stack(self._node))
        if not self._until(is_there, _FOUND_S):
            missing = [name for name in wanted if name not in self.diagnostics]
            raise ContactReachError(f"no answer from {missing[0] if missing else _PLANNER}: contact-reach doctor")

    def hear_everybody(self) -> None:
        """Wait until the safety states of the controller and of all who publish one are known, and no new one comes.

        Raises `ContactReachError` if the controller does not report it.
        """
        known: Any = None
        since = time.monotonic()
        deadline = since + _FOUND_S
        while time.monotonic() < deadline:
            self._spin()
            # The last events of each come first, perhaps in pieces: of a stop before that of its release.
            heard, publishers = len(self._heard), self._node.count_publishers(topics.SAFETY_STATE.name)
            if known != (heard, self.stops) or heard < publishers or _CONTROLLER not in self._heard:
                known, since = (heard, dict(self.stops)), time.monotonic()
            elif time.monotonic() > since + _SETTLED_S:
                return
        if _CONTROLLER not in self._heard:
            raise ContactReachError("no safety state from the controller: contact-reach doctor")

    def check_orientation(self, has_one: bool) -> None:
        """Raise `ContactReachError` if a goal has an orientation that the planner would ignore, or lacks one."""
        orientation = self.settings[_PLANNER].get("goal_orientation")
        if has_one == (orientation == POSE):
            return
        if has_one:
            raise ContactReachError(
                f"the planner has goal_orientation = {orientation}: give no --rpy, or start it with "
                "goal_orientation = pose"
            )
        raise ContactReachError("the planner has goal_orientation = pose: give the orientation with --rpy")

    def go(self, position: Array, rotation: Array | None) -> Outcome:
        """Send a goal (3,), m, (3, 3), unless the arm is stopped; returns whether it is taken."""
        self.hear_everybody()
        if self.stops:
            return Outcome(False, f"not sent, the arm is stopped: {self._why_stopped()}; first: contact-reach reset")
        before = self.diagnostics[_CONTROLLER]
        self.send_goal(position, rotation)
        judged: list[Outcome] = []

        def is_judged() -> bool:
            outcome = judge_goal(self._goal_state, before, self.diagnostics[_CONTROLLER])
            judged.extend([outcome] if outcome else [])
            return outcome is not None or bool(self.stops)

        self._until(is_judged, _JUDGED_S)
        if self.stops:
            return Outcome(False, f"stopped: {self._why_stopped()}")
        return judged[-1] if judged else Outcome(False, "nothing followed the goal: contact-reach doctor")

    def send_goal(self, position: Array, rotation: Array | None) -> None:
        """Publish a goal (3,), m, (3, 3)."""
        stamp = self._node.get_clock().now().to_msg()
        self._goal_ns, self._goal_state = nanoseconds(stamp), None
        self._goals.publish(to_goal_pose(position.tolist(), self.arm.base_frame, stamp, rotation))

    def watch(self, timeout: float) -> Outcome:
        """Wait until the flange has settled at the goal, for at most some time of the robot's clock, s."""
        while True:
            state, self._goal_state = self._goal_state, None
            if state is None and self._until(lambda: self._goal_state is not None or bool(self.stops), _SILENCE_S):
                state = self._goal_state
            if self.stops:
                return Outcome(False, f"stopped: {self._why_stopped()}")
            if state is None:
                return Outcome(False, f"nothing heard of the goal for {_SILENCE_S:g} s: contact-reach doctor")
            if not state.phase.is_open:
                return Outcome(state.phase is GoalPhase.SETTLED, describe(state))
            if state.elapsed > timeout:
                return Outcome(False, f"not settled; {describe(state)}")

    def change(self, node: str, values: Mapping[str, Any]) -> Outcome:
        """Change parameters of a node, if the node lets them: all or none.

        Raises `ContactReachError` if there is no such node, or no answer.
        """
        client = self._node.create_client(SetParametersAtomically, f"{node}/set_parameters_atomically")
        if not self._until(client.service_is_ready, _FOUND_S):
            raise ContactReachError(_no_stack(self._node))
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        future = client.call_async(SetParametersAtomically.Request(parameters=parameters))
        if not self._until(future.done, _ANSWER_S):
            raise ContactReachError(f"no answer from {node} within {_ANSWER_S:g} s: contact-reach doctor")
        result = future.result().result
        return Outcome(result.successful, result.reason)

    def call(self, service: str) -> Any:
        """Call a Trigger service and return its answer.

        Raises `ContactReachError` if nobody offers it, or there is no answer.
        """
        client = self._node.create_client(Trigger, service)
        try:
            if not client.wait_for_service(timeout_sec=_SETTLED_S):
                raise ContactReachError(f"{service}: there is no such service")
            future = client.call_async(Trigger.Request())
            self._executor.spin_until_future_complete(future, timeout_sec=_ANSWER_S)
            if not future.done():
                raise ContactReachError(f"{service}: no answer within {_ANSWER_S:g} s")
            return future.result()
        finally:
            self._node.destroy_client(client)

    def _until(self, condition: Callable[[], bool], timeout: float) -> bool:
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._spin()
        return True

    def _spin(self) -> None:
        self._executor.spin_once(timeout_sec=_LOOK_S)
        self._inbox.poll()

    def _why_stopped(self) -> str:
        return "; ".join(f"{name}: {reason}" for name, reason in self.stops.items())

    def _on_goal_state(self, message: DiagnosticStatus) -> None:
        stamp_ns, state = read_goal_state(message)
        if stamp_ns == self._goal_ns:
            self._goal_state = state

    def _on_settings(self, message: DiagnosticStatus) -> None:
        self.settings[message.name] = settings = read_settings(message)
        if message.name == _PLANNER:
            self.arm = arm_in(settings, _PLANNER)

    def _on_safety(self, message: DiagnosticStatus) -> None:
        self._heard.add(message.name)
        self.stops.pop(message.name, None)
        if is_stopped(message):
            self.stops[message.name] = message.message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name] = {entry.key: entry.value for entry in status.values}


def _no_stack(node: Node) -> str:
    domain, namespace = os.environ.get("ROS_DOMAIN_ID", "0"), node.get_namespace()
    return (
        f"no stack answers in ROS domain {domain}, namespace {namespace}: start one with 'contact-reach up', or set "
        "ROS_DOMAIN_ID to its domain, and --namespace and --discovery to what it was started with"
    )
