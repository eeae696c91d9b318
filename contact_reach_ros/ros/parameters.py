"""Settings as ROS parameters: declared with what they accept, and checked with a message that names file and key."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from contact_reach_ros.arm import Arm
from contact_reach_ros.arms import arm_in, known_parameters, make_settings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import (
    NAME_RULE,
    NODES,
    ROS_NAME,
    Sections,
    Setting,
    check_node_name,
    check_node_names,
    check_values,
    parameters_in,
    parse_yaml,
)


def declare(node: Node, entries: Mapping[str, Setting], given: Mapping[str, Any]) -> dict[str, Any]:
    """Declare settings as parameters of a node; returns their values by full name: those given, or the defaults.

    Raises `SettingsError` if a value is not accepted.
    """
    values = {}
    for name, entry in entries.items():
        value = entry.default if given.get(name) is None else given[name]
        values[name] = checked = entry.check(value, f"parameter {name} of {node.get_name()}")
        unit = f" [{entry.unit}]" if entry.unit else ""
        descriptor = ParameterDescriptor(
            description=f"{entry.description}{unit}",
            additional_constraints=entry.accepts,
            read_only=not entry.changeable,
            # `check` accepts a whole number for a float, too.
            dynamic_typing=True,
        )
        # ROS cannot tell the type of an empty list.
        node.declare_parameter(name, (list(checked) or None) if isinstance(checked, tuple) else checked, descriptor)
    return values


def check_arguments(arguments: Sequence[str], node_name: str, sections: Sections) -> dict[str, Any]:
    """Check the parameter files and overrides on a command line; returns the node's settings objects by prefix.

    ROS itself ignores an unknown node, key or argument; here the node does not start.

    Raises
    ------
    SettingsError
        Naming file and section or key, or the argument, and what is accepted.
    """
    foreign = without_ros_arguments(arguments)[1:]
    if foreign:
        raise SettingsError(f"{' '.join(foreign)}: unknown arguments; expected --ros-args -p NAME:=VALUE, see --help")
    given = list(_given(arguments, node_name, ["", node_name]))
    merged, where = _merged(given), f"parameters of {node_name}"
    arm = arm_in(merged, where)
    for source, values in given:
        check_values(values, known_parameters(sections, arm), source)
    return make_settings(merged, sections, arm, where)


def given_parameters(arguments: Sequence[str], node_name: str) -> dict[str, Any]:
    """The parameters of a node on a command line, unchecked; raises `SettingsError` if a file cannot be read."""
    return _merged(_given(arguments, node_name, ["", node_name]))


def without_parameters(arguments: Sequence[str]) -> list[str]:
    """The command line for ROS, which reads files in another way than `given_parameters` and loses part of them.

    Raises `SettingsError` if an option lacks its value.
    """
    kept, rest = [], iter(arguments)
    for argument in rest:
        if argument not in (*_FILE, *_ONE):
            kept.append(argument)
        elif not next(rest, ""):
            what = "NAME:=VALUE" if argument in _ONE else "a file"
            raise SettingsError(f"argument {argument}: expected {what} after it")
    return kept


def namespace_in(arguments: Sequence[str]) -> str:
    """Namespace into which a command line puts a node, as ROS reads it: the first one holds.

    Raises `SettingsError` if it is none.
    """
    for option, rule in itertools.pairwise(arguments):
        target, _, namespace = rule.partition(":=")
        owner, _, what = target.rpartition(":")
        if option in ("-r", "--remap") and what == "__ns" and owner in ("", *NODES):
            if namespace != "/" and not ROS_NAME.fullmatch(namespace):
                raise SettingsError(f"{option} {rule}: expected a name {NAME_RULE}")
            return namespace
    return "/"


def without_ros_arguments(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command line that are not ROS's; raises `SettingsError` if ROS does not understand its own."""
    try:
        return list(remove_ros_args(without_parameters(arguments)))
    except RuntimeError as error:
        raise SettingsError(f"ROS refused the arguments {' '.join(arguments[1:])}: {error}") from error


def settings_of(arguments: Sequence[str], node_name: str, sections: Sections, arm: Arm) -> dict[str, Any]:
    """Settings objects of another node, by prefix, as far as this process's command line has its parameters.

    Raises `SettingsError` if the node has no such parameter, or a value is not accepted.
    """
    values = _merged(_given(arguments, node_name, [node_name]))
    return make_settings(values, sections, arm, f"parameters of {node_name}")


_FILE, _ONE = ("--params-file",), ("-p", "--param")
"""Options of ROS with parameters: a file, and one."""

_Given = tuple[str, dict[str, Any]]


def _given(arguments: Sequence[str], node_name: str, owners: Collection[str]) -> Iterator[_Given]:
    """Parameters of a node on a command line by name, with where they are; of overrides those for the owners.

    Raises `SettingsError` as `parameters_in`, or if something is for a node that there is not.
    """
    for option, argument in itertools.pairwise(arguments):
        if option in _FILE:
            check_node_names(Path(argument))
            yield f"{argument}: {node_name}", parameters_in(Path(argument), node_name, namespace_in(arguments))
        elif option in _ONE:
            target, is_given, text = argument.partition(":=")
            owner, _, name = target.rpartition(":")
            if not (is_given and name):
                raise SettingsError(f"argument {option} {argument}: expected NAME:=VALUE")
            check_node_name(owner or node_name, f"argument {option} {argument}")
            if owner in owners:
                where = f"argument {option} {argument}"
                yield where, {name: parse_yaml(text, where)}


def _merged(given: Iterable[_Given]) -> dict[str, Any]:
    return {name: value for _, values in given for name, value in values.items()}
