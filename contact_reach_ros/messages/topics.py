"""Every topic of the stack: name, message type and quality of service, in one place. It needs no ROS."""

from __future__ import annotations

import functools
import importlib
from typing import Any, NamedTuple


class Qos(NamedTuple):
    """Quality of service that a publisher offers, or a subscriber requests; `ros.inbox` makes rclpy's profile of it."""

    depth: int
    """Messages that are kept."""
    reliable: bool = True
    latched: bool = False
    """Whether subscribers that come late receive the messages that are kept."""


STREAM = Qos(1000)
"""What publishers offer: reliable and deep, so that busy subscribers lose nothing."""

KEPT_STREAM = Qos(4000, latched=True)
"""A stream whose last four seconds late subscribers receive, where time is simulated.

On a busy machine a recorder may need seconds to discover a topic.
"""

LATCHED = Qos(1, latched=True)
"""Late subscribers receive the last message."""

LATCHED_EVENTS = Qos(100, latched=True)
"""Late subscribers receive the last events, or notes: the newest alone does not give the whole state."""

ALL_EVENTS = Qos(1000, latched=True)
"""What subscribers of events request: deep enough for all publishers together, or a talkative one hides the others."""

NEWEST = Qos(1, reliable=False)
"""What real-time subscribers request: only the last message counts."""


@functools.cache
def message_class(name: str) -> Any:
    """The class of a message type, such as sensor_msgs/msg/JointState; None if it is not installed."""
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind, None)
    except (ImportError, TypeError, ValueError):
        return None


class Topic(NamedTuple):
    """One topic, with the quality of service that its publishers offer."""

    name: str
    type_name: str
    """Type as ROS writes it, such as sensor_msgs/msg/JointState."""
    qos: Qos = STREAM
    called: str = ""
    """What its messages are called where they are refused; see `contents`."""
    from_anybody: bool = False
    """Whether publishers that keep no messages are heard, too, where late subscribers receive kept ones."""

    @property
    def contents(self) -> str:
        """What its messages are called where they are refused, such as 'joint states'."""
        return self.called or self.name.replace("_", " ")

    @property
    def type(self) -> Any:
        """Class of its messages; None if it is not installed."""
        return message_class(self.type_name)


JOINT_STATES = Topic("joint_states", "sensor_msgs/msg/JointState")
COMMANDS = Topic("effort_controller/commands", "std_msgs/msg/Float64MultiArray", called="commands")
ADAPTER_COMMANDS = Topic("adapter/commands", "std_msgs/msg/Float64MultiArray", called="commands")
SHADOW_COMMANDS = Topic("shadow/commands", "std_msgs/msg/Float64MultiArray", called="commands")
GOAL_POSE = Topic("goal_pose", "geometry_msgs/msg/PoseStamped", called="goals")
GOAL_STATE = Topic("goal/state", "diagnostic_msgs/msg/DiagnosticStatus", LATCHED_EVENTS, called="goal states")
REFERENCE_POSE = Topic("reference/pose", "trajectory_msgs/msg/MultiDOFJointTrajectory", called="references")
REFERENCE_POSTURE = Topic("reference/posture", "trajectory_msgs/msg/JointTrajectory", called="references")
OBSTACLES = Topic("obstacles", "visualization_msgs/msg/MarkerArray", LATCHED, from_anybody=True)
EXTERNAL_TORQUE = Topic("external_torque", "sensor_msgs/msg/JointState", called="external torques")
EXTERNAL_WRENCH = Topic("external_wrench", "geometry_msgs/msg/WrenchStamped")
SAFETY_STATE = Topic("safety_state", "diagnostic_msgs/msg/DiagnosticStatus", LATCHED_EVENTS, called="safety states")
DIAGNOSTICS = Topic("diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
PLAN_PATH = Topic("plan/path", "nav_msgs/msg/Path")
PLAN_MARKERS = Topic("plan/markers", "visualization_msgs/msg/MarkerArray", called="plans")
SIM_CONTACTS = Topic("sim/contacts", "sensor_msgs/msg/JointState", called="contacts")
ROBOT_DESCRIPTION = Topic("robot_description", "std_msgs/msg/String", LATCHED)
CLOCK = Topic("clock", "rosgraph_msgs/msg/Clock")
SETTINGS = Topic("settings", "diagnostic_msgs/msg/DiagnosticStatus", LATCHED_EVENTS)
CONTROLLER_INTAKE = Topic("intake/controller", "std_msgs/msg/Int64MultiArray", LATCHED_EVENTS)
OBSERVER_INTAKE = Topic("intake/observer", "std_msgs/msg/Int64MultiArray", LATCHED_EVENTS)
PLAN_STATISTICS = Topic("plan/statistics", "diagnostic_msgs/msg/DiagnosticArray")
PLAN_REQUEST = Topic("plan/request", "std_msgs/msg/Float64MultiArray")
LOCKSTEP_HORIZON = Topic("lockstep/horizon", "std_msgs/msg/Header", KEPT_STREAM, called="promises")

ALL = tuple(value for value in list(vars().values()) if isinstance(value, Topic))
"""What a recorder writes."""

OF_OTHERS = ("/rosout", "/tf", "/tf_static", "tf", "tf_static", "lbr/state")
"""What it writes besides, of whatever type; transforms may be published in the namespace of the stack or outside."""


def find(name: str) -> Topic | None:
    """The topic of a full name, in whatever namespace; None if it is none of these."""
    return next((topic for topic in ALL if name.endswith(f"/{topic.name}")), None)


ALL_IS_WELL = "ok"
"""Summary of a node in its diagnostics."""
WAITING_FOR_STATE = "waiting for the first joint state"
"""Message of the planner's diagnostics before the first joint state."""
WAITING_FOR_OBSTACLES = "waiting for the first obstacles"
"""Message of the planner's diagnostics before it knows whether there are any."""
WAITING_FOR_CONTROLLER = "waiting for a controller that hears the plans"
"""Message of the planner's diagnostics while its plans would be lost; given a goal it plans nevertheless."""
