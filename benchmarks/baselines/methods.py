"""All ways to reach a goal, by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from benchmarks.baselines.collision_free import CollisionFreePlanner
from benchmarks.baselines.contact_rrt import find_contact_path
from benchmarks.baselines.joint_torque import TorqueController, TorquePlanner, joint_damping
from benchmarks.baselines.method import Method
from benchmarks.baselines.reactive import ReactivePlanner
from benchmarks.baselines.reference_posture import PosturePlanner, StartPlanner
from benchmarks.baselines.rrt_star import JointPath, PathSettings, find_path
from benchmarks.baselines.solvers import CmaSolver, GradientSolver
from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.hybrid import HybridSolver
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

METHODS = {
    "contact_reach": "the method (paper: 'ours'): plans Δx and Δq with Algorithm 1, followed by laws (1)-(3)",
    "no_detours": "the method without detours: it stays where its horizon sees no way on",
    "reference_posture": "law (6): plans Δx alone, a steady pull to q_d = 0 moves the redundant joints",
    "start_posture": "the same, but a pull to the posture at the start",
    "collision_free": "RRT* in joint space, the shortest of several simplified paths, followed without re-planning",
    "rrt_star": "the same with one run of plain RRT*, its path followed as it is (paper: 'collision-free')",
    "contact_rrt": "the same with a path of transition-based RRT, whose cost is the predicted force, below ε",
    "reactive": "no planner: law (1) straight to the goal, law (2) at the arm's own posture",
    "joint_torque": "plans joint torques (paper: 'joint torque') with Algorithm 1, applied without any control law",
    "cma_es": "the method with plain CMA-ES (paper: 'vanilla CMA-ES') in place of Algorithm 1",
    "gradient": "the method with many gradient steps per step of Algorithm 1",
}
"""What each name stands for, in one line with what the paper calls it."""

_PATHS = {
    "collision_free": PathSettings(),
    "rrt_star": PathSettings(searches=1, iterations=1000, informed=False, simplify=False),
}

_ANY_POSTURE = 7.0
"""rad."""

PATH_METHODS = (*_PATHS, "contact_rrt")
"""Methods that follow a path to its end, however long it is."""

PLANLESS = (*PATH_METHODS, "reactive")
"""Methods that plan nothing on the way, so that no plan takes time."""

_SOLVERS = {"cma_es": CmaSolver, "gradient": GradientSolver}
"""In place of Algorithm 1, by method."""

_POSTURES = {"reference_posture": PosturePlanner, "start_posture": StartPlanner}
_WITHOUT_DETOURS = ("no_detours", *_POSTURES)
"""Law (6) has a posture of its own, to which no detour leads."""


def _search(name: str, permitted_force: float) -> Callable[[Arm, Array, Target, Spheres, int], JointPath]:
    """What finds the path of one of `PATH_METHODS`."""
    if name in _PATHS:
        return lambda arm, q, goal, spheres, seed: find_path(arm, q, goal, spheres, _PATHS[name], seed)
    return lambda arm, q, goal, spheres, seed: find_contact_path(arm, q, goal, spheres, permitted_force, seed)


def make_method(
    arm: Arm,
    name: str,
    capacity: int,
    permitted_force: float,
    seed: int,
    settings: PlanningSettings | None = None,
    controller: ControllerSettings | None = None,
) -> Method:
    """A method that is not warmed up yet; only its `warm_up` takes long.

    Parameters
    ----------
    arm
        What it moves.
    name
        One of `METHODS`.
    capacity
        Number of obstacle spheres that its plans look at, see `sphere_capacity`.
    permitted_force
        ε of (4d), N.
    seed
        Of its random numbers.
    settings
        Of the planner; those that make the method what it is are set here.
    controller
        Of the controller, whose gains the planner plans with.

    Raises
    ------
    SettingsError
        If there is no such method; the message lists those there are.
    """
    if name not in METHODS:
        raise SettingsError(f"method '{name}' is unknown; expected one of {', '.join(METHODS)}")
    controller = ControllerSettings() if controller is None else controller
    settings = PlanningSettings() if settings is None else settings
    if name == "reactive":
        return Method(ReactivePlanner(arm, settings), controller)
    if name in PATH_METHODS:
        search = _search(name, permitted_force)
        return Method(CollisionFreePlanner(arm, settings, controller.impedance, search, seed), controller)
    if name == "joint_torque":
        damping = joint_damping(arm)
        planner = TorquePlanner(arm, settings, controller, permitted_force, capacity, damping)
        planner.reseed(seed)
        return Method(planner, controller, TorqueController)
    if name in _WITHOUT_DETOURS:
        settings = dataclasses.replace(settings, detour_patience=0.0)
    kind: type[RecedingHorizonPlanner] = _POSTURES.get(name, RecedingHorizonPlanner)
    if name in _POSTURES:
        # Law (6) pulls from afar, which the controller would refuse as a posture that is too far away.
        supervision = dataclasses.replace(controller.supervision, max_posture_error=_ANY_POSTURE)
        controller = dataclasses.replace(controller, supervision=supervision)
    solver = _SOLVERS.get(name, HybridSolver)
    core = kind(arm, settings, controller, permitted_force, capacity, solver)
    core.reseed(seed)
    return Method(core, controller)
