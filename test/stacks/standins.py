"""Stand-ins for the drivers of real arms: the simulated arm behind the topics, services and habits of each.

They hold the last torque for ever. What they do is taken from the sources of the drivers; docs/adapter.md names them.
"""

import math
import sys
import time

import numpy as np
from controller_manager_msgs.msg import ControllerState
from controller_manager_msgs.srv import ListControllers, SetHardwareComponentState, SwitchController
from franka_msgs.srv import SetFullCollisionBehavior
from lbr_fri_idl.msg import LBRState, LBRTorqueCommand
from lifecycle_msgs.msg import State
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.serialization import deserialize_message, serialize_message

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.ros.process import run
from contact_reach_ros.simulation.drive import Drive
from contact_reach_ros.simulation.plant import Actuation
from contact_reach_ros.timing import NANOSECONDS


class StandIn(DriverNode):
    """Commands nothing on top of gravity until it is told to."""

    BRAKES = True
    """Whether brakes hold the arm when no controller is active; they open with the first command."""

    def __init__(self):
        super().__init__()
        if self.BRAKES:
            self.robot.drive = Drive(self.robot.plant, self.settings["watchdog"], open_after=0.0)

    def activate(self):
        super().activate()
        if self.BRAKES:
            self.send_zeros()

    def send_zeros(self):
        """As a controller that has just been activated."""
        self.robot.command(np.zeros(self.arm.n), self.robot.now_ns if self.lockstep else time.monotonic_ns())

    def external_torque(self):
        """Torque of contacts and pushes on the joints, (n,), N m."""
        return self.robot.plant.data.qfrc_constraint[: self.arm.n].copy()


class EffortDriver(StandIn):
    """An effort controller of ros2_control, in an order of its own; deactivated, it sends zeros."""

    BRAKES = False

    def __init__(self):
        super().__init__()
        self.joints = [self.arm.joint_names[index] for index in (2, 0, 1, 6, 5, 4, 3)]
        self._is_active = True
        self.create_service(GetParameters, "effort_controller/get_parameters", self._on_parameters)
        self.create_service(SwitchController, "controller_manager/switch_controller", self._on_switch)
        self.create_service(ListControllers, "controller_manager/list_controllers", self._on_list)

    def read_torque(self, data):
        torque = super().read_torque(data)
        return torque[[self.joints.index(name) for name in self.arm.joint_names]] * self._is_active

    def _on_parameters(self, request, response):
        value = ParameterValue(type=ParameterType.PARAMETER_STRING_ARRAY, string_array_value=self.joints)
        response.values = [value if name == "joints" else ParameterValue() for name in request.names]
        return response

    def _on_list(self, request, response):
        state = "active" if self._is_active else "inactive"
        response.controller = [ControllerState(name="joint_state_broadcaster", state="active")]
        response.controller.append(ControllerState(name="effort_controller", state=state))
        return response

    def _on_switch(self, request, response):
        self._is_active = not request.deactivate_controllers
        if self.BRAKES and not self._is_active:
            self.robot.drive.stop("no controller is active")
        elif self.BRAKES:
            self.robot.drive.reset()
        self.send_zeros()
        response.ok = True
        return response


class FrankaDriver(EffortDriver):
    """franka_ros2: torques without gravity that change by 1 Nm a tick at most, and reflexes."""

    BRAKES = True
    STEP = 1.0

    def __init__(self):
        super().__init__()
        self._reflexes = None
        self._torque = np.zeros(self.arm.n)
        name = "service_server/set_full_collision_behavior"
        self.create_service(SetFullCollisionBehavior, name, self._on_reflexes)

    def read_torque(self, data):
        step = self.STEP * 1000.0 * self.period
        self._torque += np.clip(super().read_torque(data) - self._torque, -step, step)
        return self._torque.copy()

    def publish_state(self, state):
        moves = self.robot.plant.actuation is Actuation.COMMANDED
        if moves and self._reflexes is not None and (np.abs(self.external_torque()) > self._reflexes).any():
            self.robot.drive.stop("reflex")
        super().publish_state(state)

    def _on_reflexes(self, request, response):
        self._reflexes = np.array(request.upper_torque_thresholds_nominal)
        response.success = True
        return response


class LbrDriver(StandIn):
    """lbr_fri_ros2_stack: FRI's state with torques behind a low-pass of 10 Hz, and torque overlays with positions.

    KUKA's controller ends the session when the connection is closed, or when the commanded position is far from the
    measured one, and closes the brakes.
    """

    COMMANDS = Topic("lbr/command/torque", LBRTorqueCommand)
    STATES = Topic("lbr/state", LBRState)
    CUTOFF = 10.0
    SESSION_AFTER_S = 0.2
    FARTHEST = 0.05

    def __init__(self):
        super().__init__()
        self._torque = self._external = None
        self._is_open = True
        name = "lbr/controller_manager/set_hardware_component_state"
        self.create_service(SetHardwareComponentState, name, self._on_component)

    def read_torque(self, data):
        message = deserialize_message(data, LBRTorqueCommand)
        far = np.abs(np.array(message.joint_position) - self.robot.plant.joint_positions).max()
        if far > self.FARTHEST:
            self._end(f"the commanded position is {far:.2f} rad from the measured one")
        return np.array(message.torque) * self._is_open

    def publish_state(self, state):
        if not self._is_open:
            return
        carried = self.robot.drive._model.gravity_at(state.q)
        # Before the first step the simulated sensors show nothing.
        self._torque = self._filtered(self._torque, np.where(np.isnan(state.torque), carried, state.torque))
        self._external = self._filtered(self._external, self.external_torque())
        message = LBRState(
            sample_time=self.period,
            session_state=4 if self.robot.plant.steps > self.SESSION_AFTER_S * 1000 else 3,
            connection_quality=3,
            client_command_mode=3,
            time_stamp_sec=state.stamp_ns // NANOSECONDS,
            time_stamp_nano_sec=state.stamp_ns % NANOSECONDS,
            measured_joint_position=state.q,
            commanded_joint_position=state.q,
            measured_torque=self._torque,
            external_torque=self._external,
        )
        self.write_state(serialize_message(message))

    def _filtered(self, before, value):
        if before is None:
            return value
        cosine = math.cos(2.0 * math.pi * self.CUTOFF * self.period)
        share = cosine - 1.0 + math.sqrt(cosine**2 - 4.0 * cosine + 3.0)
        return before + share * (value - before)

    def _on_component(self, request, response):
        response.ok = request.target_state.id == State.PRIMARY_STATE_INACTIVE
        if response.ok:
            self._end("the connection is closed")
        return response

    def _end(self, why):
        self._is_open = False
        self.robot.drive.stop(why)


DRIVERS = {"effort": EffortDriver, "lbr": LbrDriver, "franka": FrankaDriver}

if __name__ == "__main__":
    assert topics.COMMANDS.name == "effort_controller/commands"
    kind = sys.argv.pop(1)
    carries = [] if kind == "effort" else ["-p", "watchdog.carries:=true"]
    sys.exit(run(DRIVERS[kind], [*sys.argv, "--ros-args", "-p", "watchdog.enabled:=false", *carries]))
