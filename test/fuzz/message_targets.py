"""Fuzzing of ROS messages and requests as the nodes take them: any values a sender can put in."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, cast

import numpy as np
from data.analytic_scene import SphereInRoom, learnt_field, stored
from data.synthetic_frames import CAMERA, START_NS, depth_mm, plane_frame
from fuzz.map_targets import encoded_regions, use_region
from fuzz.mutation import Parts, mutated_json, mutated_parts
from fuzz.region_bytes import mutated_region
from fuzz.target import Target
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as NavPath
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

from meslam_core import se3
from meslam_core.camera import register_depth_to_color
from meslam_core.config import MeslamConfig
from meslam_core.errors import FrameError, MapError
from meslam_core.map import codec
from meslam_core.recordings.lens import Lens
from meslam_core.recordings.transforms import FrameTree
from meslam_core.regions.grid import RegionIndex as RegionIndexKey
from meslam_core.viewer.panel import status_html
from meslam_core.viewer.scene import Scene
from meslam_interfaces import srv
from meslam_interfaces.msg import RegionIndex, RegionModel, TrackingStatus
from meslam_ros.answers import Code, answering
from meslam_ros.call_service import fill, interface
from meslam_ros.conversions import (
    byte_array,
    camera_from_info,
    camera_to_info,
    color_image,
    color_message,
    depth_image,
    image_message,
    to_pose,
    to_stamp,
    to_transform,
)
from meslam_ros.given_map import GivenMap
from meslam_ros.live_scene import LiveScene
from meslam_ros.map_models import MapModels
from meslam_ros.map_requests import MapRequests
from meslam_ros.mesh_requests import MeshRequests
from meslam_ros.node_settings import MapServerSettings
from meslam_ros.odometry_messages import OdometryBuffer, estimate_at
from meslam_ros.region_messages import encoded_model, stored_region
from meslam_ros.served_map import ServedMap
from meslam_ros.store_requests import StoreRequests
from meslam_ros.transforms import CameraMount

MAX_CELLS = 2_000_000


def as_json(message: Any, without: tuple[str, ...] = ("data",)) -> bytes:
    """A message's fields, but for long ones that are a part of their own."""
    return json.dumps(_plain(message, without)).encode()


def _plain(value: Any, without: tuple[str, ...] = ()) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        names = value.get_fields_and_field_types()
        return {name: _plain(getattr(value, name)) for name in names if name not in without}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, str | bool | int | float):
        return value
    return [_plain(entry) for entry in value]


def filled(message: Any, text: bytes) -> Any:
    """A message with the values of a JSON text, as far as such a message can be sent at all."""
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        values = {}
    return _set_fields(message, values)


def _set_fields(message: Any, values: Any) -> Any:
    kinds = message.get_fields_and_field_types()
    for name, value in values.items() if isinstance(values, dict) else ():
        if name in kinds:
            try:
                sendable = _sendable(kinds[name], value)
                if kinds[name].endswith("]") and len(sendable) != len(getattr(message, name)):
                    continue
                setattr(message, name, sendable)
            except (AssertionError, TypeError, ValueError, OverflowError, AttributeError):
                continue
    return message


def _sendable(kind: str, value: Any) -> Any:
    """A value that fits a field's type, near the one wanted."""
    if kind.startswith("sequence<") or kind.endswith("]"):
        element = kind.removeprefix("sequence<").rstrip(">").partition("[")[0]
        entries = [_sendable(element, entry) for entry in value]
        numeric = "/" not in element and not element.startswith("string")
        return np.array(entries) if numeric and kind.endswith("]") else entries
    if "/" in kind:
        return _set_fields(interface(kind)(), value)
    if kind in ("float", "double"):
        return float(np.float32(value)) if kind == "float" else float(value)
    if kind == "boolean":
        return bool(value)
    if kind.startswith("string"):
        return str(value).encode("utf-8", "replace").decode()
    bits = int("".join(filter(str.isdigit, kind)) or 8)
    number = int(value) % (1 << bits)
    return number if kind.startswith(("uint", "octet")) else number - (number >> bits - 1 << bits)


