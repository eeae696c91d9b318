"""Names of the nodes, and which of them publish what moves the arm.

Another publisher of these topics stops the arm, and `contact-reach doctor` names it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from contact_reach_ros.control.supervisor import RESET_ORDER
from contact_reach_ros.messages import topics
from contact_reach_ros.settings import NODES

DRIVER, CONTROLLER, OBSERVER, PLANNER = "driver", "controller", "observer", "planner"
ADAPTER, RECORDER, VIEWER, DEMO, REPLAY = "adapter", "recorder", "viewer", "demo", "replay"
DOCTOR = "contact_reach_doctor"
OPERATOR = "operator"
"""The node of contact-reach goto, home, identify, speed, stop and reset."""

STOPPABLE = RESET_ORDER[::-1]
"""Nodes with the services ~/stop and ~/reset."""

ALONE = (topics.JOINT_STATES, topics.COMMANDS, topics.REFERENCE_POSE, topics.REFERENCE_POSTURE)
"""Topics that must have a single publisher: with two, the arm receives the commands of both in turn."""

MANAGED = tuple(name for name in NODES if name != "bringup")
"""The lifecycle nodes."""

OWNERS: Mapping[str, Sequence[str]] = {
    topics.JOINT_STATES.name: (DRIVER,),
    topics.COMMANDS.name: (CONTROLLER, ADAPTER),
    topics.ADAPTER_COMMANDS.name: (CONTROLLER,),
    topics.REFERENCE_POSE.name: (PLANNER,),
    topics.REFERENCE_POSTURE.name: (PLANNER,),
    topics.SAFETY_STATE.name: (DRIVER, CONTROLLER, OBSERVER, ADAPTER),
    topics.EXTERNAL_TORQUE.name: (OBSERVER,),
}
"""The nodes that publish the topics without which the arm does not move, or in place of which nobody else may."""
