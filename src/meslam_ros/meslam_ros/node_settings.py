"""What the nodes can be told beyond the method's own configuration; defaults stand only here.

The objects follow their parameters: who needs a number reads it when it is needed. The `live` ones
change at any time, the others only before a node is configured.
"""

from __future__ import annotations

from dataclasses import dataclass

from meslam_core.setting import setting


@dataclass
class MapFrameSettings:
    """The one frame that a map needs."""

    map_frame: str = setting("map", "frame that the map and /meslam/pose are given in")


@dataclass
class FrameSettings(MapFrameSettings):
    """Coordinate frames (REP-105)."""

    odom_frame: str = setting("odom", "frame of the odometry, between the map and the base")
    base_frame: str = setting(
        "camera_link",
        "frame of the robot; must be connected to the image's optical frame through /tf_static, "
        "else the optical frame itself is the base; empty takes the optical frame",
    )
    transform_timeout_s: float = setting(
        2.0,
        "how long to wait for /tf_static to connect base and optical frame",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )


@dataclass
class InputSettings:
    """Images and how they wait."""

    sync_tolerance_s: float = setting(
        0.02,
        "colour and depth images whose stamps differ by more are no pair",
        unit="s",
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    input_timeout_s: float = setting(
        3.0,
        "without images for this long, the node says what it waits for",
        unit="s",
        minimum=0.5,
        maximum=3600.0,
        live=True,
    )
    overload_share: float = setting(
        0.2,
        "when this share of the image pairs of the last 5 s was skipped for lack of time, the "
        "computer counts as overloaded: /meslam/status says DEGRADED, /diagnostics warns; 1 never",
        minimum=0.01,
        maximum=1.0,
        live=True,
    )
    max_wait_s: float = setting(
        1.0,
        "while the computer is overloaded, an image pair that has waited longer is skipped for a "
        "newer one, so that poses are not late besides",
        unit="s",
        minimum=0.0,
        maximum=60.0,
        live=True,
    )


@dataclass
class OdometrySettings:
    """Parameters of the odometry node alone."""

    odometry_queue_size: int = setting(
        3,
        "image pairs that may wait for odometry; few, for odometry that comes late is of no use: "
        "tracking interpolates between what comes in time",
        minimum=1,
        maximum=1000,
        live=True,
    )


@dataclass
class TrackingSettings:
    """Parameters of the tracking node alone."""

    queue_size: int = setting(
        30,
        "image pairs that may wait for tracking; beyond, the oldest is dropped and counted",
        minimum=1,
        maximum=1000,
        live=True,
    )
    odometry_topic: str = setting(
        "",
        "nav_msgs/Odometry from elsewhere (wheels, a tracking camera) instead of the odometry "
        "node, which then is not needed; /tf_static must connect its child frame to the camera, "
        "and `odometry.given_*` say how far it errs; empty takes the odometry node's",
    )
    odometry_timeout_s: float = setting(
        2.0,
        "how long an image pair waits for its odometry before it is tracked without",
        unit="s",
        minimum=0.0,
        maximum=10.0,
        live=True,
    )
    give_way: bool = setting(
        True,
        "while image pairs wait, training of the map ends after mapping.min_iterations steps",
        live=True,
    )
    transform_rate_hz: float = setting(
        20.0,
        "how often the transform from map to odometry is sent again",
        unit="Hz",
        minimum=1.0,
        maximum=200.0,
        live=True,
    )
    model_period_s: float = setting(
        1.0,
        "a region that changes is published at most once in this time",
        unit="s",
        minimum=0.1,
        maximum=60.0,
        live=True,
    )
    path_period_s: float = setting(
        1.0,
        "the refined path is published at most once in this time",
        unit="s",
        minimum=0.1,
        maximum=60.0,
        live=True,
    )
    idle_s: float = setting(
        1.0,
        "when no image has come for this long, the final regions and path are published",
        unit="s",
        minimum=0.1,
        maximum=60.0,
        live=True,
    )
    seed: int = setting(0, "of every random choice", minimum=0, maximum=2**31 - 1)


@dataclass
class RegionManagerSettings:
    """Parameters of the region manager alone."""

    regions_period_s: float = setting(
        0.5,
        "regions that grow are published at most once in this time; other changes at once",
        unit="s",
        minimum=0.05,
        maximum=60.0,
        live=True,
    )


@dataclass
class MapServerSettings:
    """Parameters of the map server alone; the limits bound what one request may cost."""

    export_folder: str = setting(
        "meslam_exports", "export_map writes only below this folder; it is made when needed"
    )
    map_folder: str = setting(
        "meslam_maps", "save_map and load_map use only folders below this one"
    )
    kept_maps: int = setting(
        5,
        "so many maps are kept below map_folder/recent without being asked, the one that is "
        "served and those before it; 0 keeps none",
        minimum=0,
        maximum=1000,
        live=True,
    )
    keep_period_s: float = setting(
        5.0,
        "the map that is served is written there at most once in this time, and when it ends",
        unit="s",
        minimum=0.1,
        maximum=3600.0,
        live=True,
    )
    restore: bool = setting(
        True,
        "at start, serve the map that was kept last until tracking publishes regions",
    )
    map: str = setting(
        "", "stored map below map_folder to start with, instead of the one that was kept last"
    )
    map_mode: str = setting(
        "view",
        "what it is for: the map server alone (view), tracking too, which trains it further "
        "(continue) or only finds its poses in it (localise)",
        choices=("view", "continue", "localise"),
    )
    map_start_pose: str = setting(
        "",
        "where the base is in it when tracking begins, 'x y z qx qy qz qw', metres; empty for "
        "the map's origin, where mapping it began",
    )
    mesh_topic_resolution_m: float = setting(
        0.05,
        "spacing of the mesh on the topic",
        unit="m",
        minimum=0.01,
        maximum=1.0,
        live=True,
    )
    mesh_topic_period_s: float = setting(
        5.0,
        "a region's mesh on the topic is renewed at most once in this time; 0 switches it off",
        unit="s",
        minimum=0.0,
        maximum=3600.0,
        live=True,
    )
    points_topic_spacing_m: float = setting(
        0.05,
        "spacing of the points on the topic",
        unit="m",
        minimum=0.01,
        maximum=1.0,
        live=True,
    )
    min_resolution_m: float = setting(
        0.005,
        "finer meshes and grids are refused",
        unit="m",
        minimum=0.001,
        maximum=1.0,
        live=True,
    )
    max_resolution_m: float = setting(
        0.5,
        "coarser meshes and grids are refused",
        unit="m",
        minimum=0.01,
        maximum=10.0,
        live=True,
    )
    max_points: int = setting(
        2_000_000,
        "more points in one query are refused",
        minimum=1,
        maximum=100_000_000,
        live=True,
    )
    max_cells: int = setting(
        400_000_000,
        "meshes and grids over more cells than this are refused",
        minimum=1000,
        maximum=100_000_000_000,
        live=True,
    )
    max_map_mb: int = setting(
        4000,
        "region models with which the map would take more memory are refused",
        unit="MB",
        minimum=1,
        maximum=1_000_000,
        live=True,
    )
    grid_resolution_m: float = setting(
        0.05,
        "cell of the occupancy grid by default",
        unit="m",
        minimum=0.01,
        maximum=1.0,
        live=True,
    )
    grid_min_height_m: float = setting(
        -0.8,
        "bottom of the layer that obstructs, map frame, by default",
        unit="m",
        minimum=-1000.0,
        maximum=1000.0,
        live=True,
    )
    grid_max_height_m: float = setting(
        0.8,
        "top of the layer that obstructs, map frame, by default",
        unit="m",
        minimum=-1000.0,
        maximum=1000.0,
        live=True,
    )


@dataclass
class PlayerSettings:
    """Parameters of the bag player."""

    recording: str = setting("", "path of the recording; any format that `meslam info` reads")
    rate: float = setting(
        1.0,
        "speed of playback; 0 sends an image pair when /meslam/status has answered earlier ones, "
        "so that nothing is dropped however slow the computer is",
        minimum=0.0,
        maximum=100.0,
        live=True,
    )
    window: int = setting(
        1,
        "with rate 0: image pairs that may be under way; with more than one, pairs wait at the "
        "tracking node, and training gives way to them unless give_way is off",
        minimum=1,
        maximum=30,
    )
    start: float = setting(
        0.0, "where in the recording to start", unit="s", minimum=0.0, maximum=1e6
    )
    frames: int = setting(
        0, "how many image pairs to play, 0 for all", minimum=0, maximum=2**31 - 1
    )
    step: int = setting(1, "play every n-th image pair", minimum=1, maximum=1000)
    loop: bool = setting(False, "start again at the end", live=True)
    clock: bool = setting(True, "publish the images' time on /clock")
    subscribers: int = setting(
        2,
        "wait for so many subscribers on each image topic before the first image: the odometry and "
        "the tracking; 1 where odometry comes from elsewhere; 0 does not wait",
        minimum=0,
        maximum=100,
    )
    wait_timeout_s: float = setting(
        60.0,
        "give up when subscribers, or with rate 0 an answer, do not come within this time",
        unit="s",
        minimum=0.1,
        maximum=3600.0,
    )
    depth_encoding: str = setting(
        "16UC1",
        "of the depth images: millimetres as a D435 sends, or metres",
        choices=("16UC1", "32FC1"),
    )
    base_frame: str = setting(
        "camera_link", "parent of the optical frame on /tf_static; empty sends no transform"
    )
    optical_frame: str = setting("camera_color_optical_frame", "frame of the images")


@dataclass
class CameraSettings:
    """Parameters of the camera node."""

    serial_no: str = setting("", "serial number of the camera; empty takes the first one found")
    camera_name: str = setting(
        "camera", "the frames are named after it: camera_link, camera_color_optical_frame, ..."
    )
    color_profile: str = setting("640x480x15", "width, height and rate of colour images")
    depth_profile: str = setting(
        "640x480x15",
        "width, height and rate of depth images, which are then aligned to colour",
    )
    auto_exposure: bool = setting(
        True, "of both sensors; without it they keep their exposure", live=True
    )
    color_exposure: int = setting(
        0,
        "exposure of colour without auto_exposure, in librealsense's unit (100 us on a D435); "
        "limited to what the camera takes; 0 keeps its own",
        minimum=0,
        maximum=10_000,
        live=True,
    )
    emitter: bool = setting(
        True, "project infrared dots, so that bare walls have depth too", live=True
    )
    publish_tf: bool = setting(
        True,
        "send the camera's frames on /tf_static; false where a robot description sends them",
    )
    silence_timeout_s: float = setting(
        3.0,
        "without images for this long, the camera counts as lost and is opened again",
        unit="s",
        minimum=0.5,
        maximum=60.0,
        live=True,
    )
