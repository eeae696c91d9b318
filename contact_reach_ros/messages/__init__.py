"""Between messages and arrays.

Readers take any object with the message's fields: `goals`, `obstacle_reader`, `plan_reader`, `references`,
`safety_state`, `values`. The modules that make messages or serialise them import ROS's message classes; rclpy is
imported only to serialise.
"""
