"""Drive of a KUKA LBR behind lbr_fri_ros2_stack, which sends the joint states as well."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from lifecycle_msgs.msg import State
from rclpy.node import Node
from std_msgs.msg import String

from contact_reach_ros.arm import Arm, Array, JointState
from contact_reach_ros.drives.fri import FriStates
from contact_reach_ros.drives.settings import LbrSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import encode
from contact_reach_ros.messages.topics import LATCHED, NEWEST, Qos, Topic
from contact_reach_ros.ros.inbox import Inbox

try:
    from lbr_fri_idl.msg import LBRState, LBRTorqueCommand
except ImportError:
    LBRState = LBRTorqueCommand = None
try:
    from controller_manager_msgs.srv import SetHardwareComponentState
except ImportError:
    SetHardwareComponentState = None

_STATE, _COMMAND, _TEXT = "lbr_fri_idl/msg/LBRState", "lbr_fri_idl/msg/LBRTorqueCommand", "std_msgs/msg/String"
"""Types of the driver's topics."""
_OBSERVER, _CUTOFF = "observer", "momentum.torque_cutoff"
_CONTROLLER, _DELAY = "controller", "limits.torque_delay"
_LONGEST_PERIOD_S = 0.002
_LARGEST_DESCRIPTION = 1 << 20
"""Bytes."""


