"""What nodes of the stack have in common: lifecycle, parameters, a loop, diagnostics, and stops of the arm."""

from __future__ import annotations

import json
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from contact_reach_ros.arms import EVERY_SECTION, ROBOT_DIGEST, TOOL, arm_settings, load_arm, make_settings
from contact_reach_ros.errors import ContactReachError, InputError, StopCode, StopReason, internal, requested
from contact_reach_ros.messages.cdr import stamp_in
from contact_reach_ros.messages.conversions import to_status
from contact_reach_ros.messages.intake import IntakeLog, Taken
from contact_reach_ros.messages.safety_state import OK, WARN
from contact_reach_ros.messages.topics import (
    ALL_IS_WELL,
    DIAGNOSTICS,
    KEPT_STREAM,
    LOCKSTEP_HORIZON,
    NEWEST,
    SETTINGS,
    Qos,
    Topic,
)
from contact_reach_ros.resources import VERSION
from contact_reach_ros.ros.boundary import TRANSITIONS, Boundary
from contact_reach_ros.ros.graph import LOOK_AROUND_S, mismatches, rivalry
from contact_reach_ros.ros.inbox import Inbox, qos_profile
from contact_reach_ros.ros.lockstep import Lockstep
from contact_reach_ros.ros.parameters import declare, given_parameters
from contact_reach_ros.ros.scheduling import Role
from contact_reach_ros.settings import AUTOSTART, CPUS, OF_ROS, RATE, ROBOT, Sections, declared_parameters, full_name
from contact_reach_ros.timing import NANOSECONDS

_IDLE_NS = 100_000_000
_SIMULATED = "use_sim_time"


