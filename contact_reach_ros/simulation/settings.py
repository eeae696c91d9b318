"""Settings of the simulated robot and of the driver, its node."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Sections, Settings, setting
from contact_reach_ros.timing import NANOSECONDS

TICK = 0.001
"""Step of the simulated robot, s."""
TICK_NS = int(TICK * NANOSECONDS)


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
class WatchdogSettings(Settings):
    """When the drive closes the brakes by itself."""

    enabled: bool = setting(
        True, "watch for silence; false holds the last torque for ever, as effort controllers of ros2_control do"
    )
    speed_share: float = setting(
        1.1,
        "joint speed at which the brakes close and stay closed, as a share of the data sheet's limit, 0 for none; "
        "keep it above the controller's, which stops the arm more softly",
        minimum=0.0,
        maximum=2.0,
    )


@dataclass(frozen=True)
class DriverSettings(Settings):
    """What to simulate, and in real or simulated time."""

    scene: str = setting("ball", "scene: a name or the path of a YAML file")
    seed: int = setting(0, "seed of the scene and the sensor noise", minimum=0, maximum=2**31 - 1)
    target: str = setting("", "flange position that the scene is built for, 'x y z' in m; drawn when empty")
    waits_for_goal: bool = setting(False, "in simulated time, wait with open brakes until the planner has had a goal")


DRIVER_SECTIONS: Sections = {
    "": DriverSettings,
    "watchdog": WatchdogSettings,
}
"""Settings of the driver by parameter prefix."""
