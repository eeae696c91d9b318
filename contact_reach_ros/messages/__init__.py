"""Between messages and arrays.

Readers need no ROS: `obstacle_reader` reads bytes, `plan_reader`, `safety_state` and `values` any object
with the message's fields. Nor do `topics`, which name the types. The modules that make messages or serialise them
import ROS's message classes; rclpy is imported only to serialise.
"""
