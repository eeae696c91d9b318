"""Clients of the running stack: they call services of its nodes, hear what these report, and send goals."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.client import Client as ServiceClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from contact_reach_ros.arm import Array
from contact_reach_ros.arms import arm_in, load_arm
from contact_reach_ros.control.supervisor import RESET_ORDER
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose, to_time
from contact_reach_ros.messages.goal_state import describe, read_goal_state
from contact_reach_ros.messages.safety_state import is_requested, is_stopped, stops_called
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.messages.values import nanoseconds, read_settings
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.ros.discovery import environment
from contact_reach_ros.ros.graph import goal_topic, takes_commands
from contact_reach_ros.ros.inbox import Inbox, qos_profile
from contact_reach_ros.ros.interfaces import ADAPTER, CONTROLLER, OBSERVER, OPERATOR, PLANNER, STOPPABLE
from contact_reach_ros.ros.process import bare_node, in_namespace
from contact_reach_ros.timing import NANOSECONDS

_LOOK_S = 0.02
_FOUND_S = 4.0
"""Longer than participants take to announce themselves again, where the first answer was lost."""
_SERVICE_S = 1.0
"""Wait for a service that stops or releases the arm: another node may offer it, too."""
_ANSWER_S = 3.0
_SETTLED_S = 1.0
"""Time in which the rest of a node's last safety states follows the first, and other nodes are discovered."""
_FOLLOWED_S = 8.0
"""Longest time until diagnostics, which come once a second, show that the controller follows a goal's plans."""
_COMPILED_S = 120.0
"""For a planner that has just been started, which compiles, and for the nodes that bring-up activates then."""
_CHECKED_S = 20.0
"""For a controller that waits for its observer, and an adapter that checks its drive."""
_SILENCE_S = 5.0
_REST_S = 5.0
"""Time in which the arm should be at rest after a stop, and the controller have heard that the observer is reset."""

_NOT_READY = (topics.WAITING_FOR_STATE, topics.WAITING_FOR_OBSTACLES, topics.WAITING_FOR_CONTROLLER)
NOTHING = "nothing is stopped"


class Outcome(NamedTuple):
    """Whether it was done, and a line for the user."""

    done: bool
    text: str


