"""The observer: external torque from joint states, and the safety state that stops the arm."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from contact_reach_ros.errors import InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.managed import ManagedNode, run
from contact_reach_ros.nodes.messages import set_time
from contact_reach_ros.nodes.parameters import Sections
from contact_reach_ros.nodes.realtime import Role
from contact_reach_ros.nodes.serialized import JointStateReader, JointStateWriter, WrenchWriter, read_command
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.location import Contact, ContactLocator
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings, measured_torque
from contact_reach_ros.observer.plausibility import PlausibilityCheck, PlausibilitySettings
from contact_reach_ros.observer.safety import DISTRUST, Level, SafetyMonitor, SafetySettings
from contact_reach_ros.plant.drive import checked_command
from contact_reach_ros.plant.plant import TICK
from contact_reach_ros.recording.intake import Taken
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.timing import StampOrder
from contact_reach_ros.units import NANOSECONDS

PRIORITY = 60

NAME = "observer"

"""Key of the value of `safety_state` that says what is wrong with the joint states, when something is."""

_WRENCH_EVERY = 10
_HEARTBEAT_EVERY = 10

_LEVELS = {
    Level.FREE: DiagnosticStatus.OK,
    Level.CONTACT: DiagnosticStatus.WARN,
    Level.COLLISION: DiagnosticStatus.ERROR,
}
_MONITORING = "monitoring"


@dataclass(frozen=True)
class ObserverSettings(Settings):
    """Where the observer takes its numbers from."""

    contact_budget: str = setting("", "contact budget YAML; the one of the package when empty")
    torque_source: str = setting(
        "measured",
        "torque that acts on the links: the effort of joint_states, or the commands",
        choices=("measured", "commanded"),
    )


_LINK, _FORCE, _POSITION = "contact link", "contact force xyz N", "contact position xyz m"


def read_contact(message: DiagnosticStatus) -> Contact | None:
    """The contact that the observer's safety state tells of; None when it tells of none.

    Raises
    ------
    InputError
        If link, point or force are none.
    """
    values = {item.key: item.value for item in message.values}
    if _LINK not in values:
        return None
    try:
        position, force = (np.array(values[key].split(), float).reshape(3) for key in (_POSITION, _FORCE))
    except (KeyError, ValueError) as error:
        raise InputError(f"safety_state: {_POSITION} and {_FORCE} must be three numbers each ({error})") from error
    links = [iiwa14.LINK_NAMES[capsule.link - 1] for capsule in iiwa14.CAPSULES]
    if values[_LINK] not in links or not np.isfinite([position, force]).all():
        raise InputError(
            f"safety_state: {_LINK} = {values[_LINK]} at {position} with {force}: expected finite numbers and one of "
            f"{', '.join(links)}"
        )
    return Contact(values[_LINK], position, force, float("nan"))


class ObserverNode(ManagedNode):
    """Runs the momentum observer and the safety monitor for each joint state."""

    NAME = NAME
    SECTIONS: ClassVar[Sections] = {
        "": ObserverSettings,
        "momentum": MomentumSettings,
        "safety": SafetySettings,
        "plausibility": PlausibilitySettings,
    }

    def __init__(self) -> None:
        super().__init__()
        self._write_torque = self.make_writer(topics.EXTERNAL_TORQUE.kept(self.lockstep))
        self._write_wrench = self.make_writer(topics.EXTERNAL_WRENCH)
        self._safety = self.make_publisher(topics.SAFETY_STATE)
        self._horizon = self.make_publisher(topics.LOCKSTEP_HORIZON) if self.lockstep else None
        qos = topics.EVERY if self.lockstep else topics.NEWEST
        self._commanded: np.ndarray | None = None
        if self.settings[""].torque_source == "commanded":
            self.inbox.add(topics.COMMANDS, self._on_command, qos, serialized=True)
        self.inbox.add(topics.JOINT_STATES, self._on_state, qos, serialized=True)
        self._intake = self.log_intake(topics.OBSERVER_INTAKE)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_service(Trigger, "~/reset", self._on_reset)
        measured = self.settings[""].torque_source == "measured"
        self._reader = JointStateReader(iiwa14.JOINT_NAMES, topics.JOINT_STATES.name, with_effort=measured)
        self._model = RobotModel()
        self._observer = MomentumObserver(self.settings["momentum"], self._model)
        self._budget = load_budget(self.settings[""].contact_budget)
        self._monitor = SafetyMonitor(self.settings["safety"], self._budget)
        self._check = PlausibilityCheck(self.settings["plausibility"], self._budget.contact_thresholds)
        self._locator = ContactLocator(self._model, self._budget.contact_thresholds)
        self._contact: Contact | None = None
        self._ticks = 0
        self._order = StampOrder()
        self._published: tuple[Level, str, str] | None = None
        self._torque_writer = JointStateWriter(iiwa14.JOINT_NAMES, iiwa14.BASE_NAME, ["effort"])
        self._wrench_writer = WrenchWriter(iiwa14.BASE_NAME)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Warm everything up."""
        _rehearse(MomentumObserver(self.settings["momentum"], self._model), self._locator)
        return super().on_configure(state)

    def files(self) -> Mapping[str, Settings]:
        """The contact budget."""
        return {"budget": self._budget}

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Ticks, what was counted, and what the safety state says."""
        values = {
            "ticks": self._ticks,
            "gaps": self._observer.gaps,
            "refused states": self._observer.refused,
            "joint states repeated": self._order.repeated,
            "joint states older": self._order.older,
            "contacts": self._monitor.contacts,
            "stops": self._monitor.stops,
            **self._findings(),
        }
        return self._monitor.stop_reason, values

    def _on_command(self, data: bytes) -> None:
        try:
            self._commanded = checked_command(read_command(data))
        except InputError as error:
            self.refuse("commands", error)

    def _on_state(self, data: bytes) -> None:
        try:
            stamp_ns, q, v, effort = self._reader.read(data)
            torque = self._acting_torque(effort)
            if not np.isfinite(q.sum() + v.sum()):
                raise InputError(f"joint_states: position and velocity must be finite, got {q.tolist()}, {v.tolist()}")
        except InputError as error:
            self.refuse("joint states", error)
            return
        if self._order.is_new(stamp_ns):
            self._observer.update(q, v, torque, stamp_ns)
            self._monitor.update(self._observer.residual, v, self._observer.known_for)
            wrong = self._check.update(q, v, self._monitor.sudden, stamp_ns)
            if wrong:
                self._monitor.stop_distrusting(wrong)
            self._publish(stamp_ns, q)
        if self._horizon is not None:
            header = Header(frame_id=NAME)
            set_time(header.stamp, stamp_ns + int(TICK * NANOSECONDS))
            self._horizon.publish(header)

    def _acting_torque(self, effort: np.ndarray | None) -> np.ndarray | None:
        """Torque (7,) N m of the last step, None where it is not known, as while the brakes are closed."""
        if self.settings[""].torque_source == "commanded":
            torque, self._commanded = self._commanded, None
            return torque
        return measured_torque(effort)

    def _publish(self, stamp_ns: int, q: np.ndarray) -> None:
        self._ticks += 1
        self._write_torque(self._torque_writer.write(stamp_ns, self._observer.residual))
        self._intake.outputs += 1
        heartbeat = self._ticks % _HEARTBEAT_EVERY == 0
        if heartbeat:
            self._contact = self._locator.locate(q, self._monitor.sudden) if self._monitor.in_contact else None
        if heartbeat or self._safety_state() != self._published:
            self._publish_safety()
        if self._ticks % _WRENCH_EVERY == 0:
            self._publish_wrench(stamp_ns)

    def _publish_wrench(self, stamp_ns: int) -> None:
        self._write_wrench(self._wrench_writer.write(stamp_ns, self._observer.flange_wrench()))

    def _publish_safety(self) -> None:
        """The safety state, also as the sign of life that the controller waits for."""
        state = level, reason, distrust = self._safety_state()
        if reason and state != self._published:
            why = reason if distrust in ("", reason) else f"{reason}; {distrust}"
            self.say(LoggingSeverity.ERROR, f"stop: {why}; call ~/reset to go on")
        self._published = state
        message = DiagnosticStatus(
            level=_LEVELS[level],
            name=NAME,
            # Numbers are among the values only: the message tells when the state changes.
            message=reason or (_MONITORING if level is Level.FREE else level.value),
            hardware_id="iiwa14",
            values=[KeyValue(key=key, value=value) for key, value in self._findings().items()],
        )
        self._safety.publish(message)

    def _safety_state(self) -> tuple[Level, str, str]:
        return self._monitor.level, self._monitor.stop_reason, self._monitor.distrust

    def _findings(self) -> dict[str, str]:
        """What the external torque says; link and force are known from the first heartbeat in contact on."""
        findings = {
            "level": self._monitor.level.value,
            "external torque max Nm": f"{np.abs(self._observer.residual).max():.3f}",
        }
        if self._monitor.distrust:
            findings[DISTRUST] = self._monitor.distrust
        contact = self._contact
        if contact is not None:
            findings[_LINK] = contact.link
            findings["contact force N"] = f"{contact.strength:.1f}"
            findings[_FORCE] = " ".join(f"{value:.1f}" for value in contact.force.tolist())
            findings[_POSITION] = " ".join(f"{value:.3f}" for value in contact.position.tolist())
        return findings

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        # The loop may be slow to answer, but stops all the same.
        self.inbox.post(self._stop_for_service)
        response.success, response.message = True, "stopped"
        return response

    def _stop_for_service(self) -> None:
        self.inbox.note(Taken.STOP)
        self._monitor.stop("stop service called")

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            # In the loop's thread, or it might be in the middle of a state.
            self.inbox.call(self._reset)
        except (InputError, TimeoutError) as error:
            response.message = str(error)
            return response
        response.success, response.message = True, _MONITORING
        return response

    def _reset(self) -> None:
        self.inbox.note(Taken.RESET)
        self._monitor.reset()


def _rehearse(observer: MomentumObserver, locator: ContactLocator) -> None:
    """Go through everything once: what libraries do at their first call must not happen while an arm waits."""
    zero, home = np.zeros(iiwa14.N_JOINTS), np.array(iiwa14.HOME_POSITION)
    for stamp_ns in (0, 1_000_000):
        observer.update(home, zero, zero, stamp_ns)
    observer.flange_wrench()
    locator.locate(home, observer.residual)


def main() -> None:
    """Run the observer."""
    sys.exit(run(ObserverNode, Role.MONITOR, sys.argv, PRIORITY))


if __name__ == "__main__":
    main()
