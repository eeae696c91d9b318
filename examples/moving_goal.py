"""Your own moving target: a goal on a circle, published 20 times a second, which the arm follows.

Start a stack beside it (contact-reach up), then run this; Ctrl-C ends the stream, and the arm holds its last goal.
"""

import math
import signal
import threading

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

CENTER, RADIUS, SPEED, RATE = (0.55, 0.0, 0.35), 0.1, 0.05, 20.0  # m, m/s, Hz

ended = threading.Event()
signal.signal(signal.SIGINT, lambda *_: ended.set())
# With its own handlers rclpy may end between two waits, with a traceback.
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node = rclpy.create_node("moving_goal")
goals = node.create_publisher(PoseStamped, "goal_pose", 10)
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(DiagnosticStatus, "goal/state", lambda state: print(f"\r{state.message:<70}", end=""), latched)
begin = node.get_clock().now()


def send() -> None:
    """Publish the goal as it is now, in the arm's base frame."""
    now = node.get_clock().now()
    angle = SPEED / RADIUS * (now - begin).nanoseconds * 1e-9
    goal = PoseStamped()
    goal.header.stamp = now.to_msg()
    x, y, z = CENTER
    goal.pose.position.x, goal.pose.position.y, goal.pose.position.z = (
        x + RADIUS * math.cos(angle),
        y + RADIUS * math.sin(angle),
        z,
    )
    goals.publish(goal)


node.create_timer(1.0 / RATE, send)
while not ended.is_set():
    rclpy.spin_once(node)
print()
