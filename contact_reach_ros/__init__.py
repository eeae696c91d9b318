"""Contact-aware reaching for a torque-controlled arm under ROS 2."""

__version__ = "0.1.0"
