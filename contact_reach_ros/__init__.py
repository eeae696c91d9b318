"""Safe contact on the way to a goal, for a redundant torque-controlled arm: a library, and nodes for ROS 2.

The library consists of the names below. They are imported on first use, because JAX, MuJoCo and Pinocchio take seconds.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from contact_reach_ros.arm.arm import Arm
    from contact_reach_ros.arm.joint_state import JointState
    from contact_reach_ros.arm.tool import Tool
    from contact_reach_ros.arms import load_arm
    from contact_reach_ros.control.controller import Controller
    from contact_reach_ros.control.references import References
    from contact_reach_ros.control.settings import (
        ControllerSettings,
        ImpedanceSettings,
        LimitSettings,
        SupervisionSettings,
    )
    from contact_reach_ros.errors import ContactReachError
    from contact_reach_ros.observer.budget import ContactBudget, load_budget
    from contact_reach_ros.observer.observer import Observer, SafetyReport
    from contact_reach_ros.observer.settings import ObserverSettings
    from contact_reach_ros.planning.plan import Plan
    from contact_reach_ros.planning.planner import Planner
    from contact_reach_ros.planning.settings import PlanningSettings, ReplanningSettings, UnexpectedContactSettings
    from contact_reach_ros.presets import preset
    from contact_reach_ros.resources import VERSION as __version__
    from contact_reach_ros.scenes.generate import load_scene
    from contact_reach_ros.simulation.robot import SimulatedRobot
    from contact_reach_ros.stack import Result, Robot, Stack, Tick, make_planner
    from contact_reach_ros.world.goal import Goal, Task
    from contact_reach_ros.world.scene import Scene
    from contact_reach_ros.world.spheres import Spheres, sphere_capacity

_NAMES = {
    "arm.arm": ("Arm",),
    "arm.joint_state": ("JointState",),
    "arm.tool": ("Tool",),
    "arms": ("load_arm",),
    "control.controller": ("Controller",),
    "control.references": ("References",),
    "control.settings": ("ControllerSettings", "ImpedanceSettings", "LimitSettings", "SupervisionSettings"),
    "errors": ("ContactReachError",),
    "observer.budget": ("ContactBudget", "load_budget"),
    "observer.observer": ("Observer", "SafetyReport"),
    "observer.settings": ("ObserverSettings",),
    "planning.plan": ("Plan",),
    "planning.planner": ("Planner",),
    "planning.settings": ("PlanningSettings", "ReplanningSettings", "UnexpectedContactSettings"),
    "presets": ("preset",),
    "scenes.generate": ("load_scene",),
    "simulation.robot": ("SimulatedRobot",),
    "stack": ("Result", "Robot", "Stack", "Tick", "make_planner"),
    "world.goal": ("Goal", "Task"),
    "world.scene": ("Scene",),
    "world.spheres": ("Spheres", "sphere_capacity"),
}
"""Public names, by the modules that define them."""
_WHERE = {name: module for module, names in _NAMES.items() for name in names}

__all__ = ["__version__", *_WHERE]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("contact_reach_ros.resources").VERSION
    if name not in _WHERE:
        raise AttributeError(f"module 'contact_reach_ros' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"contact_reach_ros.{_WHERE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