class LbrTarget:
    """Reads `<driver>/state`, and writes torque overlays with positions to `<driver>/command/torque`.

    KUKA's controller carries the arm. `FriStates` says what the joint states are, and what is checked before torques
    are sent.

    A stop deactivates the driver's hardware component. It closes the connection, and KUKA's controller brakes the arm.

    Attributes
    ----------
    topic
        Of the commands.
    order
        Names of the joints in the order of the commands.
    states
        What the driver's states tell.
    """

    def __init__(self, node: Node, arm: Arm, settings: LbrSettings, period: float) -> None:
        """`period`: time between joint states, s.

        Raises `SettingsError` if lbr_fri_idl is not installed, states come too slowly, or the arm has not seven joints.
        """
        if LBRState is None:
            raise SettingsError(
                "kind = lbr: the message package lbr_fri_idl is not installed; build lbr_fri_ros2_stack, and source "
                "its workspace before the adapter starts"
            )
        if period > _LONGEST_PERIOD_S:
            raise SettingsError(
                f"kind = lbr: state_rate = {1.0 / period:g} Hz; expected {1.0 / _LONGEST_PERIOD_S:g} to 1000, an FRI "
                "send period of 1 or 2 ms: torques act two periods late, with which the laws are not stable below"
            )
        if arm.n != len(LBRState().measured_torque):
            raise SettingsError(f"kind = lbr: {arm.name} has {arm.n} joints; expected an arm with seven")
        self.topic = Topic(f"{settings.driver}/command/torque", _COMMAND, topics.COMMANDS.qos, "commands")
        self.order = arm.joint_names
        self.states = FriStates(arm, settings, period, bool(node.get_parameter("use_sim_time").value))
        self._source = Topic(f"{settings.driver}/state", _STATE, NEWEST, "FRI states")
        self._description = Topic(f"{settings.driver}/robot_description", _TEXT, LATCHED, "robot descriptions")
        self._node, self._settings = node, settings
        self._found = ""
        """Where a driver is, if not where it is looked for."""
        self._command = LBRTorqueCommand()
        self._deactivated = ""
        self._switch = None
        if not settings.component:
            return
        if SetHardwareComponentState is None:
            node.get_logger().warning(
                "controller_manager_msgs is not installed: a stop sends harmless torques until ~/reset, and does not "
                "let KUKA's controller brake; install ros-jazzy-controller-manager-msgs"
            )
        else:
            service = f"{settings.driver}/controller_manager/set_hardware_component_state"
            self._switch = node.create_client(SetHardwareComponentState, service)

    @property
    def problem(self) -> str:
        """Why nothing can be passed on; empty when it can."""
        return self.states.problem + self._found

    @property
    def idle(self) -> str:
        """Why torques do not reach the arm, and KUKA's controller brakes it; empty if they do."""
        return self._deactivated or self.states.idle

    def listen(self, inbox: Inbox, take: Callable[[JointState], None], qos: Qos = NEWEST) -> None:
        """Read the driver's states from an inbox, requested with `qos`; `take` gets them."""

        def on_state(message: Any) -> None:
            self._found = ""
            state = self.states.read(message, self._node.get_clock().now().nanoseconds)
            if state is not None:
                self._deactivated = ""
                take(state)

        def on_description(message: String) -> None:
            self.states.describe(message.data, hasattr(LBRState(), "commanded_joint_position"))

        inbox.add(self._source, on_state, qos)
        inbox.add(self._description, on_description, largest=_LARGEST_DESCRIPTION)

    def look(self) -> None:
        """Look for a driver elsewhere, while there is no state; to be called a few times a second."""
        if self.states.idle and not self.states.has_states:
            self._found = self._find_elsewhere()

    def prepare(self) -> bool:
        """Measure KUKA's stiffness, now that commands come; returns whether that needs harmless torques."""
        return self.states.expect_commands()

    def hear(self, node: str, settings: Mapping[str, Any]) -> str:
        """Why a node's settings do not fit the drive; empty if they do."""
        cutoff, least = settings.get(_CUTOFF, 0.0), self.states.delay
        if node == _CONTROLLER and settings.get(_DELAY, least) < least:
            return (
                f"{_DELAY} = {settings[_DELAY]:g} s in the controller; expected at least {least:.4f} s: torques act "
                "two periods late, and lbr.velocity_cutoff delays velocities"
            )
        if node == _OBSERVER and cutoff:
            return f"{_CUTOFF} = {cutoff:g} in the observer; expected 0: the adapter undoes the driver's filter"
        return ""

    def write(self, torque: Array) -> bytes:
        """The message with these torques (n,), N m, and the positions that go with them; not before the first state."""
        self._command.joint_position[:] = self.states.position_for(torque)
        self._command.torque[:] = torque
        return encode(self._command)

    def stop(self) -> None:
        """Deactivate the hardware component, if that is possible; without waiting for it."""
        if self._switch is not None:
            target = State(id=State.PRIMARY_STATE_INACTIVE, label="inactive")
            request = SetHardwareComponentState.Request(name=self._settings.component, target_state=target)
            self._switch.call_async(request).add_done_callback(self._on_switched)

    def check_reset(self) -> None:
        """Do nothing: `resume` begins the checks anew."""

    def resume(self, was_stopped: bool) -> None:
        """Check again what has failed; after a stop the driver has to be started again, with LBRServer."""
        self.states.reset()

    def diagnosis(self) -> dict[str, Any]:
        """The driver's generation."""
        driver = self.states.driver
        return {"driver": "unknown" if driver is None else driver.generation}

    def _find_elsewhere(self) -> str:
        """Where else states of a driver are published, in words; or that those here are of another type."""
        kind, own = self._source.type_name, self._node.resolve_topic_name(self._source.name)
        names = [name for name, kinds in self._node.get_topic_names_and_types() if kind in kinds]
        if own in names and self._node.count_publishers(own):
            return f"; {own} is published, but nothing arrives: was lbr_fri_idl built for the driver's version of FRI?"
        others = [name for name in names if name != own and self._node.count_publishers(name)]
        return f"; there is {', '.join(others)}: set lbr.driver to what comes before /state" if others else ""

    def _on_switched(self, future: Any) -> None:
        logger, name = self._node.get_logger(), self._settings.component
        if future.result() is not None and future.result().ok:
            self._deactivated = f"{name} is inactive"
            logger.info(f"deactivated {name}: start lbr_bringup again to continue")
        else:
            logger.error(f"the controller manager did not deactivate {name}; see its log")
