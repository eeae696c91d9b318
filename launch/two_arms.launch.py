"""Two arms beside each other, each with a stack in its namespace: `ros2 launch contact_reach_ros two_arms.launch.py`.

Both are simulated; `contact-reach goto 0.5 0.1 0.3 --namespace left` moves one. Arguments of bringup.launch.py hold
for both, such as `scene:=free` or `parameters:=FILE`: in the file `controller` is for both, `/left/controller` for one.
"""

from pathlib import Path

from launch.actions import GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import PushRosNamespace

from launch import LaunchDescription

ARMS = {"left": "iiwa14", "right": "fr3"}
"""Arm by namespace: a name, or the path of a URDF or YAML file."""


def generate_launch_description():
    """Bring each arm up in its namespace; a group keeps the arguments of one from the other."""
    bringup = PythonLaunchDescriptionSource(str(Path(__file__).with_name("bringup.launch.py")))
    return LaunchDescription(
        [
            GroupAction(
                [
                    PushRosNamespace(name),
                    IncludeLaunchDescription(bringup, launch_arguments={"robot": arm}.items()),
                ]
            )
            for name, arm in ARMS.items()
        ]
    )
