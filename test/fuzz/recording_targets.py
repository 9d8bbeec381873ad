"""Fuzzing of recordings: images, folders of images, bags of every storage, librealsense's files."""

from __future__ import annotations

import json
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random

import cv2
import numpy as np
from data.bag_builder import BagBuilder, Storage, aligned_bag
from data.image_folders import write_folder, write_tum
from data.memory_recording import MemoryRecording
from data.synthetic_frames import CAMERA, START_NS, depth_mm, plane_frame, plane_frames
from fuzz.mutation import Parts, mutated_bytes, mutated_parts
from fuzz.target import Target
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer

from meslam_core.recordings import convert, describe, open_recording
from meslam_core.recordings.images import decode_color, decode_depth

FRAMES = 3
PNG_SIGNATURE_BYTES = 8


def files_below(folder: Path) -> Parts:
    """A folder's files by their names in it."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def _put(parts: Parts, folder: Path) -> Path:
    """Write the files of an input; a name that has no file any more is left out."""
    for name, data in parts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def use_recording(path: Path) -> str:
    """Read every frame of a recording."""
    recording = open_recording(path)
    try:
        count = 0
        for frame in recording.frames():
            assert np.isfinite(frame.depth_m).all()
            assert (frame.depth_m >= 0).all()
            count += 1
        json.dumps(describe(recording), allow_nan=False)
        return f"{recording.format} {count}"
    finally:
        recording.close()


def _encoded(suffix: str, pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(suffix, pixels)[1])


def _color_seeds() -> list[Parts]:
    color = plane_frame(0).color
    suffixes = (".png", ".jpg", ".bmp", ".ppm", ".tiff")
    return [{"image": _encoded(suffix, color)} for suffix in suffixes]


def _depth_seeds() -> list[Parts]:
    units = depth_mm(plane_frame(0))
    metres = units.astype(np.float32) * np.float32(0.001)
    images = [_encoded(".png", units), _encoded(".tiff", metres), _encoded(".pgm", units)]
    return [{"image": image} for image in images]


def _color(parts: Parts, folder: Path) -> str:
    pixels = decode_color(parts["image"])
    assert pixels.dtype == np.uint8
    assert pixels.ndim == 3
    assert pixels.shape[2] == 3
    return str(pixels.shape)


def _depth(parts: Parts, folder: Path) -> str:
    pixels = decode_depth(parts["image"])
    assert pixels.ndim == 2
    return f"{pixels.dtype} {pixels.shape}"


def _mutated_images(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    """Half of the damaged PNG files have right checksums again, so that their content is read."""
    result = mutated_parts(parts, others, rng)
    return {
        name: _with_checksums(data) if rng.random() < 0.5 else data for name, data in result.items()
    }


def _with_checksums(data: bytes) -> bytes:
    """A PNG file whose chunks have right checksums."""
    if not data.startswith(b"\x89PNG"):
        return data
    result, place = data[:PNG_SIGNATURE_BYTES], PNG_SIGNATURE_BYTES
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        chunk = data[place + 4 : place + 8 + length]
        result += struct.pack(">I", length) + chunk + struct.pack(">I", zlib.crc32(chunk))
        place += 12 + length
    return result + data[place:]


def _folder_seeds(write: Callable[[Path, list], Path]) -> list[Parts]:
    with tempfile.TemporaryDirectory() as folder:
        return [files_below(write(Path(folder) / "room", plane_frames(FRAMES)))]


def _tum_folder(folder: Path, frames: list) -> Path:
    path = write_tum(folder, frames)
    (path / "camera.json").write_text(json.dumps(CAMERA.to_dict()))
    return path


def _without_files(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    """Damage in the files, or one of them missing."""
    result = _mutated_images(parts, others, rng)
    if rng.random() < 0.1 and len(result) > 1:
        del result[rng.choice(sorted(result))]
    return result


def _bag_seeds(storage: Storage) -> list[Parts]:
    with tempfile.TemporaryDirectory() as folder:
        path = aligned_bag(plane_frames(FRAMES), Path(folder), storage)
        if path.is_dir():
            return [files_below(path)]
        seeds = [{path.name: path.read_bytes()}]
        if storage == "mcap":
            # As `meslam convert` writes it: compressed, with checksums.
            path.unlink()
            convert(MemoryRecording(plane_frames(FRAMES)), path)
            seeds.append({path.name: path.read_bytes()})
        return seeds


def _bag_file(parts: Parts, folder: Path) -> str:
    (name,) = parts
    return use_recording(_put(parts, folder) / name)


def _message_seeds() -> list[Parts]:
    """Serialised messages; a part's name holds its place, topic and type."""
    seeds = []
    for kind in ("raw", "compressed", "unregistered"):
        builder = BagBuilder()
        frame = plane_frame(0)
        if kind == "raw":
            builder.aligned_frame(frame)
        elif kind == "compressed":
            _add_compressed(builder)
        else:
            _add_unregistered(builder)
        seeds.append(
            {
                f"{number:02d} {topic} {name}": bytes(builder.store.serialize_cdr(message, name))
                for number, (_, topic, name, message) in enumerate(builder.messages)
            }
        )
    return seeds


