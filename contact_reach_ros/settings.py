"""Typed settings, and the parameter files of nodes that hold them.

Each value is declared once, with default, unit, range and description. ROS parameters, YAML files and the documentation
all follow from this declaration, so they cannot disagree.
"""

from __future__ import annotations

import dataclasses
import difflib
import itertools
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import yaml

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.removed import removed_parameter

if TYPE_CHECKING:
    from contact_reach_ros.arm import Arm

Scalar = bool | int | float | str
Value = Scalar | tuple[Scalar, ...] | None
_DECLARATION = "declaration"

ROS_NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
"""A namespace, or what else topics and services of ROS may begin with."""
NAME_RULE = "of letters, digits and _, such as left, or robots/left"
"""What `ROS_NAME` takes, in words."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """Declaration of one value: its name, default and accepted values."""

    name: str
    default: Value
    description: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    optional_length: int | None = None
    """Length of a list of numbers that may be missing, which a default of None declares."""
    per_joint: bool = False
    """Whether it is a list with one number per joint of the arm; a default of None stands for the arm's own."""
    is_name: bool = False
    """Whether it is the beginning of names in ROS."""
    changeable: bool = False
    """Whether it may be set while the node runs."""

    @property
    def kind(self) -> type:
        """Type of the value, or of the elements of a tuple."""
        if self.optional_length is not None or self.per_joint:
            return float
        value = self.default[0] if isinstance(self.default, tuple) and self.default else self.default
        return str if self.is_open_list else type(value)

    @property
    def is_open_list(self) -> bool:
        """Whether the value is a list of strings of any length, which a default of () declares."""
        return self.default == ()

    @property
    def length(self) -> int | None:
        """Number of values of a list, None for a single value."""
        return len(self.default) if isinstance(self.default, tuple) else self.optional_length

    @property
    def accepts(self) -> str:
        """The accepted values in words, for messages and documentation."""
        words = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}[self.kind]
        if self.choices:
            words = "one of " + ", ".join(self.choices)
        if self.is_name:
            words = f"a name {NAME_RULE}"
        if self.is_open_list:
            words = "a list of strings"
        elif self.per_joint and self.length is None:
            words = f"a list with one value for each joint, each {words}"
        elif self.length is not None:
            words = f"a list of {self.length} values, each {words}"
        if self.minimum is not None or self.maximum is not None:
            low = "-inf" if self.minimum is None else f"{self.minimum:g}"
            high = "inf" if self.maximum is None else f"{self.maximum:g}"
            words += f" in [{low}, {high}]"
        words = f"{words} {self.unit}".rstrip()
        return words if self.optional_length is None else f"null, or {words}"

    def for_arm(self, arm: Arm) -> Setting:
        """The declaration for one arm, which fixes length and default of per-joint lists."""
        return dataclasses.replace(self, default=arm.default(self.name)) if self.per_joint else self

    def check(self, value: Any, where: str) -> Value:
        """Return `value` in the declared type.

        Raises `SettingsError` if the value has another type or length, is not finite, or lies outside the range; the
        message has `where`.
        """
        # NumPy's numbers and arrays count as Python's.
        value = value.tolist() if hasattr(value, "tolist") else value
        if value is None and (self.optional_length is not None or self.per_joint):
            return None
        if self.length is not None or self.per_joint:
            is_list = isinstance(value, Sequence) and not isinstance(value, str)
            if not is_list or (self.length not in (None, len(value)) and not self.is_open_list):
                raise SettingsError(f"{where} = {value!r}: expected {self.accepts}")
            return tuple(self._check_scalar(item, where) for item in value)
        return self._check_scalar(value, where)

    def _check_scalar(self, value: Any, where: str) -> Scalar:
        kind = self.kind
        fits = isinstance(value, kind) or (kind is float and isinstance(value, int))
        if kind is not bool and isinstance(value, bool):
            fits = False
        if fits and kind in (int, float):
            # An integer too large for a float is refused like infinity.
            fits = abs(value) <= sys.float_info.max
            fits = fits and (self.minimum is None or value >= self.minimum)
            fits = fits and (self.maximum is None or value <= self.maximum)
        if fits and self.choices:
            fits = value in self.choices
        if fits and self.is_name:
            fits = bool(ROS_NAME.fullmatch(value))
        if not fits:
            raise SettingsError(f"{where} = {value!r}: expected {self.accepts}")
        return kind(value)


