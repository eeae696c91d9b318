"""What becomes of a planner whose device has no memory left for its candidates."""

from __future__ import annotations

import dataclasses

import jax

from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.settings import PlanningSettings

EXHAUSTION = (jax.errors.JaxRuntimeError, ValueError)
"""Errors that may mean that a device is out of memory: XLA has one for what a program needs, another for its result."""

_SIGNS = ("RESOURCE_EXHAUSTED", "Out of memory")
"""In their texts if they do; one that has spread to later programs is INTERNAL and has the second only."""


def with_fewer_candidates(settings: PlanningSettings, error: Exception) -> tuple[PlanningSettings, str]:
    """The settings with half as many candidates and points on the line, and what happened, in words.

    Raises
    ------
    PlanningError
        If `settings.least_population` does not permit as few.
    Exception
        The error itself, if it means something else.
    """
    reason = str(error).partition("\n")[0]
    if not any(sign in reason for sign in _SIGNS):
        raise error
    population, least = settings.population // 2, settings.least_population
    text = f"the device ran out of memory with planning.population = {settings.population} ({reason})"
    if not 0 < least <= population:
        raise PlanningError(
            f"{text}; expected fewer candidates, or a planning.least_population (now {least}) of at most "
            f"{population} to go on with fewer"
        ) from error
    fewer = dataclasses.replace(
        settings,
        population=population,
        elite=max(2, settings.elite * population // settings.population),
        line_search_points=max(2, settings.line_search_points // 2),
    )
    return fewer, f"{text}, further plans have {population}"