def _add_compressed(builder: BagBuilder) -> None:
    frame = plane_frame(0)
    name = "/camera/camera/{}"
    builder.camera_info(name.format("color/camera_info"), START_NS, CAMERA)
    builder.compressed(
        name.format("color/image_raw/compressed"),
        START_NS,
        "rgb8; jpeg compressed bgr8",
        _encoded(".jpg", frame.color),
    )
    topic = name.format("aligned_depth_to_color/image_raw/compressedDepth")
    data = struct.pack("<iff", 0, 100.0, 0.5) + _encoded(".png", depth_mm(frame))
    builder.compressed(topic, START_NS, "32FC1; compressedDepth png", data)


def _add_unregistered(builder: BagBuilder) -> None:
    frame = plane_frame(0)
    builder.camera_info("/a/color/camera_info", START_NS, CAMERA, "color", d=(0.1, 0, 0, 0, 0))
    builder.camera_info("/a/depth/camera_info", START_NS, CAMERA, "depth", d=(0.1, 0, 0, 0))
    builder.image("/a/color/image", START_NS, frame.color, "bgr8", "color", padding=3)
    builder.image("/a/depth/image", START_NS, frame.depth_m, "32FC1", "depth")
    pose = np.eye(4)
    pose[0, 3] = 0.015
    builder.static_transform(START_NS, "color", "depth", pose)


def _messages(parts: Parts, folder: Path) -> str:
    """A sound bag of damaged messages."""
    store = BagBuilder().store
    with Ros2Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for number, (name, data) in enumerate(sorted(parts.items())):
            _, topic, kind = name.split(" ")
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], START_NS + number, data)
    return use_recording(folder / "bag")


def _camera_seeds() -> list[Parts]:
    from fuzz.camera_recording import recorded

    return [{"camera.db3": recorded()}]


def _mutated_camera(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    """Mostly damage to a message, so that the database stays readable."""
    data = parts["camera.db3"]
    if rng.random() < 0.2:
        return {"camera.db3": mutated_bytes(data, data, rng)}
    database = sqlite3.connect(":memory:")
    try:
        database.deserialize(data)
        rows = database.execute("SELECT id, data FROM messages").fetchall()
        for _ in range(rng.randint(1, 3)):
            number, content = rng.choice(rows)
            changed = mutated_bytes(content, rng.choice(rows)[1], rng)
            database.execute("UPDATE messages SET data = ? WHERE id = ?", (changed, number))
        database.commit()
        return {"camera.db3": database.serialize()}
    except (sqlite3.Error, IndexError, TypeError):
        return {"camera.db3": mutated_bytes(data, data, rng)}
    finally:
        database.close()


def _bag_target(storage: Storage, what: str) -> Target:
    folder = storage == "folder"
    return Target(
        f"bag {storage}",
        what,
        lambda: _bag_seeds(storage),
        (lambda parts, path: use_recording(_put(parts, path))) if folder else _bag_file,
    )


TARGETS = [
    Target("colour image", "a colour image's file", _color_seeds, _color, _mutated_images),
    Target("depth image", "a depth image's file", _depth_seeds, _depth, _mutated_images),
    Target(
        "folder",
        "a folder with color/, depth/, camera.json, timestamps.txt",
        lambda: _folder_seeds(write_folder),
        lambda parts, folder: use_recording(_put(parts, folder)),
        _without_files,
    ),
    Target(
        "TUM folder",
        "a folder with rgb.txt, depth.txt, camera.json",
        lambda: _folder_seeds(_tum_folder),
        lambda parts, folder: use_recording(_put(parts, folder)),
        _without_files,
    ),
    Target("bag messages", "damaged messages in a sound bag", _message_seeds, _messages),
    _bag_target("mcap", "an .mcap file"),
    _bag_target("db3", "a .db3 file"),
    _bag_target("bag", "a ROS 1 .bag file"),
    _bag_target("folder", "a rosbag2 folder with metadata.yaml"),
    Target(
        "librealsense",
        "a .db3 of librealsense's recorder",
        _camera_seeds,
        _bag_file,
        _mutated_camera,
        seconds=40.0,
    ),
]
