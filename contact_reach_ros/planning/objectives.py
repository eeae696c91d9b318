"""Cost and bounds of the planner's actions, made from its settings."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective
from contact_reach_ros.planning.settings import PlanningSettings
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
    from contact_reach_ros.planning.transfer.brax_pipelines import STEPS, BraxObjective

    return BraxObjective(*arguments, settings.pipeline, STEPS[settings.pipeline], arm, posture=posture)


def action_bounds(arm: Arm, settings: PlanningSettings) -> Array:
    """γ of all variables of a plan, knot after knot; m and rad.

    (H * (6 + n),) with Δx and Δq, or (H * 6,) with Δx alone under law (6).
    """
    knot = [settings.translation_bound] * 3 + [settings.rotation_bound] * 3
    if settings.null_space == "planned":
        knot += [settings.posture_bound] * arm.n
    return np.tile(knot, settings.horizon)