def _image_seeds() -> list[Parts]:
    frame = plane_frame(0)
    stamp = to_stamp(START_NS)
    images = [color_message(frame.color, stamp, "camera")]
    images.append(image_message(depth_mm(frame), "16UC1", stamp, "camera"))
    images.append(image_message(frame.depth_m, "32FC1", stamp, "camera"))
    for encoding, channels in (("bgra8", 4), ("yuv422_yuy2", 2), ("mono8", 1)):
        pixels = np.zeros((*frame.color.shape[:2], channels), np.uint8)
        images.append(image_message(pixels, encoding, stamp, "camera"))
    return [{"fields.json": as_json(image), "data": bytes(image.data)} for image in images]


def _image(parts: Parts, folder: Path) -> str:
    message = filled(Image(), parts["fields.json"])
    message.data = byte_array(parts["data"])
    size = (message.height, message.width)
    try:
        pixels = color_image(message, "/color")
    except FrameError:
        depth_m = depth_image(message, "/depth")
        assert depth_m.shape == size
        assert np.isfinite(depth_m).all()
        assert (depth_m >= 0).all()
        return f"depth {message.encoding}"
    assert pixels.shape == (*size, 3)
    return f"colour {message.encoding}"


def _info_seeds() -> list[Parts]:
    message = camera_to_info(CAMERA, to_stamp(START_NS), "camera")
    seeds = [{"fields.json": as_json(message)}]
    for model, count in (("plumb_bob", 5), ("rational_polynomial", 8), ("equidistant", 4)):
        message.distortion_model, message.d = model, [0.01] * count
        seeds.append({"fields.json": as_json(message)})
    return seeds


def _info(parts: Parts, folder: Path) -> str:
    message = filled(CameraInfo(), parts["fields.json"])
    camera = camera_from_info(message, "/camera_info")
    lens = Lens(camera, message.distortion_model, message.d)
    if camera.width * camera.height < 10**6:
        depth_m = lens.undistort_depth(np.ones((camera.height, camera.width), np.float32))
        register_depth_to_color(depth_m, camera, CAMERA, np.eye(4))
        register_depth_to_color(np.ones((24, 32), np.float32), CAMERA, camera, np.eye(4))
    return f"{message.distortion_model} {len(message.d)}"


def _model_seeds() -> list[Parts]:
    seeds = []
    for data in encoded_regions():
        message = encoded_model(codec.decode(data), data, "map", "map")
        seeds.append({"fields.json": as_json(message), "data": data})
    return seeds


