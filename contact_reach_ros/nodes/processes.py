"""The bring-up table: which processes make up the stack, and with which arguments. The launch file uses it too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from contact_reach_ros.observer.budget import budget_file
from contact_reach_ros.parameter_files import parameters_in
from contact_reach_ros.resources import config_file
from contact_reach_ros.scenes.files import read_scene, scene_file
from contact_reach_ros.scenes.scene import SceneFile
from contact_reach_ros.scenes.spheres import sphere_capacity

ParameterValue = bool | int | float | str | list[str]

PACKAGE = "contact_reach_ros"
ENCLAVES = "/contact_reach"
DEFAULT_PARAMETERS = "default.yaml"


@dataclass(frozen=True)
class Process:
    """One process of the stack.

    Attributes
    ----------
    name
        Of node and executable.
    parameters
        Given on its command line, after the parameter file.
    first
        Whether it is up before the loops are started: it needs the whole machine to get ready, or must miss nothing.
    """

    name: str
    parameters: Mapping[str, ParameterValue]
    first: bool = False

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

    @property
    def parameter_file(self) -> Path:
        """The parameter file in use."""
        return Path(self.parameters) if self.parameters else config_file(DEFAULT_PARAMETERS)


def processes(options: StackOptions) -> list[Process]:
    """The processes from recorder to planner; they are ended in the reverse order.

    Raises
    ------
    SceneError, SettingsError
        If the scene is unknown, or its file or the parameter file is wrong.
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
        table.append(Process("recorder", {"bag": options.bag, **_origin(options)}, first=True))
    if options.driver:
        table.append(Process("driver", simulation))
    table.append(Process("observer", time))
    table.append(Process("controller", time))
    table.append(Process("planner", {**time, **_obstacles(scene, options.parameter_file)}, first=True))
    return table


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