def setting(default: Any, description: str, **declared: Any) -> Any:
    """Declare one value of a `Settings` class; what else can be `declared` are the fields of `Setting`."""
    return dataclasses.field(default=default, metadata={_DECLARATION: Setting("", default, description, **declared)})


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of the settings classes: frozen, and checked against its declarations on construction."""

    def __post_init__(self) -> None:
        for entry in self.declared():
            checked = entry.check(getattr(self, entry.name), f"{type(self).__name__}.{entry.name}")
            object.__setattr__(self, entry.name, checked)

    @classmethod
    def declared(cls) -> Iterator[Setting]:
        """All values of the class, in the order of their declaration."""
        for field in dataclasses.fields(cls):
            yield dataclasses.replace(field.metadata[_DECLARATION], name=field.name)

    def resolve(self, arm: Arm) -> Self:
        """These settings, with the arm's own values filled in where they have none.

        Raises `SettingsError` if a list does not have one value for each joint of the arm.
        """
        values: dict[str, Any] = {}
        for entry in self.declared():
            if entry.per_joint:
                value = getattr(self, entry.name)
                where = f"{type(self).__name__}.{entry.name}"
                values[entry.name] = entry.for_arm(arm).check(
                    arm.default(entry.name) if value is None else value, where
                )
        return dataclasses.replace(self, **values) if values else self

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], source: str) -> Self:
        """Make the settings from a mapping such as a YAML section.

        Raises
        ------
        SettingsError
            On an unknown key, or a value that is not accepted; the message names `source` (a file, a parameter prefix).
        """
        known = {entry.name: entry for entry in cls.declared()}
        for key, value in mapping.items():
            if key not in known:
                raise SettingsError(unknown_key(str(key), known, source))
            known[key].check(value, f"{source}: {key}")
        try:
            return cls(**mapping)
        except SettingsError as error:
            raise SettingsError(f"{source}: {error}") from error


Sections = Mapping[str, type[Settings]]
"""Settings classes of a node by parameter prefix; the prefix '' is the node itself."""


def unknown_key(key: str, known: Mapping[str, Any] | Sequence[str], source: str, what: str = "key") -> str:
    """The message for an undeclared key, with the nearest declared one if any, or what to do if it was removed."""
    if what == "key" and (refusal := removed_parameter(key)):
        return f"{source}: {refusal}"
    near = difflib.get_close_matches(key, list(known), n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"known {what}s: " + ", ".join(sorted(known))
    return f"{source}: unknown {what} '{key}'; {hint}"


class _Loader(yaml.SafeLoader):
    """Reads the files of launch, too, which tags lists as Python's tuples, and numbers as ROS does: 1e-3, not 1:30.

    A key that is there twice is refused: ROS would merge its parts, and others would take the last one.
    """

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {}

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys: list[str] = [key.value for key, _ in node.value]
        for number, key in enumerate(keys):
            if key in keys[:number]:
                at = node.value[number][0].start_mark
                raise yaml.MarkedYAMLError(problem=f"'{key}' is there twice; join its parts", problem_mark=at)
        return super().construct_mapping(node, deep)


_Loader.add_constructor("tag:yaml.org,2002:python/tuple", yaml.SafeLoader.construct_sequence)
for _tag, _expression in {
    "bool": r"(?i:yes|no|true|false|on|off)$",
    "int": r"[-+]?(0x[0-9a-fA-F]{1,16}|0[0-7]{0,20}|[1-9]\d{0,18})$",
    "float": r"[-+]?(((\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|\.(?i:inf))$)|\.(?i:nan)$",
    "null": r"(~|null|Null|NULL|)$",
    "merge": r"<<$",
}.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_expression), None)
_MOST_VALUES = 100_000
"""That a YAML text may hold, those that stand for others included."""


def parse_yaml(text: str, source: str) -> Any:
    """The value of a YAML text; raises `SettingsError`, beginning with its source, if it is none, or far too large."""
    sizes: dict[int, int] = {}

    def size(value: Any) -> int:
        parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        if id(value) not in sizes:
            sizes[id(value)] = 1 + sum(map(size, parts))
        return sizes[id(value)] if parts else 1

    try:
        value = yaml.load(text, _Loader)
        if size(value) > _MOST_VALUES:
            raise SettingsError(f"{source}: its anchors stand for more than {_MOST_VALUES:,} values; write them out")
    # Of tags, such as !!int and !!bool, what follows may be anything, and an anchor may stand in what it is for.
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, RecursionError) as error:
        raise SettingsError(f"{source}: not valid YAML: {error}") from error
    return value


def read_yaml(file: Path, may_be_empty: bool = False) -> dict[str, Any]:
    """Read the mapping in a YAML file; none at all, if it may, is an empty one.

    Raises `SettingsError` if the file cannot be read, is not YAML or does not hold a mapping; the message names the
    file.
    """
    try:
        content = parse_yaml(file.read_text("utf-8"), str(file))
    except OSError as error:
        raise SettingsError(f"{file}: cannot be read ({error.strerror}); give the path of a YAML file") from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{file}: not valid YAML: {error}; save it as UTF-8") from error
    if content is None and may_be_empty:
        return {}
    if not isinstance(content, dict):
        found = "is empty" if content is None else f"holds {type(content).__name__}"
        raise SettingsError(f"{file}: {found}; expected a mapping of keys to values")
    return content


DEFAULT_PARAMETERS = "default.yaml"
"""File in `config/` with the parameters to use unless the user names another."""
NODES = ("driver", "controller", "observer", "planner", "adapter", "recorder", "viewer", "bringup")
"""The nodes that have parameters."""

ROBOT = Setting("robot", "iiwa14", "arm: a name, the path of its file, or robot_description")
"""The parameter of every node that says which arm it has; the lengths of other parameters follow from it."""
RATE = Setting("state_rate", 1000.0, "nominal rate of joint states", "Hz", 50.0, 1000.0)
"""The parameter of every node from which gaps, debounces and watchdogs follow."""
AUTOSTART = Setting("autostart", True, "configure and activate itself at its start")
CPUS = Setting("cpus", "auto", "CPUs to run on: auto, all, or numbers")
EVERY_NODE = (ROBOT, RATE, AUTOSTART, CPUS)
"""Parameters of every node but bring-up."""

_WILDCARDS = ("*", "**")
_OF_OTHERS = {"impedance.": "controller", "contact_budget": "observer"}
"""Prefixes of parameters that one node has and others read in its section, by node."""
OF_ROS = ("use_sim_time", "start_type_description_service")
"""Parameters of every node of ROS."""


def full_name(prefix: str, name: str) -> str:
    """Name of a parameter, with its prefix if there is one."""
    return f"{prefix}.{name}" if prefix else name


def declared_parameters(sections: Sections, arm: Arm) -> dict[str, Setting]:
    """The parameters of a node with these sections, by full name."""
    return {
        full_name(prefix, entry.name): entry.for_arm(arm)
        for prefix, settings in sections.items()
        for entry in settings.declared()
    }


def parameters_in(file: Path, node_name: str, namespace: str = "/") -> dict[str, Any]:
    """Read the parameters in a file that concern a node, flattened to dotted names.

    A section without a namespace holds in every one, where ROS itself would ignore it outside of the root.

    Parameters
    ----------
    file
        Parameter file.
    node_name
        Of the node, without its namespace.
    namespace
        Of the node, such as /left.

    Raises
    ------
    SettingsError
        If the file cannot be read, is not a parameter file, or has sections for this node in other namespaces only.
    """
    found: dict[str, Any] = {}
    holds: dict[bool, dict[str, bool]] = {False: {}, True: {}}
    """Of the sections with the node's own name, and of wildcards, which in a namespace may be for another stack."""
    for pattern, content in read_yaml(file).items():
        if not isinstance(content, dict) or "ros__parameters" not in content:
            raise SettingsError(f"{file}: '{pattern}' has no ros__parameters; expected '<node>: ros__parameters: ...'")
        is_for = _is_for(str(pattern), node_name, namespace)
        if (name := str(pattern).rpartition("/")[2]) in (node_name, *_WILDCARDS):
            holds[name in _WILDCARDS][str(pattern)] = is_for
        if is_for:
            parameters = content["ros__parameters"]
            if beside := [str(key) for key in content if key != "ros__parameters"]:
                raise SettingsError(
                    f"{file}: {pattern}: {', '.join(beside)} beside ros__parameters; indent it, to stand below"
                )
            if not isinstance(parameters, dict | None):
                raise SettingsError(f"{file}: {pattern}.ros__parameters is not a mapping of keys to values")
            own: dict[str, Any] = {}
            for name, value in _flat(parameters or {}):
                if name in own:
                    raise SettingsError(f"{file}: {pattern}: '{name}' is there twice; remove one")
                own[name] = value
            found |= own
    for is_wildcard, those in holds.items():
        if those and not any(those.values()) and (namespace == "/" or not is_wildcard):
            name, here = ("/**", "/*") if is_wildcard else (node_name, f"{namespace.rstrip('/')}/{node_name}")
            raise SettingsError(
                f"{file}: {', '.join(those)}: the {node_name} is in namespace {namespace}, where none of these "
                f"sections holds; expected '{name}', which holds in every namespace, or '{here}'"
            )
    return found


