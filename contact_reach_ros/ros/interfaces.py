"""Names of the nodes, and the topics that each may publish.

A second publisher of a topic stops the arm, and `contact-reach doctor` names it.
"""

from __future__ import annotations

from contact_reach_ros.control.supervisor import RESET_ORDER
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic

DRIVER, CONTROLLER, OBSERVER, PLANNER = "driver", "controller", "observer", "planner"
ADAPTER, RECORDER, VIEWER, DEMO, REPLAY = "adapter", "recorder", "viewer", "demo", "replay"
DOCTOR = "contact_reach_doctor"
OPERATOR = "operator"
"""The node of contact-reach goto, home, identify, speed, stop and reset."""

STOPPABLE = RESET_ORDER[::-1]
"""Nodes with the services ~/stop and ~/reset."""

_REFERENCES = (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE)
ALONE = (topics.JOINT_STATES, topics.COMMANDS, *_REFERENCES)
"""Topics that must have a single publisher: with two, the arm receives the commands of both in turn."""


def _topics(*published: Topic) -> frozenset[str]:
    return frozenset(topic.name for topic in (*published, topics.DIAGNOSTICS, topics.SETTINGS))


MANAGED = {
    DRIVER: _topics(
        topics.JOINT_STATES,
        topics.SIM_CONTACTS,
        topics.OBSTACLES,
        topics.CLOCK,
        topics.SAFETY_STATE,
    ),
    CONTROLLER: _topics(
        topics.COMMANDS,
        topics.ADAPTER_COMMANDS,
        topics.SHADOW_COMMANDS,
        topics.SAFETY_STATE,
        topics.CONTROLLER_INTAKE,
        topics.LOCKSTEP_HORIZON,
    ),
    OBSERVER: _topics(
        topics.EXTERNAL_TORQUE,
        topics.EXTERNAL_WRENCH,
        topics.SAFETY_STATE,
        topics.OBSERVER_INTAKE,
        topics.LOCKSTEP_HORIZON,
    ),
    PLANNER: _topics(
        *_REFERENCES,
        topics.PLAN_PATH,
        topics.PLAN_MARKERS,
        topics.PLAN_STATISTICS,
        topics.PLAN_REQUEST,
        topics.GOAL_STATE,
        topics.ROBOT_DESCRIPTION,
        topics.LOCKSTEP_HORIZON,
    ),
    ADAPTER: _topics(topics.COMMANDS, topics.SAFETY_STATE, topics.LOCKSTEP_HORIZON),
    RECORDER: _topics(topics.LOCKSTEP_HORIZON),
    VIEWER: _topics(topics.GOAL_POSE),
}
"""The lifecycle nodes, each with the topics that it may publish."""
