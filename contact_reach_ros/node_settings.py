"""The parameters of every node, as settings classes by parameter prefix; none of them needs ROS."""

from __future__ import annotations

from collections.abc import Mapping

from contact_reach_ros.bags.settings import RECORDER_SECTIONS
from contact_reach_ros.bringup.settings import BRINGUP_SECTIONS
from contact_reach_ros.control.adapter_settings import ADAPTER_SECTIONS
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS
from contact_reach_ros.planning.node_settings import PLANNER_SECTIONS
from contact_reach_ros.settings import Sections
from contact_reach_ros.simulation.settings import DRIVER_SECTIONS
from contact_reach_ros.viewer.settings import VIEWER_SECTIONS

SECTIONS: Mapping[str, Sections] = {
    "driver": DRIVER_SECTIONS,
    "controller": CONTROLLER_SECTIONS,
    "observer": OBSERVER_SECTIONS,
    "planner": PLANNER_SECTIONS,
    "adapter": ADAPTER_SECTIONS,
    "recorder": RECORDER_SECTIONS,
    "viewer": VIEWER_SECTIONS,
}
"""Settings by node."""

ALL_SECTIONS: Mapping[str, Sections] = {**SECTIONS, "bringup": BRINGUP_SECTIONS}
"""Settings by name in `parameter_files.NODES`: of all nodes, and of bring-up."""