def check_node_names(file: Path) -> None:
    """Check each section of a parameter file as `check_node_name` does, in whatever namespace it is."""
    for pattern in read_yaml(file):
        check_node_name(str(pattern).rpartition("/")[2], str(file))


def check_node_name(name: str, source: str) -> None:
    """Raise `SettingsError`, naming `source` and the nearest node, if `name` is none of `NODES` and no wildcard."""
    if name not in (*NODES, *_WILDCARDS):
        raise SettingsError(unknown_key(name, NODES, source, "node"))


def check_values(values: Mapping[str, Any], known: Mapping[str, Setting], source: str) -> dict[str, Value]:
    """Check parameters of a node by full name, one by one, against the `known` ones, and return them in their types.

    What every node of ROS has is left to ROS, and sections without a key are empty.

    Raises
    ------
    SettingsError
        Naming `source` and the parameter, and what is accepted, or the nearest parameter that there is.
    """
    checked = {}
    for name, value in values.items():
        if name in known:
            checked[name] = known[name].check(value, f"{source}: {name}")
        elif owner := _owner(name, known):
            hint = f"set it for the {owner}: the other nodes read it there"
            raise SettingsError(f"{source}: unknown key '{name}'; {hint}")
        elif name == "use_sim_time" and not isinstance(value, bool):
            raise SettingsError(f"{source}: {name} = {value!r}; expected true or false")
        elif name not in OF_ROS and not (value is None and any(each.startswith(f"{name}.") for each in known)):
            raise SettingsError(unknown_key(name, known, source))
    return checked