def _mutated_model(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    """Mostly with a checksum that fits, and half of the time with nothing but fields changed."""
    import hashlib

    other = rng.choice(others)
    data, fields = parts["data"], parts["fields.json"]
    if rng.random() < 0.5:
        data = mutated_region(data, other["data"], rng)
    else:
        fields = mutated_json(fields, other["fields.json"], rng)
    if rng.random() < 0.9:
        try:
            values = json.loads(fields) | {"sha256": hashlib.sha256(data).hexdigest()}
            fields = json.dumps(values).encode()
        except (ValueError, TypeError, RecursionError):
            pass
    return {"fields.json": fields, "data": data}


def _model_message(parts: Parts) -> RegionModel:
    message = filled(RegionModel(), parts["fields.json"])
    message.data = byte_array(parts["data"])
    return message


def _model(parts: Parts, folder: Path) -> str:
    message = _model_message(parts)
    models = MapModels(MeslamConfig(), "map")
    models.add(message)
    models.message(0.2)
    models.content()
    models.snapshot().map.occupancy(np.zeros((1, 3)))
    return use_region(stored_region(message))


def _given_seeds() -> list[Parts]:
    request = srv.UseMap.Request(mode=1, map_id="map", lattice_side_m=3.1, overlap=0.2)
    request.use_start_pose = True
    return [{"request.json": as_json(request, ("regions",)), **seed} for seed in _model_seeds()]


def _mutated_given(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    if rng.random() < 0.5:
        model = {name: parts[name] for name in ("fields.json", "data")}
        return parts | _mutated_model(model, others, rng)
    return mutated_parts({"request.json": parts["request.json"]}, others, rng) | {
        name: parts[name] for name in ("fields.json", "data")
    }


def _given(parts: Parts, folder: Path) -> str:
    request = filled(srv.UseMap.Request(), parts["request.json"])
    request.regions = [_model_message(parts)]
    given = GivenMap.of(request, MeslamConfig())
    assert given.T_map_base is None or np.isfinite(given.T_map_base).all()
    given.continuation.adapted(MeslamConfig())
    return str(given.continuation.train)


SHOWN = ("status.json", "pose.json", "path.json", "info.json")


def _shown_seeds() -> list[Parts]:
    pose = PoseStamped(pose=to_pose(se3.exp(np.array([0.1, 0.2, 0.0, 0.0, 0.0, 0.3]))))
    status = TrackingStatus(map_id="map", state=TrackingStatus.OK, training_regions=[RegionIndex()])
    messages = status, pose, NavPath(poses=[pose]), camera_to_info(CAMERA, to_stamp(START_NS), "c")
    texts = {name: as_json(each) for name, each in zip(SHOWN, messages, strict=True)}
    return [texts | seed for seed in _model_seeds()]


def _mutated_shown(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    model = {name: parts[name] for name in ("fields.json", "data")}
    texts = {name: parts[name] for name in SHOWN}
    if rng.random() < 0.5:
        return parts | _mutated_model(model, others, rng)
    return mutated_parts(texts, others, rng) | model


def _shown(parts: Parts, folder: Path) -> str:
    """What the live page makes of messages; one that is refused leaves the others shown."""
    scene, taken = Scene(), _Taken()
    live = LiveScene(scene, cast("Any", taken), lambda frame: None)
    live.take_status(filled(TrackingStatus(), parts["status.json"]))
    refused: list[str] = []
    for take, message in (
        (live.take_model, _model_message(parts)),
        (live.take_info, filled(CameraInfo(), parts["info.json"])),
        (live.take_pose, filled(PoseStamped(), parts["pose.json"])),
        (live.take_path, filled(NavPath(), parts["path.json"])),
    ):
        try:
            take(message)
        except (FrameError, MapError) as error:
            refused.append(str(error))
    live.notice_silence()
    assert all(refused)
    assert np.isfinite(scene.bounds).all()
    assert status_html(scene)
    return f"{scene.status.value.state} {taken.models} {len(refused)}"


class _Taken:
    """Counts the models that would be meshed."""

    models = 0

    def begin(self) -> None:
        pass

    def take(self, index: RegionIndexKey, version: int, data: bytes) -> None:
        self.models += 1


def _odometry_seeds() -> list[Parts]:
    message = Odometry(child_frame_id="base")
    message.header.frame_id = "odom"
    message.header.stamp = to_stamp(START_NS)
    message.pose.pose = to_pose(se3.exp(np.array([0.1, 0.2, 0.0, 0.0, 0.0, 0.3])))
    message.twist.covariance = (np.eye(6) * 1e-4).reshape(36)
    second = json.loads(as_json(message))
    second["header"]["stamp"]["nanosec"] += 50_000_000
    return [{"first.json": as_json(message), "second.json": json.dumps(second).encode()}]


def _odometry(parts: Parts, folder: Path) -> str:
    buffer = OdometryBuffer()
    mount = CameraMount("base", "camera", np.eye(4))
    for number, name in enumerate(("first.json", "second.json")):
        buffer.add(filled(Odometry(), parts[name]), number)
    found = []
    for stamp in (START_NS, START_NS + 20_000_000, START_NS + 50_000_000):
        estimate = estimate_at(stamp, buffer.wait(stamp, 0.0), mount)
        if estimate is not None and estimate.valid:
            assert np.isfinite(estimate.T_odom_camera).all()
            assert np.isfinite(estimate.covariance).all()
            assert (np.diag(estimate.covariance) >= 0.0).all()
        found.append("-" if estimate is None else str(estimate.valid))
    return " ".join(found)


def _transform_seeds() -> list[Parts]:
    pose = se3.exp(np.array([0.1, 0.2, 0.0, 0.0, 0.0, 0.3]))
    names = (("base", "mount"), ("mount", "camera"))
    transforms = [to_transform(pose, to_stamp(START_NS), *each) for each in names]
    return [{"fields.json": as_json(TFMessage(transforms=transforms))}]


def _transforms(parts: Parts, folder: Path) -> str:
    tree = FrameTree()
    tree.add(filled(TFMessage(), parts["fields.json"]))
    found = tree.lookup("base", "camera")
    if found is None:
        return "nothing"
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-6)
    return "found"


@cache
def _models() -> MapModels:
    models = MapModels(MeslamConfig(), "map")
    region = stored(learnt_field(), SphereInRoom())
    models.add(encoded_model(region, codec.encode(region), "map", "map"))
    return models


REQUESTS: dict[str, dict[str, Any]] = {
    "QueryOccupancy": {"points": [0.0, 0.0, 0.0, 1.0, 0.5, 0.2], "with_color": True},
    "GetOccupancyGrid": {"use_box": True, "resolution_m": 0.2, "box_max": {"x": 1.0, "y": 1.0}},
    "GetMesh": {"use_box": True, "resolution_m": 0.2, "box_max": {"x": 1.0, "y": 1.0, "z": 1.0}},
    "ExportMap": {"path": "a/mesh.ply", "resolution_m": 0.2},
    "SaveMap": {"name": "a/map", "overwrite": True},
    "LoadMap": {"name": "a/map", "use_start_pose": True},
    "ListRegions": {},
}


def _request_seeds() -> list[Parts]:
    seeds = []
    for kind, values in REQUESTS.items():
        request = fill(getattr(srv, kind).Request(), values)
        seeds.append({"request.json": as_json(request), "kind": kind.encode()})
    return seeds


def _mutated_request(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    same = [other for other in others if other["kind"] == parts["kind"]]
    text = mutated_json(parts["request.json"], rng.choice(same)["request.json"], rng)
    return {"request.json": text, "kind": parts["kind"]}


def _request(parts: Parts, folder: Path) -> str:
    """Whatever is asked, the answer has a code, a message, and nothing lands outside."""
    kind = getattr(srv, parts["kind"].decode())
    settings = MapServerSettings(
        map_folder=str(folder / "maps"),
        export_folder=str(folder / "exports"),
        max_cells=MAX_CELLS,
        max_points=1000,
    )
    served = ServedMap(_models(), settings, "map")
    no_frames = _refusing_lookup
    mapping, meshes = MapRequests(served, 0.2, no_frames), MeshRequests(served)
    stores = StoreRequests(served, lambda request: srv.UseMap.Response(result=Code.NOT_FOUND))
    handlers = {
        srv.QueryOccupancy: mapping.query_occupancy,
        srv.GetOccupancyGrid: mapping.get_occupancy_grid,
        srv.ListRegions: mapping.list_regions,
        srv.GetMesh: meshes.get_mesh,
        srv.ExportMap: meshes.export_map,
        srv.SaveMap: stores.save_map,
        srv.LoadMap: stores.load_map,
    }
    defects: list[str] = []
    if kind is srv.LoadMap:
        stores.save_map(srv.SaveMap.Request(name="a/map"), srv.SaveMap.Response())
    request = filled(kind.Request(), parts["request.json"])
    response = answering(handlers[kind], defects.append)(request, kind.Response())
    assert not defects, defects[0]
    assert response.message
    assert {path.name for path in folder.iterdir()} <= {"maps", "exports"}
    return f"{parts['kind'].decode()} {response.result}"


def _refusing_lookup(frame: str, stamp_ns: int) -> se3.Pose:
    raise FrameError(f"{frame!r} is not connected")


def _call(parts: Parts, folder: Path) -> str:
    """A request as `call_service` takes it: YAML to a message."""
    import yaml

    from meslam_ros.call_service import request_of

    kind = getattr(srv, parts["kind"].decode())
    request = request_of(kind, parts["request.yaml"].decode("utf-8", "surrogateescape"))
    yaml.safe_dump(_plain(request))
    return parts["kind"].decode()


def _call_seeds() -> list[Parts]:
    import yaml

    return [
        {"request.yaml": yaml.safe_dump(values).encode(), "kind": kind.encode()}
        for kind, values in REQUESTS.items()
    ]


def _mutated_call(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    text = {"request.yaml": parts["request.yaml"]}
    return mutated_parts(text, others, rng) | {"kind": parts["kind"]}


TARGETS = [
    Target("image message", "sensor_msgs/Image, colour and depth", _image_seeds, _image),
    Target("camera_info", "sensor_msgs/CameraInfo and its lens", _info_seeds, _info),
    Target("region message", "RegionModel to the served map", _model_seeds, _model, _mutated_model),
    Target("given map", "UseMap: a map to track in", _given_seeds, _given, _mutated_given),
    Target("shown messages", "what the live page shows", _shown_seeds, _shown, _mutated_shown),
    Target("odometry message", "nav_msgs/Odometry", _odometry_seeds, _odometry),
    Target("transforms", "tf2_msgs/TFMessage", _transform_seeds, _transforms),
    Target(
        "service requests", "all of the map server's", _request_seeds, _request, _mutated_request
    ),
    Target("call_service", "requests in YAML", _call_seeds, _call, _mutated_call),
]
