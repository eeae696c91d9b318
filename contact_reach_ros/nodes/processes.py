"""The bring-up table: which processes make up the stack, and with which arguments. The launch file uses it too."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import yaml

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import budget_file
from contact_reach_ros.parameter_files import parameters_in
from contact_reach_ros.resources import config_file
from contact_reach_ros.scenes.files import read_scene, scene_file
from contact_reach_ros.scenes.scene import SceneFile
from contact_reach_ros.scenes.spheres import sphere_capacity
from contact_reach_ros.viewer.settings import ViewerSettings

ParameterValue = bool | int | float | str | list[str]

PACKAGE = "contact_reach_ros"
ENCLAVES = "/contact_reach"
DEFAULT_PARAMETERS = "default.yaml"

TUNABLE = ("planner", "controller", "observer", "driver")
"""Nodes whose parameters may be changed by a restart of the stack."""

RECORDER = "recorder"

VIEWER = "viewer"
"""The process that a restart leaves running."""


class Wave(IntEnum):
    """When a process is started."""

    EARLY = 0
    """Before the loops: it needs the whole machine to get ready, or must miss nothing."""
    LOOPS = 1
    LAST = 2
    """When everybody hears everybody: time begins with it."""


@dataclass(frozen=True)
class Process:
    """One process of the stack.

    Attributes
    ----------
    name
        Of node and executable.
    parameters
        Given on its command line, after the parameter file.
    wave
        It is started when those of earlier waves are up.
    essential
        Whether its end is the end of the stack.
    """

    name: str
    parameters: Mapping[str, ParameterValue]
    wave: Wave = Wave.LOOPS
    essential: bool = True

    @property
    def module(self) -> str:
        """Python module to run."""
        return f"{PACKAGE}.nodes.{self.name}"

    @property
    def enclave(self) -> str:
        """Whose keys and permissions the process uses where DDS security is on; without it the name means nothing."""
        return f"{ENCLAVES}/{self.name}"


@dataclass(frozen=True)
class StackOptions:
    """What a user chooses at bring-up."""

    scene: str = "ball"
    seed: int = 0
    target: str = ""
    """Flange position that the scene is built for, 'x y z' in m; drawn when empty."""
    lockstep: bool = False
    bag: str = ""
    """Directory to record to; nothing is recorded when empty."""
    parameters: str = ""
    """Parameter file; the package's own when empty."""
    driver: bool = True
    """Whether to start the simulated driver; a real robot brings its own."""
    discovery: str = "host"
    """Who hears the nodes, one of `discovery.CHOICES`."""
    view: bool = False
    """Whether to start the viewer."""
    overrides: tuple[str, ...] = ()
    """Parameters of nodes besides the file's, as `Override.parse` reads them; the last one of a name holds."""

    @property
    def parameter_file(self) -> Path:
        """The parameter file in use."""
        return Path(self.parameters) if self.parameters else config_file(DEFAULT_PARAMETERS)


class Override(NamedTuple):
    """A parameter of one node."""

    node: str
    name: str
    value: ParameterValue

    @classmethod
    def parse(cls, text: str) -> Override:
        """Read node:parameter=value, the value as YAML.

        Raises
        ------
        SettingsError
            If it reads otherwise, or the node is none of the stack's that have parameters.
        """
        node, colon, rest = text.partition(":")
        name, equals, written = rest.partition("=")
        if not (colon and equals and name and node in TUNABLE):
            raise SettingsError(
                f"override '{text}': expected node:parameter=value with one of {', '.join(TUNABLE)} as the node"
            )
        try:
            value = yaml.safe_load(written)
        except yaml.YAMLError as error:
            raise SettingsError(f"override '{text}': its value is no YAML: {error}") from error
        if not isinstance(value, (bool, int, float, str)):
            raise SettingsError(f"override '{text}': expected a number, true, false or a text")
        return cls(node, name, value)


def processes(options: StackOptions) -> list[Process]:
    """The processes from viewer and recorder to planner; they are ended in the reverse order.

    Raises
    ------
    SceneError, SettingsError
        If the scene is unknown, or its file, the parameter file or an override is wrong.
    """
    scene = read_scene(options.scene)
    time: dict[str, ParameterValue] = {"use_sim_time": options.lockstep}
    simulation: dict[str, ParameterValue] = {
        "scene": options.scene,
        "seed": options.seed,
        "target": options.target,
        "lockstep": options.lockstep,
    }
    table = []
    if options.bag:
        table.append(Process(RECORDER, {"bag": options.bag, **_origin(options)}, wave=Wave.EARLY))
    if options.driver:
        table.append(Process("driver", simulation, Wave.LAST if options.lockstep else Wave.LOOPS))
    table.append(Process("observer", time))
    table.append(Process("controller", time))
    table.append(Process("planner", {**time, **_obstacles(scene, options.parameter_file)}, wave=Wave.EARLY))
    if options.view:
        table.insert(0, Process(VIEWER, time, wave=Wave.EARLY, essential=False))
    changed = [Override.parse(text) for text in options.overrides]
    return [
        dataclasses.replace(
            process,
            parameters={
                **process.parameters,
                **{entry.name: entry.value for entry in changed if entry.node == process.name},
            },
        )
        for process in table
    ]


def page_address(parameter_file: Path) -> str:
    """Where the viewer of a stack serves its page.

    Raises
    ------
    SettingsError
        If the file has something for the viewer that is not accepted.
    """
    settings = ViewerSettings.from_mapping(parameters_in(parameter_file, VIEWER), str(parameter_file))
    return settings.page_address(settings.port)


def _origin(options: StackOptions) -> dict[str, ParameterValue]:
    """What a bag is told about the run that it holds."""
    budget = str(parameters_in(options.parameter_file, "observer").get("contact_budget", ""))
    files = {
        "parameter_file": options.parameter_file,
        "scene_file": scene_file(options.scene),
        "contact_budget": budget_file(budget),
    }
    lockstep = "true" if options.lockstep else "false"
    values = {"scene": options.scene, "seed": options.seed, "target": options.target, "lockstep": lockstep}
    return {
        "custom_data": [f"{key}={value}" for key, value in values.items()],
        "files": [f"{key}={path.resolve()}" for key, path in files.items()],
    }


def _obstacles(scene: SceneFile, parameter_file: Path) -> dict[str, ParameterValue]:
    """What the planner is told about the obstacles of a scene, besides what its parameter file says."""
    values: dict[str, ParameterValue] = {"max_spheres": sphere_capacity(scene)}
    if scene.ball is not None:
        values["sphere_stiffness"] = scene.ball.stiffness
        values["sphere_damping"] = scene.ball.damping
    elif scene.wall is not None:
        values["node_stiffness"] = scene.wall.planner_anchor_stiffness
        values["node_damping"] = scene.wall.damping
        values["edge_stiffness"] = scene.wall.planner_edge_stiffness
    # What the user's file says holds.
    chosen = parameters_in(parameter_file, "planner")
    return {name: value for name, value in values.items() if name not in chosen}
