"""Starts the nodes; with `recording:=PATH` also plays a recording into them.

ros2 launch meslam_ros meslam.launch.py                      live, with realsense2_camera's topics
ros2 launch meslam_ros meslam.launch.py recording:=room.mcap rviz:=true
"""

from __future__ import annotations

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import (
    EqualsSubstitution,
    IfElseSubstitution,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node

SHARE = get_package_share_directory("meslam_ros")
NODES = ("odometry_node", "tracking_node", "region_manager_node", "map_server_node")
ARGUMENTS = {
    "recording": ("", "recording to play, in any format; empty for a live camera"),
    "rate": ("1.0", "speed of playback; 0 waits for every frame"),
    "rviz": ("false", "start RViz with the system's layout"),
    "base_frame": ("camera_link", "the robot's frame; /tf_static must connect it to the camera"),
    "camera": ("camera/camera", "namespace and name of the camera, as realsense2_camera has them"),
    "params_file": (os.path.join(SHARE, "config", "meslam.yaml"), "parameters of all nodes"),
    "export_folder": ("meslam_exports", "export_map writes below it"),
    "map_folder": ("meslam_maps", "save_map and load_map use it"),
    "odometry_topic": (
        "",
        "nav_msgs/Odometry from elsewhere, such as wheels, instead of the odometry node",
    ),
    "use_sim_time": ("false", "take the time from /clock"),
}
IMAGE_TOPICS = (
    "color/image_raw",
    "color/camera_info",
    "aligned_depth_to_color/image_raw",
    "aligned_depth_to_color/camera_info",
)


def generate_launch_description() -> LaunchDescription:
    """The nodes, and on request a player and RViz."""
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    remappings = [
        (f"camera/camera/{topic}", PathJoinSubstitution([given["camera"], topic]))
        for topic in IMAGE_TOPICS
    ]
    common = {"use_sim_time": given["use_sim_time"]}
    parameters = {
        **common,
        "base_frame": given["base_frame"],
        "export_folder": given["export_folder"],
        "map_folder": given["map_folder"],
        "odometry_topic": given["odometry_topic"],
    }
    own_odometry = IfCondition(EqualsSubstitution(given["odometry_topic"], ""))
    nodes = [
        Node(
            package="meslam_ros",
            executable=name,
            name=name,
            parameters=[given["params_file"], parameters],
            remappings=remappings,
            output="screen",
            condition=own_odometry if name == "odometry_node" else None,
        )
        for name in NODES
    ]
    player = Node(
        package="meslam_ros",
        executable="bag_player_node",
        name="bag_player_node",
        parameters=[
            {
                "recording": given["recording"],
                "rate": given["rate"],
                "base_frame": given["base_frame"],
                # The tracking, and the odometry where it runs.
                "subscribers": IfElseSubstitution(
                    EqualsSubstitution(given["odometry_topic"], ""), "2", "1"
                ),
            }
        ],
        remappings=remappings,
        output="screen",
        condition=IfCondition(NotEqualsSubstitution(given["recording"], "")),
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", os.path.join(SHARE, "config", "meslam.rviz")],
        parameters=[common],
        condition=IfCondition(given["rviz"]),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=meaning)
        for name, (default, meaning) in ARGUMENTS.items()
    ]
    # Images need a larger shared-memory segment than Fast DDS gives; a profile of the user's stays.
    profile = os.environ.get(
        "FASTRTPS_DEFAULT_PROFILES_FILE", os.path.join(SHARE, "config", "fastdds.xml")
    )
    environment = SetEnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", profile)
    return LaunchDescription([*declared, environment, *nodes, player, rviz])
