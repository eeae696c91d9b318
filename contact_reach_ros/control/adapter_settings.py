"""Settings of the adapter between controller and drive."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Sections, Settings, setting

DAMPING, ZERO = "damping", "zero"
"""What is sent instead of commands."""


@dataclass(frozen=True)
class AdapterSettings(Settings):
    """When commands count as silent, and what is sent then."""

    kind: str = setting("effort", "what takes the commands: an effort controller of ros2_control", choices=("effort",))
    hold_after: float = setting(
        0.02, "time without a command after which harmless torques are sent", unit="s", minimum=0.002, maximum=1.0
    )
    stop_after: float = setting(
        0.1,
        "time without a command after which none is passed on any more until ~/reset",
        unit="s",
        minimum=0.005,
        maximum=5.0,
    )
    on_silence: str = setting(
        DAMPING,
        "the harmless torques: those of the controller's compliant stop, or zero for a drive that damps by itself",
        choices=(DAMPING, ZERO),
    )
    gravity_compensation: bool = setting(
        True, "carry the arm; false for arms that compensate gravity themselves, as in the controller"
    )
    stop_damping: float = setting(
        20.0,
        "damping of A1; the others' are in proportion to their torque limits",
        unit="Nm s/rad",
        minimum=0.0,
        maximum=50.0,
    )
    resume_ramp: float = setting(
        0.5, "time in which commands reach full authority after a silence", unit="s", minimum=0.0, maximum=5.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hold_after >= self.stop_after:
            raise SettingsError(
                f"AdapterSettings.hold_after = {self.hold_after:g}: expected less than stop_after, "
                f"{self.stop_after:g} s"
            )
        if self.on_silence == ZERO and self.gravity_compensation:
            raise SettingsError(
                "AdapterSettings.on_silence = zero: expected damping, or gravity_compensation = false; zero torques "
                "would drop an arm that does not carry itself"
            )

    def check_period(self, period: float) -> None:
        """Raise `SettingsError` if `hold_after` is less than two periods of the joint states, s."""
        if self.hold_after < 2.0 * period:
            raise SettingsError(
                f"hold_after = {self.hold_after:g}: expected at least two periods of the joint states, "
                f"{2.0 * period:g} s: commands come no faster"
            )

    @property
    def stop(self) -> SupervisionSettings:
        """The settings of the compliant stop whose torques are sent."""
        return SupervisionSettings(gravity_compensation=self.gravity_compensation, stop_damping=self.stop_damping)


@dataclass(frozen=True)
class EffortSettings(Settings):
    """The effort controller of ros2_control."""

    controller: str = setting("effort_controller", "name of the controller; it takes torques on <name>/commands")
    ask_joints: bool = setting(
        True,
        "read the order of joints from the controller's parameter joints before anything is passed on; false for a "
        "drive without one, as the simulated driver, whose order is the arm's",
    )
    manager: str = setting("controller_manager", "name of the controller manager, which deactivates the controller")
    brakes: bool = setting(
        False,
        "the drive closes its brakes when the controller is deactivated; otherwise an arm that does not carry itself "
        "would drop, and is not deactivated",
    )


ADAPTER_SECTIONS: Sections = {"": AdapterSettings, "effort": EffortSettings}
"""Settings of the adapter by parameter prefix."""
