"""Drive of a Franka arm: an effort controller of ros2_control on franka_ros2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rclpy.node import Node

from contact_reach_ros.arm import Arm
from contact_reach_ros.drives.effort import EffortTarget, RepeatedRequest
from contact_reach_ros.drives.settings import FRANKA, FRANKA_TORQUE_RATE, FrankaSettings
from contact_reach_ros.errors import SettingsError

try:
    from franka_msgs.srv import SetFullCollisionBehavior
except ImportError:
    SetFullCollisionBehavior = None

REFLEX_TORQUES = (35.0, 35.0, 32.0, 30.0, 29.0, 27.0, 24.0)
"""External torque of each joint at which the arm's reflex stops it, N m: above the contact budget that is shipped, so
that the compliant stop comes first."""
REFLEX_FORCE, REFLEX_MOMENT = 60.0, 30.0
"""The same for external forces, N, and moments, N m, at the flange."""
REFLEX_SERVICE = "service_server/set_full_collision_behavior"
"""Service of franka_ros2 that sets them."""

_NOT_SET = f"the reflexes are not set yet: {REFLEX_SERVICE} does not answer"

_CONTROLLER, _OBSERVER = "controller", "observer"
_RATE, _THRESHOLDS = "limits.torque_rate", "budget.torque_thresholds"


class FrankaTarget(EffortTarget):
    """An effort controller whose commands are without gravity, above the reflexes of the arm.

    Nothing is passed on before the reflexes are set, nor while controller or observer have settings that the arm's own
    limits would cut short.
    """

    SECTION = FRANKA

    def __init__(self, node: Node, arm: Arm, settings: FrankaSettings) -> None:
        """Raise `SettingsError` if the arm has not one joint for each reflex, or franka_msgs is needed and missing."""
        if arm.n != len(REFLEX_TORQUES):
            raise SettingsError(f"kind = franka: {arm.name} has {arm.n} joints; expected {len(REFLEX_TORQUES)}")
        super().__init__(node, arm, settings.effort, carries=False)
        self._unset = ""
        """Why the reflexes are not set; empty when they are."""
        self._setter: RepeatedRequest | None = None
        if not settings.set_reflexes:
            return
        if SetFullCollisionBehavior is None:
            raise SettingsError(
                "kind = franka: the message package franka_msgs is not installed; build franka_ros2, and source its "
                "workspace before the adapter starts, or set the reflexes by hand and franka.set_reflexes: false"
            )
        client = node.create_client(SetFullCollisionBehavior, REFLEX_SERVICE)
        self._setter = RepeatedRequest(client, self._on_set)
        self._unset = _NOT_SET

    @property
    def problem(self) -> str:
        """Why nothing can be passed on; empty when it can."""
        return self._unset or super().problem

    def look(self) -> None:
        """Ask as an effort controller, and set the reflexes of each driver once; to be called a few times a second."""
        super().look()
        if self._setter is not None and not self._setter.is_there:
            self._unset = _NOT_SET
        if self._setter is not None and self._unset:
            self._setter.send(self._request())

    def hear(self, node: str, settings: Mapping[str, Any]) -> str:
        """Why a node's settings do not fit the arm's own limits; empty if they do."""
        rate = settings.get(_RATE, 0.0)
        if node == _CONTROLLER and rate > FRANKA_TORQUE_RATE:
            return (
                f"{_RATE} = {rate:g} in the controller; expected at most {FRANKA_TORQUE_RATE:g} Nm/s, which the arm "
                "follows"
            )
        if node == _OBSERVER and _THRESHOLDS in settings:
            own = settings[_THRESHOLDS]
            for name, budget, reflex in zip(self._arm.joint_names, own, REFLEX_TORQUES, strict=True):
                if budget > reflex:
                    return (
                        f"the reflex of {name} comes at {reflex:g} Nm, before the contact budget's stop at {budget:g} "
                        "Nm: lower the budget's torque_thresholds"
                    )
        return ""

    def diagnosis(self) -> dict[str, Any]:
        """The reflexes in force."""
        return {"reflexes": self._unset or "set"}

    def _request(self) -> Any:
        wrench = [REFLEX_FORCE] * 3 + [REFLEX_MOMENT] * 3
        return SetFullCollisionBehavior.Request(
            **{
                f"{bound}_{kind}_thresholds_{phase}": list(limits)
                for bound in ("lower", "upper")
                for phase in ("acceleration", "nominal")
                for kind, limits in (("torque", REFLEX_TORQUES), ("force", wrench))
            }
        )

    def _on_set(self, answer: Any) -> None:
        self._unset = "" if answer.success else f"the arm refuses the reflexes: {answer.error}"
