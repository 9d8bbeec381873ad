"""What the launch file starts, out of its arguments; knows nothing of `launch` itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from meslam_ros import topics
from meslam_ros.processes import ros_arguments

ParameterValue = bool | int | float | str

SYSTEM = ("odometry_node", "tracking_node", "region_manager_node", "map_server_node")
CAMERA_TOPICS = (topics.COLOR, topics.DEPTH, topics.COLOR_INFO, topics.DEPTH_INFO)
SHOWN = (
    topics.PATH,
    topics.POSE_WITH_COVARIANCE,
    topics.REGION_MARKERS,
    topics.MESH,
    topics.MAP_POINTS,
    topics.OCCUPANCY_GRID,
    topics.COLOR,
)


@dataclass(frozen=True)
class LaunchArgument:
    """One argument of the launch file; `choices` is empty where anything goes."""

    default: str
    meaning: str
    choices: tuple[str, ...] = ()


FLAG = ("true", "false")
ARGUMENTS = {
    "recording": LaunchArgument("", "recording to play, in any format that `meslam info` reads"),
    "rate": LaunchArgument("1.0", "speed of playback; 0 waits for every frame to be tracked"),
    "loop": LaunchArgument("false", "play the recording again and again", FLAG),
    "camera": LaunchArgument(
        "none",
        "camera driver to start too: realsense2_camera, or the one of this package; none where "
        "it runs already, or a recording is played",
        ("none", "realsense2", "meslam"),
    ),
    "camera_namespace": LaunchArgument("camera", "of the camera's topics, as in rs_launch.py"),
    "camera_name": LaunchArgument("camera", "of the camera, as in rs_launch.py"),
    "serial_no": LaunchArgument("", "serial number of the camera to start; empty for the first"),
    "profile": LaunchArgument("640x480x15", "size and rate of the images of the camera to start"),
    "base_frame": LaunchArgument(
        "",
        "the robot's frame, which /tf_static must connect to the camera; empty for the camera's "
        "own link",
    ),
    "odometry_topic": LaunchArgument(
        "", "nav_msgs/Odometry from elsewhere, such as wheels, instead of the odometry node"
    ),
    "viewer": LaunchArgument("false", "serve a page in the browser that shows the map", FLAG),
    "viewer_host": LaunchArgument(
        "127.0.0.1", "address of the page; 0.0.0.0 for the network too, which then sees the map"
    ),
    "viewer_port": LaunchArgument("8080", "port of the page; the next free one if it is taken"),
    "rviz": LaunchArgument("false", "start RViz with the system's layout", FLAG),
    "namespace": LaunchArgument("", "of all nodes, for several systems side by side"),
    "params_file": LaunchArgument("", "parameters of all nodes; empty for the defaults"),
    "export_folder": LaunchArgument("meslam_exports", "export_map writes below it"),
    "map_folder": LaunchArgument("meslam_maps", "save_map and load_map use it"),
    "map": LaunchArgument("", "stored map below map_folder to start with"),
    "map_mode": LaunchArgument(
        "view",
        "what that map is for: to be served, until tracking has one of its own; or for tracking "
        "too, which trains it further, or only finds its poses in it",
        ("view", "continue", "localise"),
    ),
    "use_sim_time": LaunchArgument("false", "take the time from /clock", FLAG),
}


@dataclass(frozen=True)
class NodePlan:
    """One node to start; `essential` ones are started again when they crash."""

    package: str
    executable: str
    name: str
    namespace: str = ""
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    remappings: tuple[tuple[str, str], ...] = ()
    arguments: tuple[str, ...] = ()
    params_file: str = ""
    essential: bool = False

    @property
    def ros_arguments(self) -> list[str]:
        """What says the same on the node's command line."""
        extra = ["-r", f"__node:={self.name}"]
        if self.namespace:
            extra += ["-r", f"__ns:=/{self.namespace.strip('/')}"]
        if self.params_file:
            extra += ["--params-file", self.params_file]
        for origin, target in self.remappings:
            extra += ["-r", f"{origin}:={target}"]
        return [*self.arguments, *ros_arguments(self.parameters, extra)]


def plan(given: Mapping[str, str], share: Path) -> list[NodePlan]:
    """The nodes that a set of launch arguments asks for.

    Args:
        given: values by the names of `ARGUMENTS`; what is missing has its default.
        share: folder `share/meslam_ros` of the installation.

    Raises:
        ValueError: for a value that is none of an argument's choices, or two that contradict.
    """
    values = {name: given.get(name, argument.default) for name, argument in ARGUMENTS.items()}
    for name, argument in ARGUMENTS.items():
        if argument.choices and values[name] not in argument.choices:
            raise ValueError(
                f"{name}:={values[name]}: expected one of {', '.join(argument.choices)}"
            )
    if values["recording"] and values["camera"] != "none":
        raise ValueError(
            f"recording:={values['recording']} and camera:={values['camera']} would send the same "
            "images; give one of them"
        )
    return [
        *_system(values, share),
        *_player(values),
        *_camera(values),
        *_viewer(values),
        *_rviz(values, share),
    ]


