"""The observer's node: joint states in, external torque and safety state out."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import KeyValue

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_safety_state
from contact_reach_ros.messages.intake import Taken
from contact_reach_ros.messages.safety_state import MONITORING, STOPS_CALLED, findings
from contact_reach_ros.messages.serialized import JointStateReader, joint_state_writer, wrench_writer
from contact_reach_ros.observer.budget import BUDGET, load_budget
from contact_reach_ros.observer.observer import Observer, SafetyReport
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS, ObserverSettings, SourceSettings
from contact_reach_ros.ros.managed_node import StoppableNode
from contact_reach_ros.ros.process import run
from contact_reach_ros.timing import NANOSECONDS

_WRENCH_EVERY = 10


class ObserverNode(StoppableNode):
    """Passes joint states to the observer and publishes its reports."""

    NAME = "observer"
    SECTIONS = OBSERVER_SECTIONS
    RELEASED = MONITORING

    def __init__(self) -> None:
        super().__init__()
        self._write_torque = self.make_writer(topics.EXTERNAL_TORQUE)
        self._write_wrench = self.make_writer(topics.EXTERNAL_WRENCH)
        self._safety = self.make_publisher(topics.SAFETY_STATE)
        self._intake = self.log_intake(topics.OBSERVER_INTAKE)
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name)
        source: SourceSettings = self.settings[""]
        self.settings[BUDGET] = load_budget(source.contact_budget).resolve(self.arm)
        self._observer = self._make_observer()
        self._torque_writer = joint_state_writer(self.arm.joint_names, self.arm.base_frame, ["effort"])
        self._wrench_writer = wrench_writer(self.arm.base_frame)
        # What two arms report in turns is the external torque of neither.
        self.exclude([topics.JOINT_STATES])
        self._seen_ns = 0
        """When the last new state came, on the watchdogs' clock."""
        self.follow(topics.JOINT_STATES, self._on_state)

    def configure(self) -> None:
        """Warm up all computations."""
        self._make_observer().rehearse()

    @property
    def stop_reason(self) -> str:
        """Why the arm is stopped; empty if it is not."""
        return self._observer.monitor.stop_reason

    @property
    def is_engaged(self) -> bool:
        """Whether the observer watches."""
        return self.running

    def stop_for(self, reason: str) -> None:
        """Stop the arm."""
        self.note_call(Taken.STOP)
        self._observer.stop(reason)

    def reset(self) -> None:
        """Release a stop. Raises `InputError` if the arm may not be released yet."""
        self.note_call(Taken.RESET)
        self._observer.reset((self.arrived_ns - self._seen_ns) / NANOSECONDS)

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Why it stops the arm, or doubts what it gets; ticks, counts, and the values of the safety state."""
        observer = self._observer
        values = {
            "ticks": observer.updates,
            "gaps": observer.momentum.gaps,
            "refused states": observer.momentum.refused,
            "joint states repeated": observer.order.repeated,
            "joint states older": observer.order.older,
            "contacts": observer.monitor.contacts,
            "stops": observer.monitor.stops,
            "joint states Hz": observer.sight.rate.frequency,
            **findings(observer.report()),
        }
        return observer.monitor.stop_reason or self.rivals or observer.report().verdict.doubt, values

    def _make_observer(self) -> Observer:
        return Observer(self.arm, ObserverSettings.from_sections(self.settings), self.settings[BUDGET], self.period)

    def _on_state(self, data: bytes) -> None:
        report = self._observer.update(self._reader.read(data))
        if report is not None:
            self._seen_ns = self.arrived_ns
            self._publish(report)

    def _publish(self, report: SafetyReport) -> None:
        self._write_torque(self._torque_writer.write(report.residual, stamp_ns=report.stamp_ns))
        self._intake.outputs += 1
        if report.due:
            reason, distrust, *_ = report.verdict
            if reason and report.has_news:
                why = reason if distrust in ("", reason) else f"{reason}; {distrust}"
                # Bags must not end between a stop and what led to it.
                self._intake.flush()
                way = "; call ~/reset to continue" if self._observer.monitor.stop_reason else ""
                self.say(f"stop: {why}{way}")
            state = to_safety_state(report, self.NAME, self.arm)
            state.values.append(KeyValue(key=STOPS_CALLED, value=str(self.stops_called)))
            self._safety.publish(state)
        if self._observer.updates % _WRENCH_EVERY == 0:
            self._write_wrench(
                self._wrench_writer.write(self._observer.momentum.flange_wrench(), stamp_ns=report.stamp_ns)
            )


if __name__ == "__main__":
    sys.exit(run(ObserverNode, sys.argv))
