"""All settings of the controller."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.kinematics import TASK_ROWS
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Sections, Settings, setting

AUTO = "auto"
"""Task: the one with most rows that the arm can hold."""

IMPACT_ENERGY = 0.13
"""Kinetic energy of a point's motion ½ ẋᵀ W⁻¹ ẋ beyond which the arm is not driven, J: a body of 75 N/mm, a hand by
ISO/TS 15066, is hit with 140 N, however its surface is turned."""
JOINT_SHARE = 0.7
"""Joint speed beyond which the arm is not driven, as a share of the data sheet's limit."""
SINGULARITY_FLOOR = 0.03
"""Eigenvalues of J M⁻¹ Jᵀ below this are lifted, 1/kg, which bounds Λ: it costs less than 1 mm
while the elbow is bent by 0.4 rad, see docs/control.md."""


@dataclass(frozen=True)
class ImpedanceSettings(Settings):
    """Gains of the laws (1) and (2), which multiply the identity as in the paper's Section V, and their references."""

    task: str = setting(
        AUTO,
        "what law (1) controls of the tip; the rest is left to the null space; auto for as much as the arm can hold",
        choices=(AUTO, *TASK_ROWS),
    )
    task_stiffness: float = setting(880.0, "Kp of law (1)", unit="1/s²", minimum=0.0, maximum=2500.0)
    task_damping: float = setting(100.0, "Kd of law (1)", unit="1/s", minimum=0.0, maximum=300.0)
    null_stiffness: float = setting(30.0, "Kqp of law (2)", unit="Nm/rad", minimum=0.0, maximum=200.0)
    null_damping: float = setting(1.0, "Kqd of law (2)", unit="Nm s/rad", minimum=0.0, maximum=50.0)
    reference_ramp: float = setting(
        0.03,
        "time in which x_d and q_d move to those of a new plan or knot; 0 for steps, as in the paper",
        unit="s",
        minimum=0.0,
        maximum=0.2,
    )

    @property
    def rows(self) -> int:
        """Number m of rows that law (1) controls, of settings that are resolved for an arm."""
        return TASK_ROWS[self.task]

    def resolve(self, arm: Arm) -> Self:
        """These settings with the task that the arm can hold in place of `auto`.

        Raises `SettingsError` if it cannot hold that of the settings.
        """
        task, most = arm.task if self.task == AUTO else self.task, TASK_ROWS[arm.task]
        if TASK_ROWS[task] > most:
            fit = ", ".join(name for name, rows in TASK_ROWS.items() if rows <= most)
            raise SettingsError(
                f"impedance.task = {task} has {TASK_ROWS[task]} rows, but the arm's {arm.n} joints can hold {most}; "
                f"expected one of {AUTO}, {fit}"
            )
        return dataclasses.replace(self, task=task)


@dataclass(frozen=True)
class LimitSettings(Settings):
    """Limits on torques and joints."""

    torque_share: float = setting(0.9, "torque cap as a share of the data sheet's limit", minimum=0.05, maximum=1.0)
    torque_rate: float = setting(
        4000.0,
        "greatest rate of change of A1's torque; the others' are in proportion to their torque limits",
        unit="Nm/s",
        minimum=1.0,
        maximum=20000.0,
    )
    tip_force: float = setting(
        60.0,
        "force with which the laws press at any point of an arm that is blocked there; in motion, beyond their damping",
        unit="N",
        minimum=1.0,
        maximum=1000.0,
    )
    body_speed: float = setting(
        0.25,
        "speed of any point of the arm beyond which it is not driven, and at 1.3 times of which it is stopped; less "
        "where the moving mass would hit with more than 0.13 J",
        unit="m/s",
        minimum=0.01,
        maximum=5.0,
    )
    torque_delay: float = setting(
        0.0,
        "time from a velocity to the torque that answers it, beyond one period, as of filters and slow drives: "
        "gains, caps on speed and stop are stable with it",
        unit="s",
        minimum=0.0,
        maximum=0.1,
    )


@dataclass(frozen=True)
class SupervisionSettings(Settings):
    """Plan age, start and stop."""

    require_observer: bool = setting(
        True, "command nothing until the observer confirms the joint states; false moves an unwatched arm"
    )
    shadow: bool = setting(
        False, "compute everything, but publish the torques on shadow/commands, where nothing acts on them"
    )
    adapter: bool = setting(
        False, "publish the torques on adapter/commands, for an adapter that passes them on to the drive"
    )
    gravity_compensation: bool = setting(True, "send g(q); false for arms that compensate gravity themselves")
    hold_limit: float = setting(
        5.0, "time from the end of the last plan to the compliant stop", unit="s", minimum=0.1, maximum=3600.0
    )
    watch_itself: bool = setting(
        True, "let the controller have an observer of its own, so that one that is late leaves nothing unwatched"
    )
    workspace_minimum: tuple[float, ...] = setting(
        (-2.0, -2.0, -2.0),
        "least coordinates of x_d in the base frame: a plan is dropped where it leaves this box",
        unit="m",
        minimum=-10.0,
        maximum=10.0,
    )
    workspace_maximum: tuple[float, ...] = setting(
        (2.0, 2.0, 2.0), "greatest coordinates of x_d", unit="m", minimum=-10.0, maximum=10.0
    )
    max_position_error: float = setting(
        0.05,
        "distance of x_d from the tip above which a plan is dropped; the planner asks for a third of it",
        unit="m",
        minimum=0.001,
        maximum=10.0,
    )
    max_rotation_error: float = setting(
        0.7, "the same for the angle between reference and tip", unit="rad", minimum=0.01, maximum=3.2
    )
    max_posture_error: float = setting(
        0.5, "the same for each joint's distance from the reference posture", unit="rad", minimum=0.01, maximum=7.0
    )
    drive_brakes: bool = setting(
        True,
        "the drive brakes the arm when commands end; false: a stop holds the arm for as long as it lasts",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(low < high for low, high in zip(self.workspace_minimum, self.workspace_maximum, strict=True)):
            raise SettingsError(
                f"supervision.workspace_minimum = {list(self.workspace_minimum)}: expected less than workspace_maximum "
                f"= {list(self.workspace_maximum)} in each coordinate"
            )

    @property
    def has_own_watch(self) -> bool:
        """Whether the controller watches itself: not an arm that may move unwatched, nor one that others command."""
        return self.watch_itself and self.require_observer and not self.shadow


@dataclass(frozen=True)
class ControllerSettings:
    """All settings of the controller, by section."""

    impedance: ImpedanceSettings = field(default_factory=ImpedanceSettings)
    limits: LimitSettings = field(default_factory=LimitSettings)
    supervision: SupervisionSettings = field(default_factory=SupervisionSettings)

    @classmethod
    def from_sections(cls, sections: Mapping[str, Any]) -> ControllerSettings:
        """The settings out of those of a node, by parameter prefix as in `CONTROLLER_SECTIONS`."""
        return cls(*(sections[prefix] for prefix in CONTROLLER_SECTIONS))

    def resolve(self, arm: Arm) -> ControllerSettings:
        """These settings for an arm, as `ImpedanceSettings.resolve`."""
        return dataclasses.replace(self, impedance=self.impedance.resolve(arm))


CONTROLLER_SECTIONS: Sections = {
    "impedance": ImpedanceSettings,
    "limits": LimitSettings,
    "supervision": SupervisionSettings,
}
"""Settings of the controller by parameter prefix."""
