"""`ros2 launch contact_reach_ros bringup.launch.py` with launch's own service: `launching.py NAME:=VALUE ...`."""

import sys

from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from contact_reach_ros.resources import share_directory
from launch import LaunchDescription, LaunchService

if __name__ == "__main__":
    source = PythonLaunchDescriptionSource(str(share_directory() / "launch" / "bringup.launch.py"))
    given = [tuple(text.split(":=", 1)) for text in sys.argv[1:]]
    service = LaunchService()
    service.include_launch_description(LaunchDescription([IncludeLaunchDescription(source, launch_arguments=given)]))
    sys.exit(service.run())
