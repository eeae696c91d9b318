"""Drive of a KUKA LBR behind lbr_fri_ros2_stack, which sends the joint states as well."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from lifecycle_msgs.msg import State
from rclpy.node import Node

from contact_reach_ros.arm import Arm, Array, JointState
from contact_reach_ros.drives.settings import LbrSettings
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import encode
from contact_reach_ros.messages.topics import NEWEST, Qos, Topic
from contact_reach_ros.ros.inbox import Inbox
from contact_reach_ros.timing import NANOSECONDS

try:
    from lbr_fri_idl.msg import LBRState, LBRTorqueCommand
except ImportError:
    LBRState = LBRTorqueCommand = None
try:
    from controller_manager_msgs.srv import SetHardwareComponentState
except ImportError:
    SetHardwareComponentState = None

SESSION = ("IDLE", "MONITORING_WAIT", "MONITORING_READY", "COMMANDING_WAIT", "COMMANDING_ACTIVE")
"""States of an FRI session; commands are taken in the last one only."""
QUALITY = ("POOR", "FAIR", "GOOD", "EXCELLENT")
"""Qualities of the connection; FRI commands from GOOD on."""
_GOOD = QUALITY.index("GOOD")
COMMAND_MODE = ("NO_COMMAND_MODE", "POSITION", "WRENCH", "TORQUE")
"""What FRI takes from its client."""

_RATE_TOLERANCE = 0.01
_DRIFT = 1e-4
"""By how much, at most, the robot's clock runs faster than this machine's, as a share."""
_CLOCK_SET_NS = NANOSECONDS // 2
_PAUSE_S = 1.0
"""After a longer pause the velocity is unknown again."""


class LbrTarget:
    """Reads `<driver>/state`, and writes torque overlays with the measured positions to `<driver>/command/torque`.

    The joint states have the robot's own time steps, on this machine's clock; velocities are filtered differences of
    positions, since FRI has none. KUKA's controller carries the arm, and follows the position of a command softly: each
    command mirrors the measured one.

    A stop deactivates the driver's hardware component. It closes the connection, and KUKA's controller brakes the arm.

    Attributes
    ----------
    topic
        Of the commands.
    order
        Names of the joints in the order of the commands.
    problem
        Why nothing can be passed on; empty when it can.
    idle
        Why torques do not reach the arm, and KUKA's controller brakes it; empty if they do.
    """

    def __init__(self, node: Node, arm: Arm, settings: LbrSettings, period: float) -> None:
        """`period`: time between joint states, s.

        Raises `SettingsError` if lbr_fri_idl is not installed, or the arm has not seven joints.
        """
        if LBRState is None:
            raise SettingsError(
                "kind = lbr: the message package lbr_fri_idl is not installed; build lbr_fri_ros2_stack, and source "
                "its workspace before the adapter starts"
            )
        if arm.n != len(LBRState().measured_torque):
            raise SettingsError(f"kind = lbr: {arm.name} has {arm.n} joints; expected an arm with seven")
        self.topic = Topic(f"{settings.driver}/command/torque", LBRTorqueCommand, topics.COMMANDS.qos, "commands")
        self.order = arm.joint_names
        self._source = Topic(f"{settings.driver}/state", LBRState, NEWEST, "FRI states")
        self.problem = f"no state on {self._source.name} yet: start lbr_bringup, and LBRServer on the smartPAD"
        self.idle = self.problem
        self._node, self._settings, self._arm = node, settings, arm
        self._period = period
        self._is_simulated = bool(node.get_parameter("use_sim_time").value)
        """Whether the robot's clock is everybody's."""
        self._sign = 1.0 if settings.torque_sign == "positive" else -1.0
        self._command = LBRTorqueCommand()
        self._q: Array | None = None
        self._v = np.zeros(arm.n)
        self._robot_ns = self._ahead_ns = 0
        """Time of the last state on the robot's clock, and how far this machine's is ahead of it."""
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

    def listen(self, inbox: Inbox, take: Callable[[JointState], None], qos: Qos = NEWEST) -> None:
        """Read the driver's states from an inbox, requested with `qos`; `take` gets them."""

        def on_state(message: Any) -> None:
            state = self.read(message, self._node.get_clock().now().nanoseconds)
            if state is not None:
                take(state)

        inbox.add(self._source, on_state, qos)

    def read(self, message: Any, now_ns: int) -> JointState | None:
        """The joint state in a message, which arrived at `now_ns` of this machine's clock; None for one that repeats.

        Raises `InputError` if positions are not finite; the observer decides about torques.
        """
        self.problem = self._find_problem(message)
        q = np.array(message.measured_joint_position, float)
        torque = self._sign * np.array(message.measured_torque, float)
        if not math.isfinite(sum(q.tolist())):
            raise InputError(f"{self._source.name}: measured_joint_position = {q.tolist()}; expected finite values")
        robot_ns = message.time_stamp_sec * NANOSECONDS + message.time_stamp_nano_sec
        elapsed = (robot_ns - self._robot_ns) / NANOSECONDS
        if robot_ns == self._robot_ns:
            return None
        if self._q is not None and 0.0 < elapsed <= _PAUSE_S:
            share = -math.expm1(-2.0 * math.pi * self._settings.velocity_cutoff * elapsed)
            self._v = self._v + (share or 1.0) * ((q - self._q) / elapsed - self._v)
        elif elapsed:
            self._v = np.zeros(self._arm.n)
        self._q, self._robot_ns = q, robot_ns
        return JointState(robot_ns + self._clock_ahead(now_ns - robot_ns, elapsed), q, self._v, torque)

    def _clock_ahead(self, now_ahead_ns: int, elapsed: float) -> int:
        """How far this machine's clock is ahead of the robot's: as little as any message has shown, but for the drift.

        So the stamps have the robot's steps, not those with which messages arrive.
        """
        if self._is_simulated:
            return 0
        if abs(now_ahead_ns - self._ahead_ns) > _CLOCK_SET_NS:
            self._ahead_ns = now_ahead_ns
        self._ahead_ns = min(self._ahead_ns + round(_DRIFT * max(elapsed, 0.0) * NANOSECONDS), now_ahead_ns)
        return self._ahead_ns

    def _find_problem(self, message: Any) -> str:
        session, quality, mode = message.session_state, message.connection_quality, message.client_command_mode
        self.idle = "" if session == len(SESSION) - 1 else f"the FRI session is {_name(SESSION, session)}"
        if self.idle:
            return f"{self.idle}; expected {SESSION[-1]}: start LBRServer"
        if quality < _GOOD:
            return f"the FRI connection is {_name(QUALITY, quality)}; expected at least GOOD"
        if mode != COMMAND_MODE.index("TORQUE"):
            return (
                f"FRI takes {_name(COMMAND_MODE, mode)}; expected TORQUE: choose it on the smartPAD and in lbr_bringup"
            )
        if abs(message.sample_time - self._period) > _RATE_TOLERANCE * self._period:
            return (
                f"FRI sends every {1000 * message.sample_time:g} ms, but state_rate is {1 / self._period:g} Hz: start "
                "all nodes with the rate of FRI, and the controller manager with at least that update_rate"
            )
        return ""

    def look(self) -> None:
        """There is nothing to ask for."""

    def ask_idle(self) -> None:
        """Do nothing: the driver's states tell it."""

    def hear(self, node: str, settings: Mapping[str, Any]) -> str:
        """Why a node's settings do not fit the drive; empty if they do."""
        return ""

    def write(self, torque: Array) -> bytes:
        """The message with these torques (n,), N m, and the measured positions; not while there is a `problem`."""
        self._command.joint_position[:] = self._q
        self._command.torque[:] = torque
        return encode(self._command)

    def stop(self) -> None:
        """Deactivate the hardware component, if that is possible; without waiting for it."""
        if self._switch is not None:
            target = State(id=State.PRIMARY_STATE_INACTIVE, label="inactive")
            request = SetHardwareComponentState.Request(name=self._settings.component, target_state=target)
            self._switch.call_async(request).add_done_callback(self._on_switched)

    def resume(self) -> None:
        """Do nothing: the driver has to be started again, with the application on the smartPAD."""

    def diagnosis(self) -> dict[str, Any]:
        """There is nothing to report."""
        return {}

    def _on_switched(self, future: Any) -> None:
        logger, name = self._node.get_logger(), self._settings.component
        if future.result() is not None and future.result().ok:
            self.idle = f"{name} is inactive"
            logger.info(f"deactivated {name}: start lbr_bringup again to continue")
        else:
            logger.error(f"the controller manager did not deactivate {name}; see its log")


def _name(names: tuple[str, ...], index: int) -> str:
    return names[index] if 0 <= index < len(names) else f"state {index}"