def _owner(name: str, known: Mapping[str, Setting]) -> str:
    """The other node that has a parameter for all; empty if there is none."""
    prefix = next((prefix for prefix in _OF_OTHERS if name.startswith(prefix)), "")
    return "" if any(other.startswith(prefix) for other in known) else _OF_OTHERS.get(prefix, "")


def as_arguments(parameters: Mapping[str, Any]) -> list[str]:
    """ROS arguments that set parameters of the one node of a process."""
    # JSON is YAML: quoted, an empty or blank-separated string stays a string.
    pairs = (["-p", f"{name}:={json.dumps(value)}"] for name, value in parameters.items())
    return list(itertools.chain.from_iterable(pairs))


def _is_for(pattern: str, node_name: str, namespace: str) -> bool:
    """Whether a section of a parameter file is for a node; * stands for one name, ** for any number of them."""
    names = pattern.strip("/").split("/")
    if len(names) == 1:
        return names[0] in (node_name, *_WILDCARDS)
    expression = "".join({"**": r"(/\w+)*", "*": r"/\w+"}.get(name, f"/{re.escape(name)}") for name in names)
    return re.fullmatch(expression, f"{namespace.rstrip('/')}/{node_name}") is not None


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        name = full_name(prefix, str(key))
        yield from _flat(value, name) if isinstance(value, dict) else [(name, value)]
