"""The stack for `ros2 launch contact_reach_ros bringup.launch.py`, from the same table as the bringup executable."""

from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction
from launch.conditions import IfCondition
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.bringup.processes import BringupOptions, processes, resolved, stack_arm
from contact_reach_ros.resources import PACKAGE, config_file
from contact_reach_ros.ros.discovery import environment
from contact_reach_ros.settings import as_arguments, parse_yaml
from launch import LaunchDescription

NEVER = "1e9"
"""Seconds after which launch would kill what holds the arm."""
ARGUMENTS = {entry.name: entry for entry in BringupOptions.declared() if not entry.is_open_list}
RVIZ = LaunchConfiguration("rviz")


def start_nodes(context):
    """Turn the chosen arguments into nodes; the end of any node but the viewers ends them all."""
    texts = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    values = {name: text if ARGUMENTS[name].kind is str else parse_yaml(text) for name, text in texts.items()}
    asked = BringupOptions.from_mapping(values, "launch arguments")
    options = resolved(asked, "bringup")
    hears = environment(options.discovery)
    description = build_urdf(stack_arm(options))
    stack = [
        Node(
            package=PACKAGE,
            executable=process.name,
            output="screen",
            # As bring-up does: what launch makes of parameters would be for every node whose settings this one reads.
            arguments=[
                *("--ros-args", "--enclave", process.enclave, "--params-file", str(options.parameter_file)),
                *as_arguments(process.parameters),
            ],
            additional_env=hears,
            **({"sigterm_timeout": NEVER, "sigkill_timeout": NEVER} if process.lasts else {}),
            on_exit=EmitEvent(event=Shutdown(reason=f"{process.name} ended")) if process.essential else None,
        )
        for process in processes(options)
    ]
    rviz = [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            additional_env=hears,
            parameters=[{"robot_description": description, "use_sim_time": options.lockstep}],
            condition=IfCondition(RVIZ),
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            additional_env=hears,
            arguments=["--display-config", str(config_file("stack.rviz"))],
            parameters=[{"use_sim_time": options.lockstep}],
            condition=IfCondition(RVIZ),
        ),
    ]
    # Whoever publishes the robot's description publishes its frames, too.
    return [*stack, *(rviz if options.robot == asked.robot else rviz[1:])]


def generate_launch_description():
    """Launch arguments and the nodes of the bring-up table."""
    arguments = [
        DeclareLaunchArgument(name, default_value=str(entry.default), description=entry.description)
        for name, entry in ARGUMENTS.items()
    ]
    rviz = DeclareLaunchArgument("rviz", default_value="false", description="show the stack in RViz")
    return LaunchDescription([*arguments, rviz, OpaqueFunction(function=start_nodes)])
