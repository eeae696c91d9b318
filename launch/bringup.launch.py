"""The stack for `ros2 launch contact_reach_ros bringup.launch.py`, from the same table as the bringup executable."""

import yaml
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from contact_reach_ros.bringup.processes import BringupOptions, processes
from contact_reach_ros.resources import PACKAGE
from contact_reach_ros.ros.discovery import environment
from launch import LaunchDescription

ARGUMENTS = {entry.name: entry for entry in BringupOptions.declared() if not entry.is_open_list}


def start_nodes(context):
    """Turn the chosen arguments into nodes; the end of any node but the viewer ends them all."""
    texts = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    values = {name: text if ARGUMENTS[name].kind is str else yaml.safe_load(text) for name, text in texts.items()}
    options = BringupOptions.from_mapping(values, "launch arguments")
    return [
        Node(
            package=PACKAGE,
            executable=process.name,
            output="screen",
            arguments=["--ros-args", "--enclave", process.enclave],
            additional_env=environment(options.discovery),
            parameters=[str(options.parameter_file), process.parameters],
            on_exit=EmitEvent(event=Shutdown(reason=f"{process.name} ended")) if process.essential else None,
        )
        for process in processes(options)
    ]


def generate_launch_description():
    """Launch arguments and the nodes of the bring-up table."""
    arguments = [
        DeclareLaunchArgument(name, default_value=str(entry.default), description=entry.description)
        for name, entry in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start_nodes)])