def _system(values: Mapping[str, str], share: Path) -> list[NodePlan]:
    parameters = {
        "use_sim_time": _flag(values, "use_sim_time"),
        "base_frame": _base_frame(values),
        "export_folder": values["export_folder"],
        "map_folder": values["map_folder"],
        "map": values["map"],
        "map_mode": values["map_mode"],
        "odometry_topic": values["odometry_topic"],
    }
    return [
        NodePlan(
            package="meslam_ros",
            executable=name,
            name=name,
            namespace=values["namespace"],
            parameters=parameters,
            remappings=_camera_remappings(values),
            params_file=values["params_file"] or str(share / "config" / "meslam.yaml"),
            essential=True,
        )
        for name in SYSTEM
        if name != "odometry_node" or not values["odometry_topic"]
    ]


def _player(values: Mapping[str, str]) -> list[NodePlan]:
    if not values["recording"]:
        return []
    return [
        NodePlan(
            package="meslam_ros",
            executable="bag_player_node",
            name="bag_player_node",
            namespace=values["namespace"],
            parameters={
                "recording": values["recording"],
                "rate": float(values["rate"]),
                "loop": _flag(values, "loop"),
                "base_frame": _base_frame(values),
                "optical_frame": f"{values['camera_name']}_color_optical_frame",
                # The tracking, and the odometry where it runs.
                "subscribers": 1 if values["odometry_topic"] else 2,
            },
            remappings=_camera_remappings(values),
        )
    ]


def _camera(values: Mapping[str, str]) -> list[NodePlan]:
    common = {"camera_name": values["camera_name"], "serial_no": values["serial_no"]}
    if values["camera"] == "meslam":
        return [
            NodePlan(
                package="meslam_ros",
                executable="camera_node",
                name="camera_node",
                namespace=values["namespace"],
                parameters=common
                | {"color_profile": values["profile"], "depth_profile": values["profile"]},
                remappings=_camera_remappings(values),
                essential=True,
            )
        ]
    if values["camera"] == "realsense2":
        return [
            NodePlan(
                package="realsense2_camera",
                executable="realsense2_camera_node",
                name=values["camera_name"],
                namespace=_join(values["namespace"], values["camera_namespace"]),
                parameters=common
                | {
                    "align_depth.enable": True,
                    "enable_sync": True,
                    "rgb_camera.color_profile": values["profile"],
                    "depth_module.depth_profile": values["profile"],
                },
                essential=True,
            )
        ]
    return []


def _viewer(values: Mapping[str, str]) -> list[NodePlan]:
    if not _flag(values, "viewer"):
        return []
    return [
        NodePlan(
            package="meslam_ros",
            executable="viewer_node",
            name="viewer_node",
            namespace=values["namespace"],
            parameters={
                "base_frame": _base_frame(values),
                "host": values["viewer_host"],
                "port": int(values["viewer_port"]),
            },
            remappings=_camera_remappings(values),
        )
    ]


def _rviz(values: Mapping[str, str], share: Path) -> list[NodePlan]:
    if not _flag(values, "rviz"):
        return []
    # The layout names its topics absolutely, as RViz saves them.
    moved = dict(_camera_remappings(values))
    remappings = {
        f"/{topic}": f"/{_join(values['namespace'], moved.get(topic, topic))}" for topic in SHOWN
    }
    return [
        NodePlan(
            package="rviz2",
            executable="rviz2",
            name="rviz2",
            # A recording's transforms are old by the computer's own clock.
            parameters={"use_sim_time": bool(values["recording"]) or _flag(values, "use_sim_time")},
            remappings=tuple((old, new) for old, new in remappings.items() if old != new),
            arguments=("-d", str(share / "config" / "meslam.rviz")),
        )
    ]


def _flag(values: Mapping[str, str], name: str) -> bool:
    return values[name] == "true"


def _base_frame(values: Mapping[str, str]) -> str:
    return values["base_frame"] or f"{values['camera_name']}_link"


def _camera_remappings(values: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """From the default camera's topics to those of the named one."""
    default = _join(ARGUMENTS["camera_namespace"].default, ARGUMENTS["camera_name"].default)
    camera = _join(values["camera_namespace"], values["camera_name"])
    if camera == default:
        return ()
    return tuple((topic, camera + topic.removeprefix(default)) for topic in CAMERA_TOPICS)


def _join(*names: str) -> str:
    return "/".join(name.strip("/") for name in names if name.strip("/"))
