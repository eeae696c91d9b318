"""Drive behind an effort controller of ros2_control."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.drives.settings import EFFORT, EffortSettings
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import command_writer

try:
    from controller_manager_msgs.srv import ListControllers, SwitchController
except ImportError:
    ListControllers = SwitchController = None

MANAGER = "controller_manager"
"""Name of the controller manager, which deactivates the controller, in the namespace of that controller."""
PACKAGE = "controller_manager_msgs"
_ACTIVE = "active"
_PATIENCE_S = 2.0
"""An answer that is lost, as before the server has discovered who asks, is not waited for any longer."""


class RepeatedRequest:
    """A request that is sent when the service is there, and again while no answer comes."""

    def __init__(self, client: Client, on_answer: Callable[[Any], None]) -> None:
        """`on_answer` is called with each answer, in the executor's thread."""
        self._client = client
        self._on_answer = on_answer
        self._future: Future | None = None
        self._sent = 0.0

    @property
    def is_there(self) -> bool:
        """Whether the service is there."""
        return bool(self._client.service_is_ready())

    def send(self, request: Any) -> None:
        """Send it, unless the service is not there, or an answer may still come; to be called again and again."""
        if not self.is_there:
            return
        if self._future is not None and not self._future.done():
            if time.monotonic() - self._sent < _PATIENCE_S:
                return
            self._client.remove_pending_request(self._future)
        self._sent = time.monotonic()
        self._future = self._client.call_async(request)
        self._future.add_done_callback(self._take)

    def _take(self, future: Future) -> None:
        answer = future.result()
        if answer is not None:
            self._on_answer(answer)