class ManagedNode(LifecycleNode):
    """A lifecycle node whose work is done by one loop thread.

    Subclasses set `NAME` and `SECTIONS`, create their subscriptions in `self.inbox`, and implement `turn`.

    Attributes
    ----------
    arm
        The arm that the parameter `robot` names, with the tool of the section `tool`.
    period
        Nominal time between joint states, s.
    settings
        The settings objects by parameter prefix, and those from other files that the node adds; published together.
    running
        Whether the node is active.
    lockstep
        Whether time is simulated and waits for every node: each is busy then, and none is late.
    rivals
        What others publish that this node alone may, see `exclude`; empty if there is nothing.
    boundary
        Catches and counts the exceptions raised by messages and requests.
    refuse, refused
        Its method that counts refused input, and the numbers of refusals by what was refused.
    """

    NAME: ClassVar[str]
    SECTIONS: ClassVar[Sections]
    ARGUMENTS: ClassVar[Sequence[str]] = ()
    """The command line of the process, which `run` sets."""

    def __init__(self) -> None:
        given = given_parameters(self.ARGUMENTS, self.NAME)
        of_ros = [Parameter(name, value=given[name]) for name in OF_ROS if name in given]
        super().__init__(self.NAME, parameter_overrides=of_ros)
        own = declare(self, {entry.name: entry for entry in (AUTOSTART, CPUS, ROBOT, RATE)}, given)
        self.autostart, self.cpus, robot, rate = own.values()
        self.lockstep = bool(self.get_parameter(_SIMULATED).value)
        self.set_descriptor(_SIMULATED, ParameterDescriptor(read_only=True, dynamic_typing=True))
        self._simulated_ns = 0
        self._turns: Lockstep | None = None
        """Of a node that follows the joint states in lockstep."""
        self._bare_arm = load_arm(robot)
        self.period = 1.0 / rate
        sections = {**EVERY_SECTION, **self.SECTIONS}
        values = declare(self, declared_parameters(sections, self._bare_arm), given)
        self.settings = make_settings(values, sections, self._bare_arm, f"parameters of {self.NAME}")
        self.arm = self._bare_arm.with_tool(self.settings[TOOL])
        self.boundary = Boundary(self.say, self.on_fault)
        self.refuse, self.refused = self.boundary.refuse, self.boundary.refused
        self.inbox = Inbox(self, self.refuse)
        self.running = False
        self.rivals = ""
        self._exclusive: Sequence[Topic] = ()
        self._diagnostics = self.make_publisher(DIAGNOSTICS)
        self._settings_publisher = self.make_publisher(SETTINGS)
        self._stop = threading.Event()
        self._counts: dict[tuple[str, str], int] = {}
        self._lines: deque[str] = deque()
        self._said = self.create_guard_condition(self.write_out)
        self.every(1.0, self._publish_diagnostics)

    def turn(self) -> None:
        """One turn of the loop while the node is active; waits for what it needs, at most 0.1 s."""
        self.inbox.wait(_IDLE_NS)

    def on_fault(self, what: str, error: Exception) -> None:
        """React to an internal error in handling `what`; in the thread where it happened."""

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """A summary (empty when all is well) and values for the diagnostics topic."""
        return "", {}

    def loop(self) -> None:
        """Take turns until `request_stop`, then `deactivate`; while the node is inactive its messages are dropped."""
        try:
            while not self._stop.is_set():
                if self.running:
                    self.turn()
                else:
                    self.inbox.run_tasks()
                    self._stop.wait(0.02)
        finally:
            if self.running:
                self.deactivate()

    def may_end(self, insists: bool) -> bool:
        """Whether the process may end now that a signal asks for it; the main thread asks again and again until it may.

        `insists`: whether the user has asked once more, after a while.
        """
        return True

    def request_stop(self) -> None:
        """End the loop."""
        self._stop.set()
        self.inbox.wake()

    def make_publisher(self, topic: Topic) -> Any:
        """Publisher for a topic of the stack."""
        return self.create_publisher(topic.type, topic.name, qos_profile(topic.qos))

    def make_writer(self, topic: Topic) -> Callable[[bytes], None]:
        """Return a function that publishes serialised messages of a topic, for the loop of an active node.

        It bypasses the checks of lifecycle publisher, context and type, which take as long as the loop's arithmetic.
        In lockstep late subscribers receive the last seconds.
        """
        kept = topic._replace(qos=KEPT_STREAM) if self.lockstep else topic
        write: Callable[[bytes], None] = self.make_publisher(kept).handle.publish_raw
        return write

    @property
    def role(self) -> Role:
        """By which its process gets CPUs and priority; in lockstep, where its loop never sleeps, no priority."""
        return Role.VIEWER if self.lockstep else Role[self.NAME.upper()]

    @property
    def now_ns(self) -> int:
        """Time of the watchdogs' clock, ns: steady, or in lockstep the stamp of the last joint state."""
        return self._simulated_ns if self.lockstep else time.monotonic_ns()

    @property
    def arrived_ns(self) -> int:
        """When the handling of the present message began, on the watchdogs' clock, ns."""
        return self._simulated_ns if self.lockstep else self.inbox.handled_ns

    @property
    def stream_qos(self) -> Qos:
        """What to request for joint states and commands: the newest, or in lockstep every one, as they are kept."""
        return KEPT_STREAM if self.lockstep else NEWEST

    def follow(
        self, topic: Topic, handle: Callable[[bytes], None], hurried: bool = True, after: Sequence[str] = ()
    ) -> None:
        """Subscribe to the joint states, which pace the node; `handle` gets their bytes.

        In lockstep a state waits for the node's turn, and others wait until it was handled, or refused.
        Each is handled once. Call it when all other publishers and subscriptions are made: `ros.lockstep` explains why.

        Parameters
        ----------
        topic
            Of the joint states.
        handle
            Called with each serialised message.
        hurried
            As for `Inbox.add`; in lockstep every state wakes the loop up.
        after
            Nodes that this one waits for in lockstep, besides those that every stack has.
        """
        if not self.lockstep:
            self.inbox.add(topic, handle, NEWEST, serialized=True, hurried=hurried)
            return

        def take(data: bytes) -> None:
            stamp_ns = self._simulated_ns = stamp_in(data)
            try:
                handle(data)
            finally:
                turns.done(stamp_ns)

        def ready(data: bytes) -> bool:
            return self._stop.is_set() or not self.running or turns.may_handle(stamp_in(data))

        self.inbox.add(topic, take, self.stream_qos, serialized=True, ready=ready)
        publish, tick_ns = self.make_publisher(LOCKSTEP_HORIZON).publish, round(self.period * NANOSECONDS)
        self._turns = turns = Lockstep(self.NAME, tick_ns, publish, after)
        self.inbox.add(LOCKSTEP_HORIZON, turns.hear)

    def log_intake(self, topic: Topic) -> IntakeLog:
        """Record from now on, for bags, what the inbox handles."""
        self.inbox.intake = IntakeLog(self.make_publisher(topic).publish)
        return self.inbox.intake

    def note_call(self, what: Taken) -> None:
        """Record a call, for bags, before it is handled: at once, as it may be the last thing that happens."""
        self.inbox.note(what)
        if self.inbox.intake is not None and self.running:
            self.inbox.intake.flush()

    def every(self, period: float, act: Callable[[], None]) -> None:
        """Call `act` each `period`, s of the steady clock, in the executor's thread."""
        self.create_timer(period, act, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def offer(self, name: str, act: Callable[[], str]) -> None:
        """Offer a Trigger service; `act` returns the text of the answer, or raises what the request is refused for."""

        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success, response.message = True, act()
            return response

        self.create_service(Trigger, name, answer)

    def exclude(self, exclusive: Sequence[Topic]) -> None:
        """Look for other publishers of these topics several times a second, beside the loop."""
        self._exclusive = exclusive
        self.every(LOOK_AROUND_S, self.look_around)

    def look_around(self) -> None:
        """Look for rivals; while there are some, each time run `on_rivals`."""
        self.rivals = rivalry(self, self._exclusive)
        if self.rivals:
            self.on_rivals()

    def on_rivals(self) -> None:
        """React to `rivals`, in the executor's thread."""

    def say(self, line: str) -> None:
        """Log an error from the loop thread, which must not wait for it: another thread writes it a little later."""
        self._lines.append(line)
        self._said.trigger()

    def configure(self) -> None:
        """Prepare what must be ready before the first message; may raise."""

    def activate(self) -> None:
        """Reset what the loop's work starts from; may raise."""

    def deactivate(self) -> None:
        """End the loop's work, also where the process ends; the node is still active. May raise."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `configure`."""
        return self._attempt(self.configure, super().on_configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `activate`, publish the settings, and start the loop's work."""
        result = self._attempt(self.activate, super().on_activate, state)
        if result == TransitionCallbackReturn.SUCCESS:
            self.publish_settings()
            # The loop does not look at its inbox yet.
            self.inbox.note(Taken.ACTIVATE)
            self.running = True
            if self._turns is not None:
                self._turns.join()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `deactivate` and let the loop idle, whatever comes of it."""
        result = self._attempt(self.deactivate, super().on_deactivate, state)
        self.running = False
        return TransitionCallbackReturn.ERROR if result == TransitionCallbackReturn.FAILURE else result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End for good; an active node is deactivated first."""
        if self.running:
            self.on_deactivate(state)
        return super().on_shutdown(state)

    def write_out(self) -> None:
        """Log the lines that the loop thread has queued."""
        while self._lines:
            self.get_logger().error(self._lines.popleft())

    def _attempt(
        self,
        act: Callable[[], None],
        finish: Callable[[LifecycleState], TransitionCallbackReturn],
        state: LifecycleState,
    ) -> TransitionCallbackReturn:
        """Result of a transition: act, then finish it; an exception, which rclpy would keep to itself, is logged.

        A refusal leaves the node in the state before.
        """
        try:
            act()
            return finish(state)
        except Exception as error:
            self.refuse(TRANSITIONS, error)
            self._log_refusals()
            self.write_out()
            is_refusal = isinstance(error, ContactReachError)
            return TransitionCallbackReturn.FAILURE if is_refusal else TransitionCallbackReturn.ERROR

    def _log_refusals(self) -> None:
        for line in self.boundary.last_refusals():
            self.get_logger().warning(line)

    def reported_settings(self) -> dict[str, Any]:
        """The settings in force by their full names, as the node reports them."""
        values = {
            full_name(prefix, entry.name): getattr(values, entry.name)
            for prefix, values in self.settings.items()
            for entry in values.declared()
        }
        own = {_SIMULATED: self.lockstep, ROBOT_DIGEST: self.arm.digest, RATE.name: 1.0 / self.period}
        return {**values, **arm_settings(self._bare_arm), **own}

    def publish_settings(self) -> None:
        """Publish the settings in force, each value as JSON; bags record them."""
        values = {name: json.dumps(value) for name, value in self.reported_settings().items()}
        self._settings_publisher.publish(to_status(self.NAME, f"contact_reach_ros {VERSION}", values))

    def _publish_diagnostics(self) -> None:
        self._log_refusals()
        for line in mismatches(self, self.inbox.subscriptions, self._counts):
            self.get_logger().warning(line)
        summary, values = self.diagnosis()
        shown = {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in values.items()}
        shown |= {f"refused {what}": count for what, count in self.refused.items()}
        shown |= {f"last refusal of {what}": text for what, text in self.boundary.reasons.items()}
        status = to_status(self.get_name(), summary or ALL_IS_WELL, shown, WARN if summary else OK)
        header = Header(stamp=self.get_clock().now().to_msg())
        self._diagnostics.publish(DiagnosticArray(header=header, status=[status]))


class StoppableNode(ManagedNode):
    """A node of the control loop with the services ~/stop and ~/reset.

    Both act in the loop's thread, which may be in the middle of a tick; a stop does not wait until it has.
    """

    STOPPED = "stopped"
    """Answer to a stop."""
    RELEASED = ""
    """Answer to a reset."""

    def __init__(self) -> None:
        super().__init__()
        self.stops_called = 0
        self.offer("~/stop", self._answer_stop)
        self.offer("~/reset", self._answer_reset)

    @property
    @abstractmethod
    def stop_reason(self) -> str:
        """Why the arm is stopped; empty if it is not."""

    @property
    @abstractmethod
    def is_engaged(self) -> bool:
        """Whether the arm may follow from what this node does, so that there is something to stop."""

    @abstractmethod
    def stop_for(self, reason: str) -> None:
        """Stop the arm; in the loop's thread."""

    @abstractmethod
    def reset(self) -> None:
        """Release a stop; in the loop's thread. Raises `InputError` if the arm may not be released yet."""

    def on_fault(self, what: str, error: Exception) -> None:
        """Stop the arm: after an internal error the node's state is unknown."""
        self.stop_once(internal(what, error))

    def on_rivals(self) -> None:
        """Stop the arm, which would get the commands of both in turn."""
        if self.is_engaged:
            self.stop_once(StopReason(StopCode.RIVAL, self.rivals))

    def stop_once(self, reason: str) -> None:
        """Let the loop stop the arm, unless it is stopped already; may be called from any thread."""
        if not self.stop_reason:
            self.inbox.post(lambda: self.stop_for(reason))

    def _answer_stop(self) -> str:
        # The loop may be slow to answer, but it will stop.
        self.stops_called += 1
        self.inbox.post(lambda: self.stop_for(requested("stop service called")))
        return self.STOPPED

    def _answer_reset(self) -> str:
        if self.rivals:
            raise InputError(f"{self.rivals}: end the others first")
        self.inbox.call(self.reset)
        return self.RELEASED
