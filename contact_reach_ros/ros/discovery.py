"""Discovery: limited to this host unless the user opens it to the subnet."""

from __future__ import annotations

import os
from collections.abc import Mapping

from rclpy.utilities import get_rmw_implementation_identifier

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.resources import config_file

CHOICES = ("host", "subnet")
"""Nodes of this host only, or every computer that multicast reaches, without a password."""

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")

_FAST_DDS = "rmw_fastrtps"
_PROFILE_OF = {"host": "fastdds.xml", "subnet": "fastdds_subnet.xml"}


def environment(choice: str = "host") -> dict[str, str]:
    """Environment variables for the choice; empty where the user's environment has already made one.

    ROS's own LOCALHOST range would do for Fast DDS too, but takes its shared memory with it, see config/fastdds.xml.
    Other middleware does not read that file and gets the range. Raises `SettingsError` if there is no such choice.
    """
    if choice not in CHOICES:
        raise SettingsError(f"discovery = '{choice}': expected one of {', '.join(CHOICES)}")
    if any(name in os.environ for name in (RANGE, *PROFILES)):
        return {}
    if not get_rmw_implementation_identifier().startswith(_FAST_DDS):
        return {RANGE: {"host": "LOCALHOST", "subnet": "SUBNET"}[choice]}
    return {PROFILES[0]: str(config_file(_PROFILE_OF[choice])), RANGE: "SYSTEM_DEFAULT"}


def reach(env: Mapping[str, str]) -> tuple[str, str]:
    """Return who hears a process with these environment variables, after those of `environment` are set.

    One of `CHOICES`, empty where a file of the user decides, and a line for the log with the variable or file.
    """
    chosen = env.get(RANGE, "SUBNET").upper()
    profile = next((env[name] for name in PROFILES if env.get(name)), "")
    reads_profile = bool(profile) and get_rmw_implementation_identifier().startswith(_FAST_DDS)
    why = f"{RANGE}={chosen}"
    if chosen in ("LOCALHOST", "OFF"):
        choice = "host"
    elif reads_profile:
        choice, why = next((key for key, name in _PROFILE_OF.items() if profile == str(config_file(name))), ""), profile
    else:
        choice = "subnet"
    words = {"host": "this host only", "subnet": "OPEN to the subnet, to everybody on it"}
    return choice, f"discovery: {words.get(choice, 'as set in a file of yours')} ({why})"
