"""Starts the nodes, and on request a camera, a player and RViz.

ros2 launch meslam_ros meslam.launch.py                          a camera that runs already
ros2 launch meslam_ros meslam.launch.py camera:=realsense2       and starts it
ros2 launch meslam_ros meslam.launch.py recording:=room.mcap rviz:=true
ros2 launch meslam_ros meslam.launch.py --show-args              all arguments
"""

from __future__ import annotations

import os
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from meslam_ros.launch_plan import ARGUMENTS, NodePlan, plan

SHARE = Path(get_package_share_directory("meslam_ros"))
MAX_RESTARTS = 3


def node(planned: NodePlan) -> Node:
    """The action that starts a node."""
    parameters = {
        # A serial number stays a text.
        name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for name, value in planned.parameters.items()
    }
    return Node(
        package=planned.package,
        executable=planned.executable,
        name=planned.name,
        namespace=planned.namespace,
        parameters=[*filter(None, [planned.params_file]), parameters],
        remappings=list(planned.remappings),
        arguments=list(planned.arguments),
        output="screen",
        respawn=planned.essential,
        respawn_delay=1.0,
        respawn_max_retries=MAX_RESTARTS,
    )


def nodes(context: LaunchContext) -> list[Node]:
    """The nodes that the arguments ask for."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    return [node(planned) for planned in plan(given, SHARE)]


def generate_launch_description() -> LaunchDescription:
    """The arguments, the environment and the nodes."""
    declared = [
        DeclareLaunchArgument(
            name,
            default_value=argument.default,
            description=argument.meaning,
            choices=list(argument.choices) or None,
        )
        for name, argument in ARGUMENTS.items()
    ]
    # Images need a larger shared-memory segment than Fast DDS gives; a profile of the user's stays.
    profile = os.environ.get(
        "FASTRTPS_DEFAULT_PROFILES_FILE", str(SHARE / "config" / "fastdds.xml")
    )
    environment = SetEnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", profile)
    return LaunchDescription([*declared, environment, OpaqueFunction(function=nodes)])
