"""Drive of a Franka arm: an effort controller of ros2_control on franka_ros2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rclpy.node import Node

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.control.adapter_settings import FrankaSettings
from contact_reach_ros.drives.effort import EffortTarget, RepeatedRequest
from contact_reach_ros.errors import SettingsError

try:
    from franka_msgs.srv import SetFullCollisionBehavior
except ImportError:
    SetFullCollisionBehavior = None

TORQUE_RATE = 1000.0
"""Nm/s that libfranka lets through of each joint's torque."""

_CONTROLLER, _OBSERVER = "controller", "observer"
_RATE, _THRESHOLDS = "limits.torque_rate", "budget.torque_thresholds"


class FrankaTarget(EffortTarget):
    """An effort controller whose commands are without gravity, above the reflexes of the arm.

    Nothing is passed on before the reflexes are set, nor while controller or observer have settings that the arm's own
    limits would cut short.
    """

    def __init__(self, node: Node, arm: Arm, settings: FrankaSettings, torque_rate: float) -> None:
        """`torque_rate`: of the adapter's harmless torques, Nm/s.

        Raises `SettingsError` if that is above Franka's limit, the arm has not one joint for each reflex, or
        franka_msgs is needed and not installed.
        """
        if torque_rate > TORQUE_RATE:
            raise SettingsError(f"kind = franka: torque_rate = {torque_rate:g}; expected at most {TORQUE_RATE:g} Nm/s")
        if arm.n != len(settings.reflex_torques):
            raise SettingsError(
                f"kind = franka: {arm.name} has {arm.n} joints; expected {len(settings.reflex_torques)}"
            )
        super().__init__(node, arm, settings, carries=False)
        self._reflexes = settings
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
        client = node.create_client(SetFullCollisionBehavior, settings.reflexes)
        self._setter = RepeatedRequest(client, self._on_set)
        self._unset = f"the reflexes are not set yet: {settings.reflexes} does not answer"

    @property
    def problem(self) -> str:
        """Why nothing can be passed on; empty when it can."""
        return self._unset or super().problem

    def look(self) -> None:
        """Ask for the order of joints, and set the reflexes, unless that is done; to be called a few times a second."""
        super().look()
        if self._setter is not None and self._unset:
            self._setter.send(self._request())

    def hear(self, node: str, settings: Mapping[str, Any]) -> str:
        """Why a node's settings do not fit the arm's own limits; empty if they do."""
        rate = settings.get(_RATE, 0.0)
        if node == _CONTROLLER and rate > TORQUE_RATE:
            return f"{_RATE} = {rate:g} in the controller; expected at most {TORQUE_RATE:g} Nm/s, which the arm follows"
        if node == _OBSERVER and _THRESHOLDS in settings:
            own = settings[_THRESHOLDS]
            for name, budget, reflex in zip(self._arm.joint_names, own, self._reflexes.reflex_torques, strict=True):
                if budget > reflex:
                    return (
                        f"the reflex of {name} comes at {reflex:g} Nm, before the contact budget's stop at {budget:g} "
                        "Nm: raise franka.reflex_torques, or lower the budget's torque_thresholds"
                    )
        return ""

    def diagnosis(self) -> dict[str, Any]:
        """The reflexes in force."""
        return {"reflexes": self._unset or "set"}

    def _request(self) -> Any:
        settings = self._reflexes
        wrench = [settings.reflex_force] * 3 + [settings.reflex_moment] * 3
        return SetFullCollisionBehavior.Request(
            **{
                f"{bound}_{kind}_thresholds_{phase}": list(limits)
                for bound in ("lower", "upper")
                for phase in ("acceleration", "nominal")
                for kind, limits in (("torque", settings.reflex_torques), ("force", wrench))
            }
        )

    def _on_set(self, answer: Any) -> None:
        self._unset = "" if answer.success else f"the arm refuses the reflexes: {answer.error}"
