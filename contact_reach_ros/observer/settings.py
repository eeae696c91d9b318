"""All settings of the observer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from contact_reach_ros.settings import Sections, Settings, setting

COULOMB_SPEED = 0.02
"""Speed at which the expected dry friction has reached 76 %, rad/s, so that it does not jump when the sign changes."""


@dataclass(frozen=True)
class MomentumSettings(Settings):
    """Settings of the momentum observer."""

    gain: float = setting(
        50.0,
        "K: the residual follows the external torque as a first-order lag of 1/K",
        unit="1/s",
        minimum=1.0,
        maximum=500.0,
    )
    viscous_friction: tuple[float, ...] = setting(
        None,
        "viscous friction that the model expects",
        unit="Nm s/rad",
        minimum=0.0,
        maximum=50.0,
        per_joint=True,
    )
    coulomb_friction: tuple[float, ...] = setting(
        None, "dry friction that the model expects", unit="Nm", minimum=0.0, maximum=50.0, per_joint=True
    )
    torque_offset: tuple[float, ...] = setting(
        None,
        "torque that the sensors report and no link feels",
        unit="Nm",
        minimum=-50.0,
        maximum=50.0,
        per_joint=True,
    )
    center_shift_x: tuple[float, ...] = setting(
        None,
        "where the centres of the links' mass are found to be, from where the model has them, along x of the link",
        unit="m",
        minimum=-0.5,
        maximum=0.5,
        per_joint=True,
    )
    center_shift_y: tuple[float, ...] = setting(
        None, "the same along y", unit="m", minimum=-0.5, maximum=0.5, per_joint=True
    )
    gravity_in_torque: bool = setting(
        True,
        "the acting torque carries the arm's weight; false for an arm that compensates gravity itself and reports only "
        "the torque on top of that",
    )
    rotors_in_torque: bool = setting(
        True, "the acting torque also accelerates the rotors; false for torque sensors on the link side of the gears"
    )
    torque_cutoff: float = setting(
        0.0,
        "cut-off of the low-pass that the drive puts on its measured torques, which the residual follows then; 0 for "
        "none",
        unit="Hz",
        minimum=0.0,
        maximum=500.0,
    )


@dataclass(frozen=True)
class SafetySettings(Settings):
    """Settings of the safety state machine; the contact budget holds the thresholds.

    Times are at least two states long, or one where they are 1 ms.
    """

    debounce: int = setting(3, "time above a threshold that stops the arm", unit="ms", minimum=1, maximum=100)
    contact_debounce: int = setting(2, "time above a threshold that means contact", unit="ms", minimum=1, maximum=100)


@dataclass(frozen=True)
class PlausibilitySettings(Settings):
    """When joint states are no longer trusted."""

    position_slip: float = setting(
        0.02,
        "difference between a position and its integrated velocity that stops the arm, forgotten over 2 s",
        unit="rad",
        minimum=0.001,
        maximum=0.5,
    )


@dataclass(frozen=True)
class ObserverSettings:
    """Settings of the observer, by section."""

    momentum: MomentumSettings = field(default_factory=MomentumSettings)
    safety: SafetySettings = field(default_factory=SafetySettings)
    plausibility: PlausibilitySettings = field(default_factory=PlausibilitySettings)

    @classmethod
    def from_sections(cls, sections: Mapping[str, Any]) -> ObserverSettings:
        """The settings out of those of a node, by parameter prefix as in `OBSERVER_SECTIONS`."""
        return cls(sections["momentum"], sections["safety"], sections["plausibility"])


@dataclass(frozen=True)
class SourceSettings(Settings):
    """Where the observer takes its values from."""

    contact_budget: str = setting("", "contact budget YAML; the package's own when empty")


OBSERVER_SECTIONS: Sections = {
    "": SourceSettings,
    "momentum": MomentumSettings,
    "safety": SafetySettings,
    "plausibility": PlausibilitySettings,
}
"""Settings of the observer's node by parameter prefix."""
