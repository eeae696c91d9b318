"""Cost and bounds of the planner's actions, made from its settings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.closed_loop import N_TASK
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.transfer.model import arm_model
from contact_reach_ros.planning.transfer.pipeline import System


def make_objective(arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> Objective:
    """The cost over the transfer function that `settings.pipeline` names."""
    system = System(arm_model(arm), gains, settings.contact_stiffness, settings.knot_duration / settings.substeps)
    arguments = (system, settings.horizon, settings.substeps, settings.contact_measure)
    posture = None
    if settings.null_space == "reference_posture":
        posture = single(np.array(settings.resolve(arm).reference_posture)[:, None])
    if settings.pipeline == "closed_loop":
        return Objective(*arguments, posture=posture)
    # Brax's own pipelines are for comparison, and slow to import.
    from contact_reach_ros.planning.transfer.brax_pipelines import BraxObjective

    return BraxObjective(*arguments, settings.pipeline, arm, posture=posture)


def knot_bounds(arm: Arm, settings: PlanningSettings) -> Array:
    """γ of an action, Δx and Δq, (6 + n,), m and rad."""
    translation, rotation = [settings.translation_bound] * 3, [settings.rotation_bound] * 3
    return np.array(translation + rotation + [settings.posture_bound] * arm.n)


def planned(arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> NDArray[np.bool_]:
    """Which components of an action are variables of the plan, (6 + n,); the others are zero.

    The rows of Δx that law (1) controls; and Δq, unless it has no effect: under law (6), or where no joint is left to
    the null space.
    """
    is_planned = np.zeros(N_TASK + arm.n, bool)
    is_planned[: gains.rows] = True
    is_planned[N_TASK:] = settings.null_space == "planned" and arm.n > gains.rows
    return is_planned


def action_bounds(arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> Array:
    """γ of all variables of a plan, knot after knot, (H * their number,), m and rad."""
    return np.tile(knot_bounds(arm, settings)[planned(arm, settings, gains)], settings.horizon)
