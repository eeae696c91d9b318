"""The stack for `ros2 launch contact_reach_ros bringup.launch.py`, from the same table as the bringup executable."""

from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from contact_reach_ros.nodes.discovery import environment
from contact_reach_ros.nodes.processes import PACKAGE, StackOptions, processes
from launch import LaunchDescription

ARGUMENTS = {
    "scene": ("ball", "scene: a name or the path of a YAML file"),
    "seed": ("0", "seed of the scene and the sensor noise"),
    "target": ("", "flange position that the scene is built for, 'x y z' in m"),
    "lockstep": ("false", "simulated time that waits for every node"),
    "bag": ("", "directory to record a bag to"),
    "parameters": ("", "parameter file for the nodes"),
    "driver": ("true", "start the simulated driver"),
    "view": ("false", "start the viewer, a page for browsers"),
    "discovery": ("host", "who hears the nodes: host, or subnet"),
}


def start_nodes(context):
    """Turn the chosen arguments into nodes; the end of any node but the viewer ends them all."""
    chosen = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    options = StackOptions(
        scene=chosen["scene"],
        seed=int(chosen["seed"]),
        target=chosen["target"],
        lockstep=chosen["lockstep"] == "true",
        bag=chosen["bag"],
        parameters=chosen["parameters"],
        driver=chosen["driver"] == "true",
        view=chosen["view"] == "true",
        discovery=chosen["discovery"],
    )
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
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start_nodes)])
