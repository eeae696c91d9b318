"""Settings of the controller, and which of them the planner and the observer have to have, too.

The planner predicts what the controller will do: a plan for another arm, rate or gains is not what the arm does. And
the controller watches itself with the settings of the observer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import ROBOT, ROBOT_DIGEST
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Sections, Settings, setting

POSE, AXIS, POSITION = "pose", "position_and_axis", "position"
TASK_ROWS = {POSE: 6, AXIS: 5, POSITION: 3}
"""Rows that law (1) controls, by the setting `task`: translation and rotation, translation and the direction of the
tip's z axis, or translation alone."""

SINGULARITY_FLOOR = 0.03
"""Eigenvalues of J M⁻¹ Jᵀ below this are lifted, 1/kg, which bounds Λ: it costs less than 1 mm
while the elbow is bent by 0.4 rad, see docs/control.md."""


@dataclass(frozen=True)
class ImpedanceSettings(Settings):
    """Gains of the laws (1) and (2), which multiply the identity as in the paper's Section V, and their references."""

    task: str = setting(
        POSE, "what law (1) controls of the tip; the rest is left to the null space", choices=tuple(TASK_ROWS)
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
        """Number m of rows that law (1) controls."""
        return TASK_ROWS[self.task]


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


CONTROLLER_SECTIONS: Sections = {
    "impedance": ImpedanceSettings,
    "limits": LimitSettings,
    "supervision": SupervisionSettings,
}
"""Settings of the controller by parameter prefix."""

SHARED = (ROBOT, *(f"tool.{entry.name}" for entry in Tool.declared()), ROBOT_DIGEST, "state_rate")
"""Settings of every node that a plan depends on."""

SHARED_SECTION = "impedance."
"""Prefix of the gains, which the planner has to know to predict what the controller will do."""

MAX_POSITION_ERROR = "supervision.max_position_error"
"""Setting above which the controller drops a plan, which the planner has to know, too."""


def plan_basis(arm: Arm, gains: ImpedanceSettings, max_position_error: float) -> dict[str, Any]:
    """What plans are made for, by the full names of the settings: the arm, and the controller that follows them."""
    basis = {ROBOT: arm.name, ROBOT_DIGEST: arm.digest, MAX_POSITION_ERROR: max_position_error}
    return basis | {SHARED_SECTION + name: value for name, value in asdict(gains).items()}


def disagreement(own: Mapping[str, Any], planners: Mapping[str, Any]) -> str:
    """What the planner plans with and the controller has not, as `differences` has it."""
    names = [name for name in own if name.startswith(SHARED_SECTION)]
    return differences(own, planners, "planner", [*names, MAX_POSITION_ERROR])


def differences(own: Mapping[str, Any], others: Mapping[str, Any], other: str, names: Iterable[str]) -> str:
    """What another node has and the controller has not, with both values; empty when they agree.

    Parameters
    ----------
    own, others
        Settings of the controller and of the other node by their full names; what the other one does not report is not
        compared.
    other
        Name of the other node.
    names
        Settings to compare besides `SHARED`.
    """
    found = [
        f"{name} = {others[name]} in the {other}, {own[name]} in the controller"
        for name in (*SHARED, *names)
        if name in own and name in others and _plain(others[name]) != _plain(own[name])
    ]
    return "; ".join(found)


def _plain(value: Any) -> Any:
    """The value as it comes out of JSON."""
    return list(value) if isinstance(value, tuple) else value
