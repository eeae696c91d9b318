"""The controller: one torque command for every joint state."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.reference import PoseKnots, PostureKnots
from contact_reach_ros.control.reference_messages import pose_knots, posture_knots
from contact_reach_ros.control.settings import ImpedanceSettings, LimitSettings, SupervisionSettings
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.managed import ManagedNode, run
from contact_reach_ros.nodes.messages import nanoseconds, set_time
from contact_reach_ros.nodes.observer import NAME as OBSERVER
from contact_reach_ros.nodes.parameters import Sections
from contact_reach_ros.nodes.realtime import Role
from contact_reach_ros.nodes.rivals import LOOK_AROUND_S, rivalry
from contact_reach_ros.nodes.serialized import CommandWriter, JointStateReader
from contact_reach_ros.observer.safety import DISTRUST
from contact_reach_ros.recording.intake import Taken
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.timing import Histogram, StampOrder, write_counts

PRIORITY = 70

NAME = "controller"


class ControllerNode(ManagedNode):
    """Runs the controller's tick for each joint state and publishes the torque."""

    NAME = NAME
    SECTIONS: ClassVar[Sections] = {
        "impedance": ImpedanceSettings,
        "limits": LimitSettings,
        "supervision": SupervisionSettings,
    }

    def __init__(self) -> None:
        super().__init__()
        self._shadow: bool = self.settings["supervision"].shadow
        commands = topics.SHADOW_COMMANDS if self._shadow else topics.COMMANDS
        self._write_commands = self.make_writer(commands.kept(self.lockstep))
        self._safety = self.make_publisher(topics.SAFETY_STATE)
        # Safety before joint states: a tick uses all that came before it. Plans, which take effect later and take as
        # long to read as a tick, come after it; not in lockstep, where a tick uses them, too, and nothing is late.
        self.inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        self.inbox.add(topics.REFERENCE_POSE, self._on_poses, hurried=self.lockstep)
        self.inbox.add(topics.REFERENCE_POSTURE, self._on_postures, hurried=self.lockstep)
        self._horizons: dict[str, int] = {}
        """Up to which state observer and planner have said everything, ns; those that have been heard of."""
        if self.lockstep:
            self.inbox.add(topics.LOCKSTEP_HORIZON, self._on_horizon, topics.EVERY)
            self.inbox.add(topics.JOINT_STATES, self._on_state, topics.EVERY, serialized=True, ready=self._all_said)
        else:
            self.inbox.add(topics.JOINT_STATES, self._on_state, topics.NEWEST, serialized=True)
        self._horizon = self.make_publisher(topics.LOCKSTEP_HORIZON) if self.lockstep else None
        self._intake = self.log_intake(topics.CONTROLLER_INTAKE)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self._reader = JointStateReader(iiwa14.JOINT_NAMES, topics.JOINT_STATES.name)
        self._writer = CommandWriter(iiwa14.N_JOINTS)
        settings = ControllerSettings(self.settings["impedance"], self.settings["limits"], self.settings["supervision"])
        self._controller = Controller(settings, RobotModel())
        self._started = False
        self._order = StampOrder()
        self._state_ns = 0
        self._state = (np.zeros(iiwa14.N_JOINTS), np.zeros(iiwa14.N_JOINTS))
        self._compute = Histogram()
        self._published_mode: tuple[Mode, str] | None = None
        self._rivalry = "not looked for other publishers yet"
        self.create_timer(LOOK_AROUND_S, self._look_around, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Warm everything up."""
        _rehearse(Controller(self._controller.settings, self._controller.model))
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start from the next joint state."""
        self._started = False
        self._look_around()
        return super().on_activate(state)

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Mode, plan age and computing time."""
        controller = self._controller
        waiting = "" if self._started else self._rivalry
        values = {
            "mode": controller.mode.value,
            "plans accepted": controller.references.accepted,
            "plan halves unpaired": controller.references.unpaired,
            "plan age s": controller.references.age(self._state_ns),
            "position error m": float(np.linalg.norm(controller.error[:3])),
            "joint states repeated": self._order.repeated,
            "joint states older": self._order.older,
            **{f"compute {key} us": value for key, value in self._compute.summary().items()},
            "compute counts": write_counts(self._compute.counts()),
        }
        return controller.stop_reason or waiting, values

    def _look_around(self) -> None:
        """Nobody else may command the arm or publish references; runs beside the loop, a few times a second."""
        # In the shadow of another controller there is one that commands.
        self._rivalry = rivalry(self, (topics.COMMANDS, topics.REFERENCE_POSE, topics.REFERENCE_POSTURE))
        if self._rivalry and self._started and not self._controller.stop_reason:
            reason = self._rivalry
            self.inbox.post(lambda: self._stop_for(reason))

    def _clock_ns(self) -> int:
        """Clock of the watchdogs: the steady one, or simulated time in lockstep, where real time means nothing."""
        return self._state_ns if self.lockstep else self.inbox.handled_ns

    def _on_state(self, data: bytes) -> None:
        controller = self._controller
        try:
            stamp_ns, q, v, _ = self._reader.read(data)
            if self._started and not self._order.is_new(stamp_ns):
                return
            self._state_ns = stamp_ns
            if not self._started:
                if self._rivalry:
                    raise InputError(f"{self._rivalry}: nothing is commanded; end the others")
                controller.start(q, v, self._state_ns)
                self._started = True
                self._order.is_new(stamp_ns)
            torque = controller.tick(q, v, self._state_ns, self._clock_ns())
        except InputError as error:
            self.refuse("joint states", error)
            return
        self._state = (q, v)
        if torque is not None:
            self._write_commands(self._writer.write(torque))
            self._intake.outputs += 1
        elif self._horizon is not None:
            # In lockstep the driver waits for an answer; this one is no command.
            header = Header(frame_id=NAME)
            set_time(header.stamp, stamp_ns)
            self._horizon.publish(header)
        self._compute.add(time.monotonic_ns() - self.inbox.handled_ns)
        if (controller.mode, controller.stop_reason) != self._published_mode:
            self._publish_safety()

    def _on_horizon(self, message: Header) -> None:
        if message.frame_id != NAME:
            said_ns = nanoseconds(message.stamp)
            # After the clock was set back what was said before still holds.
            self._horizons[message.frame_id] = max(said_ns, self._horizons.get(message.frame_id, 0))

    def _all_said(self) -> bool:
        """In lockstep: whether all that the last state has led to is here, so that each run is like the other.

        The driver has it before it publishes the next state, but it does not come here by the same way.
        """
        return not self._started or all(said_ns > self._state_ns for said_ns in self._horizons.values())

    def _on_poses(self, message: MultiDOFJointTrajectory) -> None:
        try:
            self._controller.references.offer_poses(pose_knots(message), self._state_ns)
        except InputError as error:
            self.refuse("references", error)

    def _on_postures(self, message: JointTrajectory) -> None:
        try:
            self._controller.references.offer_postures(posture_knots(message), self._state_ns)
        except InputError as error:
            self.refuse("references", error)

    def _on_safety(self, message: DiagnosticStatus) -> None:
        # Before the first state there is no time to compare with.
        if message.name == OBSERVER and self._started:
            reason = message.message if message.level >= DiagnosticStatus.ERROR else ""
            distrust = next((item.value for item in message.values if item.key == DISTRUST), "")
            self._controller.observer_report(reason, self._clock_ns(), distrust)

    def _publish_safety(self) -> None:
        controller = self._controller
        self._published_mode = (controller.mode, controller.stop_reason)
        stopped = controller.supervisor.stopped
        message = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if stopped else DiagnosticStatus.OK,
            name=NAME,
            message=controller.stop_reason if stopped else controller.mode.value,
            hardware_id="iiwa14",
            values=[KeyValue(key="mode", value=controller.mode.value)],
        )
        self._safety.publish(message)
        if stopped:
            what = "compliant stop" if controller.mode is Mode.STOPPED else "stop"
            self.say(LoggingSeverity.ERROR, f"{what}: {controller.stop_reason}; call ~/reset to go on")

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        # The loop may be slow to answer, but stops all the same.
        self.inbox.post(lambda: self._stop_for("stop service called"))
        response.success, response.message = True, "compliant stop"
        return response

    def _stop_for(self, reason: str) -> None:
        self.inbox.note(Taken.STOP)
        self._controller.stop(reason)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            # In the loop's thread, or it might be in the middle of a tick.
            self.inbox.call(self._reset)
        except (InputError, TimeoutError) as error:
            response.message = str(error)
            return response
        response.success, response.message = True, "holding; send a goal to go on"
        return response

    def _reset(self) -> None:
        """Release a stop; raises `InputError` if there is a reason against it."""
        if not self._started:
            raise InputError("the controller has not seen a joint state yet")
        if self._rivalry:
            raise InputError(f"{self._rivalry}: end the others first")
        self.inbox.note(Taken.RESET)
        self._controller.reset(*self._state, self._state_ns, self._clock_ns())


def _rehearse(controller: Controller) -> None:
    """Go through everything once: what libraries do at their first call must not happen while an arm waits."""
    q, v = np.array(iiwa14.HOME_POSITION), np.zeros(iiwa14.N_JOINTS)
    controller.start(q, v, 0)
    controller.tick(q, v, 1, 1)
    pose, rotation = controller.model.flange_pose(q)
    controller.references.offer_poses(PoseKnots(1, (10,), pose[None], rotation[None]), 1)
    controller.references.offer_postures(PostureKnots(1, (10,), q[None]), 1)
    for now_ns in (2, 20):
        controller.tick(q, v, now_ns, now_ns)


def main() -> None:
    """Run the controller."""
    sys.exit(run(ControllerNode, Role.LOOP, sys.argv, PRIORITY))


if __name__ == "__main__":
    main()
