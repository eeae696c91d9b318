"""Every topic of the stack: name, type and quality of service, in one place."""

from __future__ import annotations

from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray, Float64MultiArray, Header, Int64MultiArray, String
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory
from visualization_msgs.msg import MarkerArray

STREAM = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""What publishers offer: reliable and deep, so that recorders and lockstep lose nothing even when they are late."""

KEPT_STREAM = QoSProfile(
    depth=4000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""The same, and the last seconds are given to whoever comes later: in lockstep, where time begins without them.

That many, since on a busy machine it takes seconds until a recorder finds a topic.
"""

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The last message is given to whoever comes later."""

LATCHED_EVENTS = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""The same for publishers whose last message is not all that counts."""

ALL_EVENTS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""What subscribers of these ask for: room for what all publishers keep, or one that says much would hide the others."""

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""What real-time subscribers ask for: only the last message counts."""

EVERY = STREAM
"""What lockstep subscribers ask for."""


LATCHED_BATCHES = QoSProfile(
    depth=64, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""For batches of notes, which a recorder that has just found the topic shall not miss."""


class Topic(NamedTuple):
    """One topic, with the quality of service that its publishers offer."""

    name: str
    type: Any
    qos: QoSProfile = STREAM

    def kept(self, keep: bool) -> Topic:
        """The same topic; if asked for, with publishers that give those who come late the last seconds, too."""
        return self._replace(qos=KEPT_STREAM) if keep else self


JOINT_STATES = Topic("joint_states", JointState)
COMMANDS = Topic("effort_controller/commands", Float64MultiArray)
SHADOW_COMMANDS = Topic("shadow/commands", Float64MultiArray)
GOAL_POSE = Topic("goal_pose", PoseStamped)
REFERENCE_POSE = Topic("reference/pose", MultiDOFJointTrajectory)
REFERENCE_POSTURE = Topic("reference/posture", JointTrajectory)
OBSTACLES = Topic("obstacles", MarkerArray, LATCHED)
EXTERNAL_TORQUE = Topic("external_torque", JointState)
EXTERNAL_WRENCH = Topic("external_wrench", WrenchStamped)
SAFETY_STATE = Topic("safety_state", DiagnosticStatus, LATCHED_EVENTS)
DIAGNOSTICS = Topic("diagnostics", DiagnosticArray)
PLAN_PATH = Topic("plan/path", Path)
PLAN_MARKERS = Topic("plan/markers", MarkerArray)
SIM_CONTACTS = Topic("sim/contacts", JointState)
SIM_FAULTS = Topic("sim/faults", String, QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE))
ROBOT_DESCRIPTION = Topic("robot_description", String, LATCHED)
CLOCK = Topic("clock", Clock)
SETTINGS = Topic("settings", DiagnosticStatus, LATCHED_EVENTS)
CONTROLLER_INTAKE = Topic("intake/controller", Int64MultiArray, LATCHED_BATCHES)
OBSERVER_INTAKE = Topic("intake/observer", Int64MultiArray, LATCHED_BATCHES)
PLANNER_INTAKE = Topic("intake/planner", Int64MultiArray, LATCHED_BATCHES)
PLAN_STATISTICS = Topic("plan/statistics", DiagnosticArray)
PLAN_SOLUTION = Topic("plan/solution", Float32MultiArray)
LOCKSTEP_HORIZON = Topic("lockstep/horizon", Header)

ALL = tuple(value for value in list(vars().values()) if isinstance(value, Topic))
"""All of them, which is what a recorder writes."""

WAITING_FOR_STATE = "waiting for the first joint state"
"""Message in the planner's diagnostics until it knows where the arm is."""
WAITING_FOR_CONTROLLER = "waiting for a controller that hears the plans"
"""The same until there is one; without it plans would be lost. With a goal it plans all the same."""
