"""Settings of the simulated robot and of the driver, its node."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Sections, Settings, setting

TICK = 0.001
"""Step of the simulated robot, s."""


def check_period(period: float) -> int:
    """Number of ticks in a period of the joint states, s; raises `SettingsError` if it is not a whole one."""
    ticks = round(period / TICK)
    if ticks < 1 or abs(ticks * TICK - period) > 1e-6 * TICK:
        raise SettingsError(
            f"period = {1000 * period:g} ms: the simulated robot has a whole number of milliseconds, so that its "
            "rate is 1000, 500, 250, 200, 125 or 100 Hz, say"
        )
    return ticks


@dataclass(frozen=True)
class SensorSettings(Settings):
    """Noise of the joint sensors, as standard deviations, and their resolution."""

    position_noise: float = setting(1e-5, "noise of positions", unit="rad", minimum=0.0, maximum=0.01)
    position_resolution: float = setting(
        1e-5, "resolution of positions, 0 for none", unit="rad", minimum=0.0, maximum=0.01
    )
    velocity_noise: float = setting(1e-3, "noise of velocities", unit="rad/s", minimum=0.0, maximum=0.1)
    torque_noise: float = setting(0.05, "noise of measured torques", unit="Nm", minimum=0.0, maximum=5.0)


@dataclass(frozen=True)
class JointSettings(Settings):
    """Joint friction, which controller and observer do not know, and how the joints come to rest."""

    viscous_friction: float = setting(0.3, "viscous friction", unit="Nm s/rad", minimum=0.0, maximum=50.0)
    coulomb_friction: float = setting(0.2, "dry friction", unit="Nm", minimum=0.0, maximum=50.0)
    hold_damping: float = setting(30.0, "damping of the damped hold", unit="Nm s/rad", minimum=1.0, maximum=500.0)
    brake_torque: float = setting(150.0, "holding torque of a closed brake", unit="Nm", minimum=1.0, maximum=1000.0)


@dataclass(frozen=True)
class WatchdogSettings(Settings):
    """When the brakes open, and when the drive closes them by itself."""

    enabled: bool = setting(
        True, "watch for silence; false holds the last torque for ever, as effort controllers of ros2_control do"
    )
    open_after: float = setting(
        0.5, "time of steady commands after which the brakes open", unit="s", minimum=0.0, maximum=5.0
    )
    hold_after: float = setting(
        0.02, "time without a command after which the damped hold begins", unit="s", minimum=0.002, maximum=1.0
    )
    stop_after: float = setting(
        0.1, "time without a command after which the brakes close and stay closed", unit="s", minimum=0.005, maximum=5.0
    )
    speed_share: float = setting(
        1.1,
        "joint speed at which the brakes close and stay closed, as a share of the data sheet's limit, 0 for none; "
        "keep it above the controller's, which stops the arm more softly",
        minimum=0.0,
        maximum=2.0,
    )
    carries: bool = setting(
        False, "the drive carries the arm's weight, as those of KUKA and Franka do: commands are on top of that"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hold_after >= self.stop_after:
            raise SettingsError(
                f"WatchdogSettings.hold_after = {self.hold_after:g}: expected less than stop_after, "
                f"{self.stop_after:g} s; the arm is held before it is stopped"
            )


@dataclass(frozen=True)
class DriverSettings(Settings):
    """What to simulate, and in real or simulated time."""

    scene: str = setting("ball", "scene: a name or the path of a YAML file")
    seed: int = setting(0, "seed of the scene and the sensor noise", minimum=0, maximum=2**31 - 1)
    target: str = setting("", "flange position that the scene is built for, 'x y z' in m; drawn when empty")
    lockstep: bool = setting(False, "advance only when controller, observer and planner are done with the last tick")
    waits_for: str = setting(
        "", "nodes besides these whose promises simulated time waits for in lockstep, separated by commas"
    )


DRIVER_SECTIONS: Sections = {
    "": DriverSettings,
    "watchdog": WatchdogSettings,
    "sensors": SensorSettings,
    "joints": JointSettings,
}
"""Settings of the driver by parameter prefix."""
