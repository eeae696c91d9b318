"""`ros2 launch FILE` with launch's own service: `launching.py [--file FILE] [--push NAMESPACE]... NAME:=VALUE ...`.

Each --push is a group with PushRosNamespace around those that follow and the file, by default bringup.launch.py.
"""

import argparse
import sys
from pathlib import Path

from launch.actions import GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import PushRosNamespace

from contact_reach_ros.resources import share_directory
from launch import LaunchDescription, LaunchService

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--file", default="bringup.launch.py")
    parser.add_argument("--push", action="append", default=[])
    parser.add_argument("given", nargs="*")
    options = parser.parse_args()
    source = PythonLaunchDescriptionSource(str(share_directory() / "launch" / Path(options.file)))
    entity = IncludeLaunchDescription(source, launch_arguments=[tuple(text.split(":=", 1)) for text in options.given])
    for name in reversed(options.push):
        entity = GroupAction([PushRosNamespace(name), entity])
    service = LaunchService()
    service.include_launch_description(LaunchDescription([entity]))
    sys.exit(service.run())
