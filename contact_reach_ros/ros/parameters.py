"""Settings as ROS parameters: declared with what they accept, and checked with a message that names file and key."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import remove_ros_args

from contact_reach_ros.arm import Arm
from contact_reach_ros.arms import checked_arm, known_parameters
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import (
    ROBOT,
    Sections,
    Setting,
    check_name,
    check_parameters_in,
    full_name,
    make_settings,
    parameters_in,
)


def declare(node: Node, sections: Sections, arm: Arm) -> dict[str, Any]:
    """Declare all settings as parameters and return them, one settings object by prefix.

    Raises `SettingsError` if a parameter has a value that is not accepted.

    Parameters
    ----------
    node
        That has them.
    sections
        Settings by prefix.
    arm
        Gives settings with a value for each joint their length and default.
    """
    made: dict[str, Any] = {}
    for prefix, settings_class in sections.items():
        values = {}
        for declared in settings_class.declared():
            entry = declared.for_arm(arm)
            name = full_name(prefix, entry.name)
            values[entry.name] = declare_one(node, name, entry)
        made[prefix] = settings_class.from_mapping(values, f"parameters of {node.get_name()}, {prefix or 'node'}")
    return made


def declare_one(node: Node, name: str, entry: Setting) -> Any:
    """Declare a setting as a parameter with this full name, and return its value.

    Raises `SettingsError` if the value is not accepted.
    """
    unit = f" [{entry.unit}]" if entry.unit else ""
    descriptor = ParameterDescriptor(
        description=f"{entry.description}{unit}",
        additional_constraints=entry.accepts,
        read_only=not entry.changeable,
        # A whole number is accepted for a float; `check` converts it.
        dynamic_typing=entry.kind is float,
    )
    try:
        if entry.is_open_list:
            # ROS cannot tell the type of an empty list.
            value = node.declare_parameter(name, Parameter.Type.STRING_ARRAY, descriptor).value
            return [text for text in value or [] if text]
        default = list(entry.default) if isinstance(entry.default, tuple) else entry.default
        value = node.declare_parameter(name, default, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        raise SettingsError(f"parameter {name} of {node.get_name()}: expected {entry.accepts}; {error}") from error
    return entry.check(value, f"parameter {name} of {node.get_name()}")


def check_arguments(arguments: Sequence[str], node_name: str, sections: Sections) -> Arm:
    """Check the parameter files and overrides on a command line against the settings of a node; returns its arm.

    ROS itself ignores an unknown key or argument; here the node does not start.

    Raises
    ------
    SettingsError
        Naming file and key, or the argument, and what is accepted.
    """
    arm = checked_arm(early_value(arguments, node_name, ROBOT), f"parameter {ROBOT.name} of {node_name}")
    known = known_parameters(sections, arm)
    for option, value in itertools.pairwise(arguments):
        if option == "--params-file":
            check_parameters_in(Path(value), node_name, known)
        elif option in ("-p", "--param"):
            owner, _, key = value.partition(":=")[0].rpartition(":")
            if owner in ("", node_name):
                check_name(known, key, f"argument {option} {value}")
    foreign = without_ros_arguments(arguments)[1:]
    if foreign:
        raise SettingsError(f"{' '.join(foreign)}: unknown arguments; expected --ros-args -p NAME:=VALUE, see --help")
    return arm


def without_ros_arguments(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command line that are not ROS's; raises `SettingsError` if ROS does not understand its own."""
    try:
        return list(remove_ros_args(list(arguments)))
    except RuntimeError as error:
        raise SettingsError(f"ROS refused the arguments {' '.join(arguments[1:])}: {error}") from error


def settings_of(arguments: Sequence[str], node_name: str, sections: Sections, arm: Arm) -> dict[str, Any]:
    """Settings objects of another node, by prefix, as far as this process's command line has its parameters.

    Raises `SettingsError` if a value is not accepted; keys that the node does not have are its own affair.
    """
    return make_settings(_given(arguments, node_name), sections, arm, f"parameters of {node_name}")


def early_value(arguments: Sequence[str], node_name: str, entry: Setting) -> Any:
    """Value of one parameter of a node, without a prefix, from its own command line: before ROS starts.

    Raises `SettingsError` if the value is not accepted.
    """
    value = _given(arguments, node_name, "").get(entry.name, entry.default)
    return entry.check(value, f"parameter {entry.name} of {node_name}")


def _given(arguments: Sequence[str], node_name: str, *more_owners: str) -> dict[str, Any]:
    """Parameters of a node on a command line, by name; of overrides those for the node, and `more_owners`."""
    values: dict[str, Any] = {}
    for option, argument in itertools.pairwise(arguments):
        if option == "--params-file":
            values |= parameters_in(Path(argument), node_name)
        elif option in ("-p", "--param"):
            target, _, text = argument.partition(":=")
            owner, _, name = target.rpartition(":")
            if owner in (node_name, *more_owners):
                values[name] = yaml.safe_load(text)
    return values
