"""The bring-up table: which processes make up the stack, and with which arguments. The launch file uses it too."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.tool import NO_TOOL, Tool
from contact_reach_ros.arms import TOOL, TOOL_PARAMETERS, arm_in, known_parameters
from contact_reach_ros.bringup.settings import BringupOptions
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import budget_file
from contact_reach_ros.presets import SECTIONS, check_parameters
from contact_reach_ros.ros.interfaces import ADAPTER, CONTROLLER, DRIVER, OBSERVER, PLANNER, RECORDER, VIEWER
from contact_reach_ros.ros.parameters import namespace_in
from contact_reach_ros.ros.process import described
from contact_reach_ros.settings import RATE, ROBOT, check_values, full_name, parameters_in, parse_yaml
from contact_reach_ros.simulation.settings import DriverSettings
from contact_reach_ros.world.goal import FREE, HOLD
from contact_reach_ros.world.scene_file import SceneFile, anywhere, read_scene, scene_file
from contact_reach_ros.world.spheres import sphere_capacity

ParameterValue = bool | int | float | str | list[str] | list[float]

ENCLAVES = "/contact_reach"


@dataclass(frozen=True)
class Process:
    """One process of the stack.

    Attributes
    ----------
    name
        Of node and executable.
    parameters
        Given on its command line, after the parameter file.
    early
        Whether it starts, and is active, before the loops: it takes long to get ready, or must miss nothing.
    essential
        Whether its end is the end of the stack.
    lasts
        Whether it decides itself when it ends, as it may hold the arm.
    """

    name: str
    parameters: Mapping[str, ParameterValue]
    early: bool = False
    essential: bool = True
    lasts: bool = False

    @property
    def enclave(self) -> str:
        """Enclave whose keys and permissions the process uses where DDS security is on."""
        return f"{ENCLAVES}/{self.name}"


def _overrides(texts: Sequence[str], arm: Arm, started: Collection[str]) -> dict[str, ParameterValue]:
    """Parameters by node:parameter, from texts node:parameter=value, the value as YAML.

    Raises `SettingsError` if a text has another form, the node is not started, has no such parameter, or does not
    accept the value.
    """
    found: dict[str, ParameterValue] = {}
    for text in texts:
        target, equals, written = text.partition("=")
        node, _, name = target.partition(":")
        if not (equals and name and node in started):
            raise SettingsError(
                f"override '{text}': expected node:parameter=value with one of {', '.join(started)} as the node; "
                "others are not started here"
            )
        found[target] = value = parse_yaml(written, f"override '{text}'")
        check_values({name: value}, known_parameters(SECTIONS[node], arm), f"override '{text}'")
    return found


def processes(options: BringupOptions, namespace: str = "/") -> list[Process]:
    """Make the table of processes in a namespace; they are ended in the reverse order.

    Raises `SceneError` or `SettingsError` if the scene is unknown, its file, the parameter file or an override is
    wrong, or nodes would not go together.
    """
    scene = read_scene(options.scene)
    arm: dict[str, ParameterValue] = {ROBOT.name: options.robot} if options.robot else {}
    rate: dict[str, ParameterValue] = {RATE.name: options.state_rate} if options.state_rate else {}
    tool = scene_tool(options, scene, namespace)
    time: dict[str, ParameterValue] = {"use_sim_time": options.lockstep, **rate, **arm, **tool}
    table = []
    adapted = options.adapter != "none"
    if adapted:
        # The simulated driver has no controllers of ros2_control that could be asked.
        adapting = {**time, "kind": options.adapter, "effort.ask_joints": not options.driver}
        table.append(Process(ADAPTER, adapting, early=True, lasts=True))
    if options.view:
        table.append(Process(VIEWER, time, early=True, essential=False))
    if options.bag:
        table.append(Process(RECORDER, {"bag": options.bag, **time}, early=True))
    if options.driver:
        table.append(Process(DRIVER, {"scene": options.scene, **time}))
    table.append(Process(OBSERVER, time))
    behind = {"supervision.adapter": True} if adapted else {}
    table.append(Process(CONTROLLER, {**time, **behind}))
    # Of what stands around a real robot the simulated scene knows nothing.
    obstacles = _of_scene(scene, options.parameter_file, namespace) if options.driver else {}
    # With a deadline on the wall's clock plans would depend on how busy the machine is.
    unhurried = {"planning.deadline": 0.0} if options.lockstep else {}
    table.append(Process(PLANNER, {**time, **obstacles, **unhurried}, early=True))
    # Every node gets them all: the planner reads the controller's gains, and several the observer's budget.
    changed = _overrides(options.overrides, stack_arm(options, namespace), [process.name for process in table])
    origin = {RECORDER: _origin(options, changed, namespace)}
    given = {each.name: {**each.parameters, **origin.get(each.name, {}), **changed} for each in table}
    check_parameters(options.parameter_file, given, options.robot, namespace)
    return [dataclasses.replace(process, parameters=given[process.name]) for process in table]


def resolved(options: BringupOptions, node_name: str, arguments: Sequence[str] = ()) -> BringupOptions:
    """These options with a file for an arm whose description is published, also where the parameter file says so.

    Parameters and errors are those of `ros.process.described`.
    """
    own = parameters_in(options.parameter_file, "planner", namespace_in(arguments))
    robot = options.robot or str(own.get(ROBOT.name, ""))
    path = described(robot, node_name, options.discovery, arguments)
    return options if path == robot else dataclasses.replace(options, robot=path)


def stack_arm(options: BringupOptions, namespace: str = "/") -> Arm:
    """The arm of a stack, with its tool; raises `SettingsError` if the parameter file has none that there is."""
    own = parameters_in(options.parameter_file, "planner", namespace)
    return arm_in({**own, ROBOT.name: options.robot} if options.robot else own, str(options.parameter_file))


def _origin(options: BringupOptions, changed: Mapping[str, ParameterValue], space: str) -> dict[str, ParameterValue]:
    """Facts about the run that its bag keeps; `changed` holds the overrides."""
    budget = str(parameters_in(options.parameter_file, OBSERVER, space).get("contact_budget", ""))
    files = {
        "parameter_file": options.parameter_file,
        "scene_file": scene_file(options.scene),
        "contact_budget": budget_file(budget),
    }
    given = {**parameters_in(options.parameter_file, DRIVER, space), **changed}
    drawn = {
        entry.name: given.get(f"{DRIVER}:{entry.name}", given.get(entry.name, entry.default))
        for entry in DriverSettings.declared()
    }
    lockstep = "true" if options.lockstep else "false"
    values = {"scene": options.scene, "seed": drawn["seed"], "target": drawn["target"], "lockstep": lockstep}
    return {
        "custom_data": [f"{key}={value}" for key, value in values.items()],
        "files": [f"{key}={path.resolve()}" for key, path in files.items()],
    }


def scene_tool(options: BringupOptions, scene: SceneFile, namespace: str = "/") -> dict[str, ParameterValue]:
    """Parameters of every node for what the simulated arm carries in a scene; none where the file has a tool."""
    own = parameters_in(options.parameter_file, "planner", namespace)
    if not options.driver or any(name in own for name in TOOL_PARAMETERS):
        return {}
    values = {entry.name: getattr(scene.tool, entry.name) for entry in Tool.declared()}
    given = {name: value for name, value in values.items() if value != getattr(NO_TOOL, name)}
    return {full_name(TOOL, name): list(value) if isinstance(value, tuple) else value for name, value in given.items()}


def _of_scene(scene: SceneFile, parameter_file: Path, namespace: str) -> dict[str, ParameterValue]:
    """Parameters of the planner that describe the obstacles of a scene, and its goal, except those of the file.

    The planner has one stiffness for all balls and one for all meshes: the largest, where they differ.
    """
    values: dict[str, float] = {}
    for obstacle in anywhere(scene):
        material = obstacle.material
        if obstacle.bending is not None:
            continue  # Its markers have the stiffness of each edge.
        if obstacle.is_deformable:
            name, value = "edge_stiffness", material.edge_stiffness
        else:
            name, value = "sphere_stiffness", material.stiffness
        values[name] = max(value, values.get(name, 0.0))
    capacity: dict[str, ParameterValue] = {"max_spheres": sphere_capacity(scene)}
    chosen = parameters_in(parameter_file, "planner", namespace)
    goal: dict[str, ParameterValue] = {}
    if scene.target.orientation == FREE and chosen.get("goal_orientation", HOLD) == HOLD:
        goal["goal_orientation"] = FREE
    return goal | {name: value for name, value in {**capacity, **values}.items() if name not in chosen}
