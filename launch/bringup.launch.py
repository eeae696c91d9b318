"""The stack for `ros2 launch contact_reach_ros bringup.launch.py`, from the same table as the bringup executable."""

import shlex

from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction
from launch.conditions import IfCondition
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.utilities import make_namespace_absolute, prefix_namespace

from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.bringup.processes import BringupOptions, processes, resolved, stack_arm
from contact_reach_ros.resources import PACKAGE, config_file
from contact_reach_ros.ros.discovery import environment
from contact_reach_ros.ros.process import in_namespace
from contact_reach_ros.settings import as_arguments, parse_yaml
from launch import LaunchDescription

NEVER = "1e9"
"""Seconds after which launch would kill what holds the arm."""
OPTIONS = {entry.name: entry for entry in BringupOptions.declared()}
OF_LAUNCH = {
    "namespace": ("", "namespace of the stack, below those of the launch files that include this one"),
    "remappings": ("", "remappings for every node, such as 'goal_pose:=reach/goal external_wrench:=wrench'"),
    "log_level": ("info", "of every node: debug, info, warn, error or fatal"),
    "use_sim_time": ("false", "the same as lockstep, by ROS's name"),
    "rviz": ("false", "show the stack in RViz"),
}
"""Default and meaning of the arguments besides the options of bring-up."""
OWN = ("/tf", "/tf_static", "/clock")
"""Topics of the whole system that every stack has for itself in its namespace."""
RVIZ = LaunchConfiguration("rviz")


def start_nodes(context):
    """Turn the chosen arguments into nodes; the end of any node but the viewers ends them all."""
    texts = {name: LaunchConfiguration(name).perform(context) for name in (*OPTIONS, *OF_LAUNCH)}
    values = {
        name: shlex.split(texts[name]) if entry.is_open_list else _value(texts[name], entry)
        for name, entry in OPTIONS.items()
    }
    values["lockstep"] = values["lockstep"] or _value(texts["use_sim_time"], OPTIONS["lockstep"])
    outer = context.launch_configurations.get("ros_namespace")
    namespace = make_namespace_absolute(prefix_namespace(outer, texts["namespace"]))
    remappings = [part for rule in shlex.split(texts["remappings"]) for part in ("-r", rule)]
    of_ros = ["--ros-args", *remappings, "--log-level", texts["log_level"]]
    asked = BringupOptions.from_mapping(values, "launch arguments")
    options = resolved(asked, "bringup", ["bringup", *of_ros, *in_namespace(namespace)])
    of_ros += options.remappings
    hears = environment(options.discovery)
    description = build_urdf(stack_arm(options, namespace))
    stack = [
        Node(
            package=PACKAGE,
            executable=process.name,
            namespace=namespace,
            output="screen",
            # As bring-up does: what launch makes of parameters would be for every node whose settings this one reads.
            arguments=[
                *(*of_ros, "--enclave", process.enclave, "--params-file", str(options.parameter_file)),
                *as_arguments(process.parameters),
            ],
            additional_env=hears,
            **({"sigterm_timeout": NEVER, "sigkill_timeout": NEVER} if process.lasts else {}),
            on_exit=EmitEvent(event=Shutdown(reason=f"{process.name} ended")) if process.essential else None,
        )
        for process in processes(options, namespace)
    ]
    own = [(topic, topic.removeprefix("/")) for topic in OWN]
    rviz = [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            namespace=namespace,
            additional_env=hears,
            arguments=of_ros,
            remappings=own,
            parameters=[{"robot_description": description, "use_sim_time": options.lockstep}],
            condition=IfCondition(RVIZ),
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            namespace=namespace,
            additional_env=hears,
            arguments=["--display-config", str(config_file("stack.rviz")), *of_ros],
            remappings=own,
            parameters=[{"use_sim_time": options.lockstep}],
            condition=IfCondition(RVIZ),
        ),
    ]
    # Whoever publishes the robot's description publishes its frames, too.
    return [*stack, *(rviz if options.robot == asked.robot else rviz[1:])]


def _value(text, entry):
    return text if entry.kind is str else parse_yaml(text)


def generate_launch_description():
    """Launch arguments and the nodes of the bring-up table."""
    of_options = {
        name: ("" if entry.is_open_list else str(entry.default), f"{entry.description} ({entry.accepts})")
        for name, entry in OPTIONS.items()
    }
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in {**of_options, **OF_LAUNCH}.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start_nodes)])
