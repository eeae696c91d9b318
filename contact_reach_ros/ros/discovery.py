"""Discovery: limited to this host unless the user opens it to the subnet."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

from rclpy.utilities import get_rmw_implementation_identifier

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.resources import config_file

CHOICES = ("host", "subnet")
"""Nodes of this host only, or every computer that multicast reaches, without a password."""

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")

_FAST_DDS = "rmw_fastrtps"
_PROFILE_OF = {"host": "fastdds.xml", "subnet": "fastdds_subnet.xml"}


class Reach(NamedTuple):
    """Range in which the nodes of this process and its children can be heard.

    Attributes
    ----------
    choice
        One of `CHOICES`; empty where a file of the user decides.
    why
        Variable or file that decides.
    """

    choice: str
    why: str

    @property
    def text(self) -> str:
        """One line for the log."""
        words = {"host": "this host only", "subnet": "OPEN to the subnet, to everybody on it"}
        return f"discovery: {words.get(self.choice, 'as set in a file of yours')} ({self.why})"


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


def reach(env: Mapping[str, str]) -> Reach:
    """Range of a process with these environment variables, after those of `environment` are set."""
    chosen = env.get(RANGE, "SUBNET").upper()
    if chosen in ("LOCALHOST", "OFF"):
        return Reach("host", f"{RANGE}={chosen}")
    profile = next((env[name] for name in PROFILES if env.get(name)), "")
    if profile and get_rmw_implementation_identifier().startswith(_FAST_DDS):
        for choice, name in _PROFILE_OF.items():
            if profile == str(config_file(name)):
                return Reach(choice, profile)
        return Reach("", profile)
    return Reach("subnet", f"{RANGE}={chosen}")
