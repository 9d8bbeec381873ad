"""All nodes in their own processes, a recording played into them, and what came out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from meslam_core.trajectory import Trajectory
from meslam_interfaces.msg import RegionArray, TrackingStatus
from meslam_interfaces.srv import ExportMap, ListRegions, SaveMap
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import stamp_ns
from meslam_ros.processes import NodeProcess, ros_arguments

STARTING_S = 90.0
PLAYING_S = 200.0
FINAL_S = 60.0
NODES = ("odometry_node", "tracking_node", "region_manager_node", "map_server_node")
HEARD = (topics.POSE, topics.STATUS, topics.REGIONS)
BASE_FRAME, OPTICAL_FRAME = "camera_link", "camera_color_optical_frame"


@dataclass(frozen=True)
class LiveRun:
    """What a run left behind.

    Attributes:
        online, refined: T_map_camera as published live, and as the last path knows it.
        statuses: of every frame.
        regions: of /meslam/regions at the end.
        folder: that the map server wrote to.
        export, saved: its answers.
        logs: of the nodes.
    """

    online: Trajectory
    refined: Trajectory
    statuses: list[TrackingStatus]
    regions: RegionArray
    folder: Path
    export: ExportMap.Response
    saved: SaveMap.Response
    logs: str


def run_live(
    recording: Path,
    folder: Path,
    *,
    use: Callable[[MeslamClient], None] = lambda client: None,
    resolution_m: float = 0.03,
    **parameters: object,
) -> LiveRun:
    """Play a recording as fast as every frame can be tracked, export and save the map.

    Args:
        recording: to play.
        folder: for exports, maps and logs.
        use: called with the running system when the recording has ended.
        resolution_m: of the mesh [m].
        parameters: of all nodes.
    """
    given = {"export_folder": folder, "map_folder": folder, **parameters}
    nodes = [NodeProcess(name, ros_arguments(given), log=folder / f"{name}.log") for name in NODES]
    # One pair at a time: nothing that is measured depends on how fast the machine is.
    playing = {
        "recording": recording,
        "rate": 0.0,
        "window": 1,
        "subscribers": 2,
        "wait_timeout_s": STARTING_S,
    }
    processes = list(nodes)
    try:
        with MeslamClient("system_test") as client:
            # Nobody repeats a pose: the listener must be known before the first image comes.
            assert client.spin_until(lambda: _publishers(client) == len(HEARD), STARTING_S), _logs(
                nodes
            )
            player = NodeProcess(
                "bag_player_node", ros_arguments(playing), log=folder / "bag_player_node.log"
            )
            processes.append(player)
            assert client.spin_until(lambda: player.status is not None, STARTING_S + PLAYING_S), (
                _logs([*nodes, player])
            )
            assert player.status == 0, _logs([*nodes, player])
            last_ns = client.last_stamp_ns

            def final() -> bool:
                listed = client.call(ListRegions, topics.LIST_REGIONS)
                heard = client.regions
                arrived = heard is not None and stamp_ns(heard.header.stamp) >= last_ns
                arrived = arrived and stamp_ns(listed.regions.header.stamp) >= last_ns
                return arrived and client.settled and client.path_stamp_ns >= last_ns

            assert client.spin_until(final, FINAL_S), _logs(nodes)
            use(client)
            request = ExportMap.Request(path="mesh.ply", resolution_m=resolution_m)
            export = client.call(ExportMap, topics.EXPORT_MAP, request)
            saved = client.call(SaveMap, topics.SAVE_MAP, SaveMap.Request(name="map.meslam"))
            T_base_camera = client.mount(BASE_FRAME, OPTICAL_FRAME)
            assert T_base_camera is not None
            assert client.regions is not None
            statuses = [node.stop() for node in nodes]
            assert statuses == [0] * len(nodes), _logs(nodes)
            return LiveRun(
                online=client.online_trajectory(T_base_camera),
                refined=client.refined_trajectory(T_base_camera),
                statuses=client.statuses,
                regions=client.regions,
                folder=folder,
                export=export,
                saved=saved,
                logs=_logs(nodes),
            )
    finally:
        for process in processes:
            process.stop()


def _publishers(client: MeslamClient) -> int:
    """How many of the topics that the client hears have a publisher."""
    names = [client.node.resolve_topic_name(name) for name in HEARD]
    return sum(client.node.count_publishers(name) > 0 for name in names)


def _logs(processes: list[NodeProcess]) -> str:
    return "\n".join(f"--- {process.name}\n{process.output()}" for process in processes)
