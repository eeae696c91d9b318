"""Stand-ins for the drivers of real arms: `standins.py KIND [NAME=VALUE ...] --ros-args ...`.

The simulated arm behind the topics, services and habits of each driver, which its sources tell; docs/adapter.md names
them. They hold the last torque for ever. The names are attributes of the kind, or what `KukaRobot` takes.
"""

import sys
import time

import numpy as np
from controller_manager_msgs.msg import ControllerState
from controller_manager_msgs.srv import ListControllers, SetHardwareComponentState, SwitchController
from franka_msgs.srv import SetFullCollisionBehavior
from kuka import CarriedPlant, KukaRobot
from lbr_fri_idl.msg import LBRState, LBRTorqueCommand
from lifecycle_msgs.msg import State
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.ros.process import run
from contact_reach_ros.simulation.plant import Actuation
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.timing import NANOSECONDS

OF_KUKA = {}
"""What `KukaRobot` is given."""


class StandIn(DriverNode):
    """Commands nothing on top of gravity until it is told to."""

    BRAKES = True
    """Whether brakes hold the arm when no controller is active; they open with the first command."""

    def __init__(self):
        super().__init__()
        if self.BRAKES:
            plant, watchdog = CarriedPlant(self._scene), self.settings["watchdog"]
            self.robot = SimulatedRobot(self._scene, watchdog, period=self.period, plant=plant, open_after=0.0)

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
    """An effort controller of ros2_control, in an order of its own, and the controller manager.

    Deactivated, a JointGroupEffortController sends zeros; a ForwardCommandController leaves the last torque.
    """

    BRAKES = False
    FORWARD = False
    RIVAL = ""
    """Name of a controller that is active in its place."""

    def __init__(self):
        super().__init__()
        self.joints = [self.arm.joint_names[index] for index in (2, 0, 1, 6, 5, 4, 3)]
        self._is_active = not self.RIVAL
        self._last = np.zeros(self.arm.n)
        self.create_service(GetParameters, "effort_controller/get_parameters", self._on_parameters)
        self.create_service(SwitchController, "controller_manager/switch_controller", self._on_switch)
        self.create_service(ListControllers, "controller_manager/list_controllers", self._on_list)

    def read_torque(self, data):
        if self._is_active:
            torque = super().read_torque(data)
            self._last = torque[[self.joints.index(name) for name in self.arm.joint_names]]
        return self._last

    def _on_parameters(self, request, response):
        value = ParameterValue(type=ParameterType.PARAMETER_STRING_ARRAY, string_array_value=self.joints)
        response.values = [value if name == "joints" else ParameterValue() for name in request.names]
        return response

    def _on_list(self, request, response):
        state = "active" if self._is_active else "inactive"
        response.controller = [ControllerState(name="joint_state_broadcaster", state="active")]
        response.controller.append(ControllerState(name="effort_controller", state=state))
        if self.RIVAL:
            claimed = [f"{name}/effort" for name in self.joints]
            response.controller.append(ControllerState(name=self.RIVAL, state="active", claimed_interfaces=claimed))
        return response

    def _on_switch(self, request, response):
        controllers = {*request.activate_controllers, *request.deactivate_controllers}
        response.ok = controllers == {"effort_controller"} and request.strictness == request.BEST_EFFORT
        if not response.ok:
            return response
        self._is_active = not request.deactivate_controllers
        if self.BRAKES and not self._is_active:
            self.robot.stop("no controller is active")
        elif self.BRAKES:
            self.robot.restart()
        if not self.FORWARD:
            self._last = np.zeros(self.arm.n)
            self.send_zeros()
        return response


class FrankaDriver(EffortDriver):
    """franka_ros2: torques without gravity that change by 1 Nm a tick at most, and reflexes.

    `joint_states` are those of a joint_state_publisher, 30 a second, beside the broadcaster's own.
    """

    BRAKES = True
    STEP = 1.0
    STATES = Topic("franka/joint_states", "sensor_msgs/msg/JointState")
    SLOW_NS = NANOSECONDS // 30

    def __init__(self):
        super().__init__()
        self._reflexes = None
        self._write_slow, self._slow_ns = self.make_writer(topics.JOINT_STATES), 0
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
            self.robot.stop("reflex")
        super().publish_state(state)
        if state.stamp_ns - self._slow_ns >= self.SLOW_NS:
            self._slow_ns = state.stamp_ns
            self._write_slow(self._state_writer.write(state.q, state.v, state.torque, stamp_ns=state.stamp_ns))

    def _on_reflexes(self, request, response):
        self._reflexes = np.array(request.upper_torque_thresholds_nominal)
        response.success = True
        return response


class LbrDriver(StandIn):
    """lbr_fri_ros2_stack: FRI's state, torque overlays with positions, and the description with its settings."""

    COMMANDS = Topic("lbr/command/torque", "lbr_fri_idl/msg/LBRTorqueCommand")
    STATES = Topic("lbr/state", "lbr_fri_idl/msg/LBRState")

    def __init__(self):
        super().__init__()
        self.robot = KukaRobot(self._scene, self.period, **OF_KUKA)
        self.create_service(
            SetHardwareComponentState, "lbr/controller_manager/set_hardware_component_state", self._on_component
        )
        self._describe = self.make_publisher(topics.ROBOT_DESCRIPTION._replace(name="lbr/robot_description"))

    def activate(self):
        super().activate()
        self.robot.exchange()
        self._describe.publish(String(data=self.robot.description))

    def send_zeros(self):
        """The arm is carried from the beginning."""

    def read_torque(self, data):
        message = deserialize_message(data, LBRTorqueCommand)
        self.robot.aim(message.joint_position)
        return np.array(message.torque)

    def publish_state(self, state):
        # The session is over: the driver's process reports an error.
        if not self.robot.ended:
            self.write_state(serialize_message(LBRState(**self.robot.message())))

    def _on_component(self, request, response):
        response.ok = request.target_state.id == State.PRIMARY_STATE_INACTIVE
        if response.ok:
            self.robot.end("the connection is closed")
        return response


DRIVERS = {"effort": EffortDriver, "lbr": LbrDriver, "franka": FrankaDriver}

if __name__ == "__main__":
    assert topics.COMMANDS.name == "effort_controller/commands"
    kind = sys.argv.pop(1)
    while "=" in (sys.argv[1:] or [""])[0]:
        name, value = sys.argv.pop(1).split("=")
        if kind == "lbr":
            OF_KUKA[name] = float(value) if name == "stiffness" else value
        else:
            setattr(DRIVERS[kind], name, value if name == "RIVAL" else value == "true")
    sys.exit(run(DRIVERS[kind], [*sys.argv, "--ros-args", "-p", "watchdog.enabled:=false"]))