class Client:
    """Calls services of the stack, and has an inbox for its topics.

    Parameters
    ----------
    node
        That calls.
    is_served
        Whether another thread serves the node. Then services may be called from any thread; else whoever calls a
        method serves the node meanwhile.
    """

    def __init__(self, node: Node, is_served: bool = False) -> None:
        self.node = node
        # Malformed messages are reported by the nodes that receive them.
        self.inbox = Inbox(node, lambda what, error: None)
        self._clients: dict[str, ServiceClient] = {}
        self._executor = None if is_served else SingleThreadedExecutor()
        if self._executor is not None:
            self._executor.add_node(node)

    def close(self) -> None:
        """Serve the node no longer."""
        if self._executor is not None:
            self._executor.shutdown()

    def trigger(self, name: str, service: str) -> Outcome:
        """Call a Trigger service of a node; not done where no node offers it, or none answers."""
        try:
            answer = self.call(f"{name}/{service}", Trigger, Trigger.Request(), _SERVICE_S)
        except ContactReachError as error:
            return Outcome(False, str(error))
        return Outcome(answer.success, f"{name}: {answer.message or 'done'}")

    def stop(self) -> Outcome:
        """Stop the arm by the first node that does it: the controller, or another if that fails."""
        failures = []
        for name in STOPPABLE:
            outcome = self.trigger(name, "stop")
            if outcome.done:
                return outcome
            failures.append(outcome.text)
        return Outcome(False, "NOT stopped: " + "; ".join(failures))

    def release(self, names: Collection[str]) -> Outcome:
        """Reset these nodes in `RESET_ORDER`, stopped or not: each looks whether the arm may be released."""
        answers: list[str] = []
        for name in [name for name in RESET_ORDER if name in names]:
            outcome = self.trigger(name, "reset")
            if not outcome.done:
                return Outcome(False, "; ".join(["NOT reset, refused by " + outcome.text, *answers]))
            answers.append(outcome.text)
        return Outcome(True, "; ".join(answers))

    def call(
        self, service: str, kind: Any, request: Any, patience: float = _ANSWER_S, timeout: float = _ANSWER_S
    ) -> Any:
        """Call a service and return its answer.

        Raises `ContactReachError` if no node offers it within `patience`, s, or it does not answer within `timeout`, s.
        """
        future = self.ask(service, kind, request, patience)
        if not self.until(future.done, timeout):
            self._clients[service].remove_pending_request(future)
            raise ContactReachError(f"{service}: no answer within {timeout:g} s")
        return future.result()

    def ask(self, service: str, kind: Any, request: Any, patience: float = _ANSWER_S) -> Future:
        """Call a service without waiting for its answer; raises `ContactReachError` if none offers it within some s."""
        if not self.until(lambda: self.offers(service, kind), patience):
            raise ContactReachError(f"{service}: there is no such service")
        return self._clients[service].call_async(request)

    def offers(self, service: str, kind: Any) -> bool:
        """Whether a service is there."""
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service)
        return bool(self._clients[service].service_is_ready())

    def change(self, node: str, values: Mapping[str, Any]) -> Outcome:
        """Change parameters of a node, if the node lets them: all or none. Raises as `call`."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        result = self.call(f"{node}/set_parameters_atomically", SetParametersAtomically, request).result
        return Outcome(result.successful, result.reason)

    def until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Wait for a condition, for at most some s; returns whether it holds."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.spin(_LOOK_S)
        return True

    def spin(self, seconds: float) -> None:
        """Let the node be served for a while."""
        if self._executor is None:
            time.sleep(seconds)
            return
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)
        # Polled: fast topics cost nothing in between.
        self.inbox.poll()


class StackClient(Client):
    """A user of the stack.

    Attributes
    ----------
    arm
        The planner's, once its settings were heard.
    diagnostics
        Newest values by name, of each node.
    summaries
        Newest message of the diagnostics, of each node.
    stops
        What stopped the arm, by node.
    safety
        Newest message of the safety state, of each node.
    settings
        Of each node that reported them, by full name.
    goal_state
        Of the goal that was sent; None until the planner reports it.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self.arm = load_arm()
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.summaries: dict[str, str] = {}
        self.stops: dict[str, str] = {}
        self.safety: dict[str, str] = {}
        self._stopped_ns: dict[str, int] = {}
        """When nodes stopped that had been known before, or their stop was called again, ns since the epoch."""
        self._stops_called: dict[str, str] = {}
        self._requested: set[str] = set()
        """Nodes that were stopped because somebody called their stop."""
        self.settings: dict[str, dict[str, Any]] = {}
        self.goal_state: GoalState | None = None
        self._goal_ns = 0
        self._clock_ns = 0
        """Simulated time; 0 where there is none."""
        self._goals = self._goal_publisher(topics.GOAL_POSE.name)
        self.inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        self.inbox.add(topics.DIAGNOSTICS, self._on_diagnostics)
        self.inbox.add(topics.GOAL_STATE, self._on_goal_state, topics.ALL_EVENTS)
        self.inbox.add(topics.SETTINGS, self._on_settings, topics.ALL_EVENTS)
        self.inbox.add(topics.CLOCK, self._on_clock, topics.NEWEST)

    def hears(self, name: str, topic: Topic) -> bool:
        """Whether the node of this name is known to subscribe to a topic."""
        found = self.node.get_subscriptions_info_by_topic(self.node.resolve_topic_name(topic.name))
        return any(endpoint.node_name == name for endpoint in found)

    def reaches_planner(self) -> bool:
        """Whether the planner takes the goals that this sends, also where the stack has another name for the topic."""
        name = goal_topic(self.node, PLANNER)
        if name not in ("", self._goals.topic_name):
            self.node.destroy_publisher(self._goals)
            self._goals = self._goal_publisher(name)
        return bool(name)

    def _goal_publisher(self, name: str) -> Publisher:
        topic = topics.GOAL_POSE
        return self.node.create_publisher(topic.type, name, qos_profile(topic.qos))

    def missing(self) -> list[str]:
        """What is not heard yet that goals need, by topic."""
        summary, adapter = self.summaries.get(PLANNER, ""), self.summaries.get(ADAPTER, topics.ALL_IS_WELL)
        why = summary if adapter == topics.ALL_IS_WELL else f"{summary}, and the {ADAPTER} says: {adapter}"
        heard = {
            f"{topics.DIAGNOSTICS.name} of the {PLANNER}": PLANNER in self.diagnostics,
            f"{topics.SETTINGS.name} of the {PLANNER}": PLANNER in self.settings,
            f"{topics.GOAL_POSE.name} by the {PLANNER}": self.reaches_planner(),
            f"{topics.DIAGNOSTICS.name} of the {CONTROLLER}": CONTROLLER in self.diagnostics,
            f"{topics.REFERENCE_POSE.name}, as the {PLANNER} is {why}": summary not in _NOT_READY,
        }
        return [what for what, is_heard in heard.items() if not is_heard]

    def wait_for(self, missing: Callable[[], Collection[str]], timeout: float = _FOUND_S) -> None:
        """Wait until nothing is missing any more, for `timeout`, s; nodes that are up are heard in the default time.

        Raises `ContactReachError` with what is missing then, and where it was looked for.
        """
        if not self.until(lambda: not missing(), timeout):
            domain, namespace = os.environ.get("ROS_DOMAIN_ID", "0"), self.node.get_namespace()
            raise ContactReachError(
                f"not heard in ROS domain {domain}, namespace {namespace}: {', '.join(missing())}; start a stack with "
                "'contact-reach up', set ROS_DOMAIN_ID, --namespace and --discovery to those of one that is running, "
                "or run contact-reach doctor"
            )

    def wait_until_ready(self) -> None:
        """Wait until goals are taken, also where the planner still compiles, before the loops are active.

        Raises as `wait_for`.
        """
        patience = _FOUND_S
        if self.until(self.reaches_planner, _FOUND_S) and not self.until(lambda: PLANNER in self.settings, _FOUND_S):
            self.node.get_logger().info(f"waiting for the {PLANNER} to get ready, {_COMPILED_S:g} s at most")
            patience = _COMPILED_S
        self.wait_for(self.missing, patience)

    def hear_stops(self) -> None:
        """Wait until the safety states of the controller and of all who publish one are known.

        Raises `ContactReachError` if the controller does not report it.
        """
        name = topics.SAFETY_STATE.name

        def everybody() -> bool:
            is_closed = CONTROLLER in self.safety and takes_commands(self.node, CONTROLLER)
            return is_closed and len(self.safety) >= self.node.count_publishers(name)

        # On a busy machine nodes are discovered one after the other: the controller is rarely without an observer, and
        # never without somebody who takes its commands and may have stopped.
        self.until(lambda: OBSERVER in self.safety and everybody(), _FOUND_S)
        self.wait_for(lambda: [] if CONTROLLER in self.safety else [f"{name} of the {CONTROLLER}"], 0.0)
        # The last events of each come first, perhaps in pieces: of a stop before that of its release.
        self.spin(_SETTLED_S)
        self.until(everybody, _FOUND_S)

    def release_all(self, timeout: float = _REST_S, asked_ns: int | None = None) -> Outcome:
        """Reset all nodes if one is stopped, and look again, until none is stopped or the time, s, is over.

        Stops that came after the release was asked for, at `asked_ns` (ns since the epoch, by default now), stay:
        whoever asked did not know of them. But a drive closes its brakes on its own after the stop that is to be
        released.

        Until the arm is at rest a reset is refused; and a drive closes its brakes on its own soon after the stop of the
        controller, perhaps just when that is being released. A controller that stops again has found why: once the
        brakes are open, the hand-over shows what pushes the arm.
        """
        asked_ns = time.time_ns() if asked_ns is None else asked_ns
        outcome, was_released, give_up = Outcome(True, NOTHING), False, 0.0
        while True:
            self.hear_stops()
            if not self.stops:
                return outcome
            since = {name for name in self.stops if self._stopped_ns.get(name, 0) > asked_ns}
            if since & {CONTROLLER, OBSERVER, *self._requested} or since == self.stops.keys():
                return Outcome(False, f"not reset, stopped meanwhile: {self.why_stopped}; look why, and reset again")
            if was_released and CONTROLLER in self.stops:
                return Outcome(False, f"reset, and stopped again: {self.why_stopped}")
            # To hear who is stopped may take as long.
            give_up = give_up or time.monotonic() + timeout
            if time.monotonic() > give_up:
                return Outcome(False, f"still stopped: {self.why_stopped}") if was_released else outcome
            outcome = self.release(self.safety)
            was_released = outcome.done

    def go(self, position: Array, rotation: Array | None) -> Outcome:
        """Send a goal (3,), m, (3, 3), unless the arm is stopped; returns whether it is taken.

        It is when the planner pursues it and the controller has accepted a plan since.
        """
        self.hear_stops()
        if self.stops:
            return Outcome(False, f"not sent, the arm is stopped: {self.why_stopped}; first: contact-reach reset")
        if not self.until_robot(lambda: not self._idle(), _CHECKED_S):
            return Outcome(False, f"not sent, nothing is commanded: {self._idle()}")
        before = self._plans_accepted()
        self.send_goal(position, rotation)

        def is_judged() -> bool:
            state = self.goal_state
            return bool(self.stops) or (state is not None and (state.phase.is_over or self._plans_accepted() > before))

        self.until_robot(is_judged, _FOLLOWED_S)
        if self.stops:
            return Outcome(False, f"stopped: {self.why_stopped}")
        if self.goal_state is None:
            return Outcome(False, "nothing heard of the goal; run contact-reach doctor")
        if self.goal_state.phase.is_over:
            return Outcome(False, f"the planner did not take the goal: {describe(self.goal_state)}")
        if self._plans_accepted() == before:
            reported = self.diagnostics[CONTROLLER].items()
            reasons = "; ".join(text for key, text in reported if key.startswith("last refusal"))
            return Outcome(
                False, f"the controller accepts no plan for the goal: {reasons or 'run contact-reach doctor'}"
            )
        return Outcome(True, "the goal is taken: the controller follows the plans for it")

    def until_robot(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Wait for what the robot does, as `until`; as long as simulated time goes on, `timeout`, s, is of that."""
        give_up_ns = self._clock_ns + timeout * NANOSECONDS
        while True:
            before_ns = self._clock_ns
            if self.until(condition, timeout):
                return True
            if not before_ns < self._clock_ns < give_up_ns:
                return False

    def send_goal(self, position: Array, rotation: Array | None = None, stamp_ns: int | None = None) -> None:
        """Publish a goal (3,), m, (3, 3), stamped with the present time by default."""
        stamp = self.node.get_clock().now().to_msg() if stamp_ns is None else to_time(stamp_ns)
        self._goal_ns, self.goal_state = nanoseconds(stamp), None
        self._goals.publish(to_goal_pose(position.tolist(), self.arm.base_frame, stamp, rotation))

    def watch(self, timeout: float) -> Outcome:
        """Wait until the flange has settled at the goal, for at most some time of the robot's clock, s."""
        while True:
            state, self.goal_state = self.goal_state, None
            if state is None and self.until_robot(lambda: self.goal_state is not None or bool(self.stops), _SILENCE_S):
                state = self.goal_state
            if self.stops:
                return Outcome(False, f"stopped: {self.why_stopped}")
            if state is None:
                return Outcome(False, f"nothing heard of the goal for {_SILENCE_S:g} s; run contact-reach doctor")
            if not state.phase.is_open:
                return Outcome(state.phase is GoalPhase.SETTLED, describe(state))
            if state.elapsed > timeout:
                return Outcome(False, f"not settled; {describe(state)}")

    @property
    def why_stopped(self) -> str:
        """Which nodes stopped the arm, and why; empty if none did."""
        return "; ".join(f"{name}: {reason}" for name, reason in self.stops.items())

    def _idle(self) -> str:
        """Which node on the way to the drive commands nothing, and why; empty if there is none."""
        said = {name: self.summaries.get(name, "") for name in (CONTROLLER, ADAPTER, OBSERVER)}
        idle = {name: why for name, why in said.items() if why not in ("", topics.ALL_IS_WELL)}
        # The observer commands nothing: it only says why the others do not.
        return "; ".join(f"{name}: {why}" for name, why in idle.items()) if idle.keys() != {OBSERVER} else ""

    def _plans_accepted(self) -> int:
        return int(self.diagnostics[CONTROLLER].get("plans accepted", 0))

    def _on_clock(self, message: Clock) -> None:
        self._clock_ns = nanoseconds(message.clock)

    def _on_goal_state(self, message: DiagnosticStatus) -> None:
        stamp_ns, state = read_goal_state(message)
        if stamp_ns == self._goal_ns:
            self.goal_state = state

    def _on_settings(self, message: DiagnosticStatus) -> None:
        self.settings[message.name] = settings = read_settings(message)
        if message.name == PLANNER:
            self.arm = arm_in(settings, PLANNER)

    def _on_safety(self, message: DiagnosticStatus) -> None:
        was_free = message.name in self.safety and message.name not in self.stops
        called = stops_called(message)
        is_called_again = called != self._stops_called.get(message.name, called)
        self.safety[message.name], self._stops_called[message.name] = message.message, called
        if not is_stopped(message):
            self.stops.pop(message.name, None)
            return
        self.stops[message.name] = message.message
        (self._requested.add if is_requested(message) else self._requested.discard)(message.name)
        if was_free or is_called_again:
            self._stopped_ns[message.name] = self.inbox.sent_ns

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name] = {entry.key: entry.value for entry in status.values}
            self.summaries[status.name] = status.message


@contextmanager
def connect(discovery: str = "host", namespace: str = "") -> Iterator[StackClient]:
    """A client of the stack that is found within `discovery`, in a namespace.

    Raises `ContactReachError` if there is no planner, and no node that reports a safety state.
    """
    os.environ.update(environment(discovery))
    with bare_node(OPERATOR, [OPERATOR, *in_namespace(namespace)]) as node:
        client, name = StackClient(node), topics.SAFETY_STATE.name
        try:
            is_there = lambda: node.count_publishers(name) or client.reaches_planner()  # noqa: E731
            client.wait_for(lambda: [] if is_there() else [f"{name} of any node"])
            yield client
        finally:
            client.close()