class EffortTarget:
    """Writes torques for `<controller>/commands` in the order of the controller's parameter `joints`.

    A stop deactivates the controller, unless the arm would drop then: deactivated, a JointGroupEffortController sends
    zeros, and a ForwardCommandController leaves the last torque.

    Attributes
    ----------
    topic
        Of the commands.
    order
        Names of the joints in the order of the commands; empty while it is not known.
    idle
        Why torques do not reach the arm, as the controller manager has answered `look`; empty if they do.
    """

    SECTION = EFFORT
    """Of its settings."""

    def __init__(self, node: Node, arm: Arm, settings: EffortSettings, carries: bool) -> None:
        """`carries`: whether the adapter's torques carry the arm."""
        self.topic = topics.COMMANDS._replace(name=f"{settings.controller}/commands")
        self.order: tuple[str, ...] = ()
        self.idle = ""
        self._name = settings.controller.rpartition("/")[2]
        """As the controller manager has it."""
        self._manager = f"{settings.controller.removesuffix(self._name)}{MANAGER}"
        self._order_problem = self._found = self._inactive = ""
        self._node, self._arm, self._settings = node, arm, settings
        self._indices: list[int] = []
        self._writer = command_writer(arm.n)
        self._question: RepeatedRequest | None = None
        self._switch = None
        self._list: RepeatedRequest | None = None
        if settings.ask_joints:
            parameters = node.create_client(GetParameters, f"{settings.controller}/get_parameters")
            self._question = RepeatedRequest(parameters, self._on_order)
            self._order_problem = f"the parameter joints of {settings.controller} is not known yet"
        else:
            self._take_order(arm.joint_names)
        if ListControllers is not None:
            self._list = RepeatedRequest(
                node.create_client(ListControllers, f"{self._manager}/list_controllers"), self._on_list
            )
        if carries and not settings.brakes:
            return
        if SwitchController is None:
            node.get_logger().warning(
                f"{PACKAGE} is not installed: a stop does not deactivate {settings.controller}, but sends harmless "
                "torques until ~/reset; install ros-jazzy-controller-manager-msgs"
            )
        else:
            self._switch = node.create_client(SwitchController, f"{self._manager}/switch_controller")

    @property
    def problem(self) -> str:
        """Why nothing can be passed on; empty when it can."""
        return self._order_problem + self._found if self._order_problem else self._inactive

    def look(self) -> None:
        """Ask for the order of joints, which may be another after a restart, and whether torques reach the arm.

        To be called a few times a second.
        """
        if self._list is not None:
            self._list.send(ListControllers.Request())
        if self._question is not None:
            self._found = self._find_elsewhere() if self._order_problem else ""
            self._question.send(GetParameters.Request(names=["joints"]))

    def prepare(self) -> bool:
        """Nothing has to be prepared with harmless torques before the first command."""
        return False

    def hear(self, node: str, settings: Mapping[str, Any]) -> str:
        """Why a node's settings do not fit the drive; empty if they do."""
        return ""

    def diagnosis(self) -> dict[str, Any]:
        """There is nothing to report."""
        return {}

    def write(self, torque: Array) -> bytes:
        """The message with these torques (n,), N m, in the arm's order; not while there is a `problem`."""
        return self._writer.write(torque[self._indices])

    def stop(self) -> None:
        """Deactivate the controller, if that is possible; without waiting for it."""
        self._switch_controller("deactivate")

    def check_reset(self) -> None:
        """Raise `InputError` while the controller is not active, where `resume` would not activate it after a stop."""
        if self._switch is None and self._inactive:
            raise InputError(self._inactive)

    def resume(self, was_stopped: bool) -> None:
        """Activate it again after a stop."""
        if was_stopped:
            self._switch_controller("activate")

    def _find_elsewhere(self) -> str:
        """Where else there is a controller of that name, in words; empty if it is where it is looked for."""
        own = self._node.resolve_topic_name(self._settings.controller)
        nodes = self._node.get_node_names_and_namespaces()
        found = {f"{namespace.rstrip('/')}/{each}" for each, namespace in nodes if each == self._name}
        if not found or own in found:
            return ""
        return f"; there is {', '.join(sorted(found))}: set the parameter {self.SECTION}.controller to it"

    def _on_order(self, answer: Any) -> None:
        self._take_order(tuple(answer.values[0].string_array_value) if answer.values else ())

    def _take_order(self, joints: tuple[str, ...]) -> None:
        names = self._arm.joint_names
        if sorted(joints) != sorted(names):
            self._order_problem = (
                f"{self._settings.controller} takes commands for the joints {', '.join(joints) or 'none'}; expected "
                f"{', '.join(names)} in any order: set its parameter joints"
            )
            return
        self._indices = [names.index(name) for name in joints]
        self.order, self._order_problem = joints, ""

    def _on_list(self, answer: Any) -> None:
        name, found = self._name, {each.name: each for each in answer.controller}
        # One that is not loaded may be that of another controller manager.
        state, inactive = found[name].state if name in found else _ACTIVE, ""
        self.idle = "" if state == _ACTIVE else f"{name} is {state}"
        if self.idle:
            others = [each.name for each in found.values() if each.state == _ACTIVE and self._is_of_arm(each)]
            instead = f"; the drive is commanded by {', '.join(others)}" if others else ""
            switch = f"--activate {name}" + (f" --deactivate {' '.join(others)}" if others else "")
            inactive = f"{self.idle}{instead}: ros2 control switch_controllers -c {self._manager} {switch}"
        # At once: the loop reads it in another thread.
        self._inactive = inactive

    def _is_of_arm(self, controller: Any) -> bool:
        """Whether a controller commands a joint of the arm, itself or through another one."""
        parts = {part for claim in controller.claimed_interfaces for part in claim.split("/")}
        return not parts.isdisjoint(self._arm.joint_names)

    def _switch_controller(self, act: str) -> None:
        if self._switch is None:
            return
        # Strict, a manager refuses what is done already; of one controller there is nothing else to lose.
        request: Any = SwitchController.Request(strictness=SwitchController.Request.BEST_EFFORT)
        setattr(request, f"{act}_controllers", [self._name])
        self._switch.call_async(request).add_done_callback(lambda future: self._on_switched(act, future))

    def _on_switched(self, act: str, future: Future) -> None:
        logger, name = self._node.get_logger(), self._name
        if future.result() is not None and future.result().ok:
            logger.info(f"{self._manager} was asked to {act} {name}")
        else:
            logger.error(f"{self._manager} did not {act} {name}; see its log")
