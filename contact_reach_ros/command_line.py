"""Command lines of the nodes: their help, and a refusal of what is none of ROS's arguments, without ROS."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Collection, Mapping, Sequence

from contact_reach_ros.arms import load_arm
from contact_reach_ros.parameter_files import NODES, declared_parameters, known_parameters
from contact_reach_ros.settings import Sections, Setting, Value

_HELP = ("-h", "--help")
_BEGIN, _END = "--ros-args", "--"
_WITH_VALUE = (
    *("-p", "--param", "-r", "--remap", "-e", "--enclave"),
    *("--params-file", "--log-level", "--log-config-file", "--log-file-name"),
)
"""Arguments of ROS that another one follows."""
_WIDTH, _INDENT = 100, " " * 6


def answer(node: str, sections: Sections, arguments: Sequence[str]) -> int | None:
    """Print help, or why arguments are refused; returns the exit code, None where the node is to be started.

    `arguments` come without the program's name.
    """
    if asks_for_help(arguments):
        print(help_text(node, sections))
        return 0
    foreign = foreign_arguments(arguments)
    if foreign:
        meant = _as_parameters(foreign, declared_parameters(sections, load_arm())) or ["NAME:=VALUE"]
        written = " ".join([_BEGIN, *(f"-p {text}" for text in meant)])
        print(f"{node}: {' '.join(foreign)}: not understood; write {written}, see {node} --help", file=sys.stderr)
        return 2
    return None


def asks_for_help(arguments: Sequence[str]) -> bool:
    """Whether somebody wants to know what a node does."""
    return any(argument in _HELP for argument in arguments)


def foreign_arguments(arguments: Sequence[str]) -> list[str]:
    """Arguments that ROS would ignore, or take for a remapping that nobody meant."""
    foreign: list[str] = []
    is_of_ros, is_value = False, False
    for argument in arguments:
        if is_value:
            is_value = False
        elif argument == _BEGIN:
            is_of_ros = True
        elif not is_of_ros or not argument.startswith("-"):
            foreign.append(argument)
        elif argument == _END:
            is_of_ros = False
        else:
            is_value = argument in _WITH_VALUE
    return foreign


def _as_parameters(foreign: Sequence[str], known: Collection[str]) -> list[str]:
    """What was meant by '--name value', '--name=value' and 'name:=value', as name:=value, the last of each name."""
    meant: dict[str, str] = {}
    for argument, following in zip(foreign, [*foreign[1:], "true"], strict=True):
        for mark in (":=", "="):
            if mark in argument:
                name, _, value = argument.lstrip("-").partition(mark)
                break
        else:
            name, value = argument.lstrip("-"), "true" if following.startswith("-") else following
            if not argument.startswith("--") or ":=" in following:
                continue
        name = name.replace("-", "_")
        if name in known:
            meant[name] = value
    return [f"{name}:={value}" for name, value in meant.items()]


def help_text(node: str, sections: Sections) -> str:
    """What a node does, how it is started, and its parameters with default, accepted values and meaning."""
    parts = [
        f"usage: {node} [{_BEGIN} [-p NAME:=VALUE ...] [--params-file FILE]]",
        "",
        NODES[node],
        f"With ROS 2: ros2 run contact_reach_ros {node}. Topics and services: msg_docs/{node}.md.",
        "",
        "parameters:",
        *_listed(declared_parameters(sections, load_arm())),
    ]
    if node != "bringup":
        parts += ["", "parameters of every node:", *_listed(known_parameters({}, load_arm()))]
    return "\n".join(parts)


def _listed(parameters: Mapping[str, Setting]) -> list[str]:
    lines = []
    for name, entry in parameters.items():
        lines.append(f"  {name} (default: {shown(entry.default).strip('()')}): {entry.accepts}")
        lines += textwrap.wrap(entry.description, _WIDTH, initial_indent=_INDENT, subsequent_indent=_INDENT)
    return lines


def shown(value: Value) -> str:
    """A default in the words of the documentation."""
    if isinstance(value, bool):
        return str(value).lower()
    if value is None:
        return "null"
    if value == ():
        return "(empty)"
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{item:g}" for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value) or "(empty)"
