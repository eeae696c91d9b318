"""What bring-up starts; without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from contact_reach_ros.drives.settings import FRANKA, FRANKA_STATES, KINDS, LBR
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import DEFAULT_PARAMETERS, Sections, Settings, setting


@dataclass(frozen=True)
class BringupOptions(Settings):
    """What to start."""

    scene: str = setting("ball", "scene: a name or the path of a YAML file")
    lockstep: bool = setting(False, "simulated time that waits for every node, instead of real time")
    state_rate: float = setting(
        0.0, "nominal rate of joint states; 0 leaves it to the parameter file", unit="Hz", minimum=0.0, maximum=1000.0
    )
    robot: str = setting(
        "", "arm: a name, the path of its file, or robot_description; empty leaves it to the parameter file"
    )
    bag: str = setting("", "directory to record a bag to; none when empty")
    parameters: str = setting("", "parameter file for the nodes; the package's own when empty")
    driver: bool = setting(True, "start the simulated driver; false with a real robot's driver")
    adapter: str = setting(
        "none",
        "start the adapter of this kind between controller and drive, see docs/adapter.md",
        choices=("none", *KINDS),
    )
    discovery: str = setting(
        "host",
        "who hears the nodes: this host only, or everybody on the subnet, see docs/security.md",
        choices=("host", "subnet"),
    )
    view: bool = setting(False, "start the viewer, a page for browsers")
    overrides: tuple[str, ...] = setting(
        (), "parameters of nodes besides the file's: node:parameter=value each, the value as YAML"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.driver and self.adapter in (LBR, FRANKA):
            raise SettingsError(
                f"BringupOptions.adapter = {self.adapter}: expected driver = false (--no-driver); the simulated driver "
                "has not the topics of that one"
            )

    @property
    def remappings(self) -> list[str]:
        """ROS arguments for all nodes, to come after the user's: of the remappings of a name the first one holds."""
        return ["--ros-args", "-r", f"joint_states:={FRANKA_STATES}"] if self.adapter == FRANKA else []

    @property
    def parameter_file(self) -> Path:
        """The parameter file in use: the user's, or the package's for the adapter."""
        if self.parameters:
            return Path(self.parameters)
        return config_file(f"{self.adapter}.yaml" if self.adapter in (LBR, FRANKA) else DEFAULT_PARAMETERS)


BRINGUP_SECTIONS: Sections = {"": BringupOptions}
"""Settings of bring-up by parameter prefix."""
