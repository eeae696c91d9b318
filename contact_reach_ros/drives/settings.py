"""Settings of the adapter between controller and drive."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.control.settings import LimitSettings, SupervisionSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Sections, Settings, setting

EFFORT, LBR, FRANKA = KINDS = ("effort", "lbr", "franka")
"""What takes the commands; each kind has a section of settings with its name."""

FRANKA_TORQUE_RATE = 1000.0
"""Nm/s that libfranka lets through of each joint's torque."""
FRANKA_STATES = "franka/joint_states"
"""Topic of Franka's joint states at full rate; those on joint_states come 30 times a second."""


@dataclass(frozen=True)
class AdapterSettings(Settings):
    """What takes the commands, and what is sent where there are none."""

    kind: str = setting(
        EFFORT,
        "what takes the commands: an effort controller of ros2_control, a KUKA LBR behind lbr_fri_ros2_stack, or an "
        "arm of Franka's behind franka_ros2",
        choices=KINDS,
    )
    gravity_compensation: bool = setting(
        True, "carry the arm; false for arms that compensate gravity themselves, as in the controller"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind != EFFORT and self.gravity_compensation:
            raise SettingsError(
                f"AdapterSettings.gravity_compensation = true: expected false for kind = {self.kind}, whose drive "
                "carries the arm; set supervision.gravity_compensation of the controller, too"
            )

    @property
    def stop(self) -> SupervisionSettings:
        """The settings of the compliant stop whose torques are sent."""
        return SupervisionSettings(gravity_compensation=self.gravity_compensation)

    @property
    def limits(self) -> LimitSettings:
        """The limits of these torques."""
        return LimitSettings(torque_rate=FRANKA_TORQUE_RATE) if self.kind == FRANKA else LimitSettings()


@dataclass(frozen=True)
class EffortSettings(Settings):
    """The effort controller of ros2_control."""

    controller: str = setting(
        "effort_controller", "name of the controller; it takes torques on <name>/commands", is_name=True
    )
    ask_joints: bool = setting(
        True,
        "read the order of joints from the controller's parameter joints before anything is passed on; false for a "
        "drive without one, as the simulated driver, whose order is the arm's",
    )
    brakes: bool = setting(
        False,
        "the drive closes its brakes when the controller is deactivated; otherwise an arm that does not carry itself "
        "would drop, and is not deactivated",
    )


@dataclass(frozen=True)
class LbrSettings(Settings):
    """KUKA's LBR arms with lbr_fri_ros2_stack, in torque command mode."""

    driver: str = setting(
        "lbr",
        "namespace of the driver: <driver>/state, <driver>/command/torque, <driver>/controller_manager",
        is_name=True,
    )
    velocity_cutoff: float = setting(
        30.0,
        "cut-off of the low-pass on the velocities, which are differences of positions; 0 for none",
        unit="Hz",
        minimum=0.0,
        maximum=500.0,
    )
    torque_sign: str = setting(
        "positive",
        "sign with which the driver reports the torque that carries the arm: the doctor's check of gravity finds it",
        choices=("positive", "negative"),
    )
    component: str = setting(
        "lbr_system_interface",
        "name of the hardware component that a stop deactivates, whereupon KUKA's controller closes the brakes; empty "
        "to go on with harmless torques instead",
    )


@dataclass(frozen=True)
class FrankaSettings(Settings):
    """An effort controller of ros2_control on franka_ros2, and the reflexes of the arm below it."""

    controller: str = setting(
        "effort_controller", "name of the controller; it takes torques on <name>/commands", is_name=True
    )
    set_reflexes: bool = setting(
        True,
        "set these reflexes in the arm before anything is passed on, which needs franka_msgs; false if they are set "
        "already",
    )

    @property
    def effort(self) -> EffortSettings:
        """Those of the effort controller; a stop deactivates it, and the arm holds itself."""
        return EffortSettings(self.controller)


ADAPTER_SECTIONS: Sections = {
    "": AdapterSettings,
    EFFORT: EffortSettings,
    LBR: LbrSettings,
    FRANKA: FrankaSettings,
}
"""Settings of the adapter by parameter prefix."""
