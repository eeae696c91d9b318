"""Actions of the viewer's users on the stack, through goals, services and parameters."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import yaml
from rcl_interfaces.msg import ParameterDescriptor, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose
from contact_reach_ros.ros.client import Services
from contact_reach_ros.ros.interfaces import TUNABLE
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.stopping import release, stop_arm
from contact_reach_ros.viewer.frame import SafetyLevel
from contact_reach_ros.viewer.live import LiveState
from contact_reach_ros.viewer.tabs import Parameter, Value

BRINGUP = "bringup"
_NO_BRINGUP = "only a stack that bringup has started can be restarted"

_HIDDEN = ("use_sim_time", "autostart", "cpus", "start_type_description_service")


class StackActions:
    """`Actions` through a node; each method is called in a thread of the server, where it may wait."""

    def __init__(self, node: ManagedNode, live: LiveState) -> None:
        self._node = node
        self._live = live
        self._goals = node.make_publisher(topics.GOAL_POSE)
        self._services = Services(node, time.sleep)

    def send_goal(self, position: Array) -> str:
        """As `Actions`."""
        if not self._goals.get_subscription_count():
            return "nobody subscribes to goal_pose: is the planner running?"
        stamp = self._node.get_clock().now().to_msg()
        self._goals.publish(to_goal_pose(position.tolist(), self._node.arm.base_frame, stamp))
        return f"goal {np.round(position, 3).tolist()} m is sent"

    def stop(self) -> str:
        """As `Actions`."""
        return stop_arm(self._services.trigger).text

    def reset(self) -> str:
        """As `Actions`."""
        stopped = [name for name, status in self._live.safety.items() if status.level is SafetyLevel.STOP]
        return release(stopped, self._services.trigger).text

    def restart(self, scene: str, seed: int) -> str:
        """As `Actions`, by bring-up."""
        return self._restart({"scene": scene, "seed": seed})

    def nodes(self) -> Sequence[str]:
        """As `Actions`."""
        return TUNABLE

    def parameters(self, node: str) -> Sequence[Parameter]:
        """As `Actions`: those with a single value."""
        call = self._services.call
        listed = call(f"{node}/list_parameters", ListParameters, ListParameters.Request())
        names = sorted(name for name in listed.result.names if name not in _HIDDEN and "qos_overrides" not in name)
        described = call(f"{node}/describe_parameters", DescribeParameters, DescribeParameters.Request(names=names))
        values = call(f"{node}/get_parameters", GetParameters, GetParameters.Request(names=names))
        kinds = (
            ParameterType.PARAMETER_BOOL,
            ParameterType.PARAMETER_INTEGER,
            ParameterType.PARAMETER_DOUBLE,
            ParameterType.PARAMETER_STRING,
        )
        return [
            _parameter(descriptor, value)
            for descriptor, value in zip(described.descriptors, values.values, strict=True)
            if value.type in kinds
        ]

    def apply(self, node: str, values: Mapping[str, Value]) -> str:
        """As `Actions`, by bring-up; earlier changes are kept."""
        request = GetParameters.Request(names=["overrides"])
        try:
            response = self._services.call(f"{BRINGUP}/get_parameters", GetParameters, request)
        except ContactReachError as error:
            return f"{error}; {_NO_BRINGUP}"
        # A list that has never been set has no value.
        earlier = [text for value in response.values for text in value.string_array_value]
        kept = {text.partition("=")[0]: text for text in earlier}
        for name, value in values.items():
            text = yaml.safe_dump(value, default_flow_style=True).removesuffix("\n...\n").strip()
            kept[f"{node}:{name}"] = f"{node}:{name}={text}"
        return self._restart({"overrides": list(kept.values())})

    def _restart(self, values: Mapping[str, Any]) -> str:
        try:
            changed = self._services.change(BRINGUP, values)
            return str(self._services.trigger(f"{BRINGUP}/restart").message) if changed.done else changed.text
        except ContactReachError as error:
            return f"{error}; {_NO_BRINGUP}"


def _parameter(descriptor: ParameterDescriptor, value: ParameterValue) -> Parameter:
    ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
    limits = [(float(entry.from_value), float(entry.to_value)) for entry in ranges]
    low, high = limits[0] if limits else (-np.inf, np.inf)
    about = f"{descriptor.description}; {descriptor.additional_constraints}".strip("; ")
    return Parameter(
        descriptor.name,
        parameter_value_to_python(value),
        about,
        low if np.isfinite(low) else None,
        high if np.isfinite(high) else None,
    )
