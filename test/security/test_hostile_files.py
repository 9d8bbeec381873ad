"""Files made to do harm: what they claim is not believed, and what they name is not opened."""

from __future__ import annotations

import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from data.image_folders import write_folder, write_tum
from data.synthetic_frames import CAMERA, plane_frames
from fuzz.map_targets import stored_map
from fuzz.region_bytes import signed_manifest

from meslam_core.camera import PinholeCamera, register_depth_to_color
from meslam_core.config import MeslamConfig
from meslam_core.continuation import read_start_pose
from meslam_core.errors import ConfigError, EvaluationError, FrameError, MapError, RecordingError
from meslam_core.input_file import read_file
from meslam_core.map.manifest import Manifest
from meslam_core.map.store import MapStore
from meslam_core.point_query import read_points
from meslam_core.recordings import open_recording
from meslam_core.recordings.images import decode_color, decode_depth
from meslam_core.trajectory import parsed_stamp, read_tum

REFUSED_IMAGE = r"larger than any camera's|damaged"


def png(width: int, height: int, depth: int = 8, kind: int = 0) -> bytes:
    """A tiny PNG file that claims any size."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0))
    return (
        b"\x89PNG\r\n\x1a\n"
        + header
        + chunk(b"IDAT", zlib.compress(bytes(1000)))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(30_000, 30_000), (2**31 - 1, 1), (1, 2**31 - 1), (8193, 8193)])
def test_an_image_is_refused_by_the_size_it_claims(size: tuple[int, int]) -> None:
    with pytest.raises(RecordingError, match=REFUSED_IMAGE):
        decode_color(png(*size, kind=2))
    with pytest.raises(RecordingError, match=REFUSED_IMAGE):
        decode_depth(png(*size, depth=16))


def test_only_formats_of_recordings_are_decoded() -> None:
    with pytest.raises(RecordingError, match="unknown format"):
        decode_color(
            b"GIF89a\x01\0\x01\0\x80\0\0\0\0\0\xff\xff\xff,\0\0\0\0\x01\0\x01\0\0\x02\x02D\x01\0;"
        )


@pytest.mark.parametrize("name", ["/etc/hostname", "../../secret.png", "rgb/../../secret.png"])
def test_a_list_names_nothing_outside_its_folder(tmp_path: Path, name: str) -> None:
    folder = write_tum(tmp_path / "room", plane_frames(2))
    lines = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join([*lines[:-1], f"{lines[-1].split()[0]} {name}"]))
    with pytest.raises(RecordingError, match="leads out of the folder"):
        open_recording(folder, CAMERA)


def test_pipes_and_endless_files_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "large").write_bytes(bytes(101))
    for name, reason in (("pipe", "ordinary"), ("large", "larger than 100")):
        with pytest.raises(OSError, match=reason):
            read_file(tmp_path / name, 100)
    with pytest.raises(OSError, match="ordinary"):
        read_file(Path("/dev/zero"), 100)
    assert read_file(tmp_path / "large", 101) == bytes(101)


def test_a_pipe_in_a_recording_or_a_map_does_not_block(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "room", plane_frames(2))
    for name in ("color/1.png", "camera.json"):
        (folder / name).unlink()
        os.mkfifo(folder / name)
        with pytest.raises(RecordingError, match="ordinary"):
            list(open_recording(folder).frames())
    stored = tmp_path / "map.meslam"
    stored.mkdir()
    os.mkfifo(stored / "manifest.json")
    with pytest.raises(MapError, match="ordinary"):
        MapStore(stored).load()


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 1 << 16},
        {"width": 1 << 14, "height": 1 << 14},
        {"fx": 1e-9},
        {"fy": 1e12},
        {"cx": 1e300},
        {"width": 10**400},
        {"fx": 10**400},
    ],
)
def test_a_camera_is_one_that_there_may_be(tmp_path: Path, changes: dict[str, float]) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(CAMERA.to_dict() | changes))
    with pytest.raises(FrameError, match=r"camera\.json"):
        PinholeCamera.from_json(path)


def test_cameras_that_do_not_belong_together_are_no_endless_loop() -> None:
    coarse = PinholeCamera(32, 24, 0.01, 0.01, 15.5, 11.5)
    with pytest.raises(FrameError, match="do not belong together"):
        register_depth_to_color(np.ones((24, 32), np.float32), coarse, CAMERA, np.eye(4))


def test_a_manifest_names_each_place_once() -> None:
    document = json.loads(dict(stored_map())["manifest.json"])
    document["regions"] *= 2
    with pytest.raises(MapError, match="has two regions"):
        Manifest.from_bytes(signed_manifest(json.dumps(document).encode()), "manifest")


def test_the_header_of_an_array_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "points.npy"
    np.save(path, np.zeros((2, 3)), allow_pickle=False)
    honest, claim = b"(2, 3), }", b"(200000000000, 3), }"
    longer = path.read_bytes().replace(honest.ljust(len(claim)), claim)
    assert claim in longer
    path.write_bytes(longer)
    with pytest.raises(MapError, match="cannot be read as points"):
        read_points(path)


@pytest.mark.parametrize("text", ["1e999999999", "-1e30", "nan", "inf", "1" * 30, "", "x"])
def test_a_stamp_is_a_time(text: str) -> None:
    with pytest.raises(ValueError, match="seconds"):
        parsed_stamp(text)


def test_positions_beyond_all_places_are_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1 1e300 0 0 0 0 0 1\n")
    with pytest.raises(EvaluationError, match="beyond all places"):
        read_tum(tmp_path / "poses.txt")


@pytest.mark.parametrize("text", ["x" * 5000, "a\0b", "0 0 0 0 0 0"])
def test_a_start_pose_that_is_no_path(text: str) -> None:
    with pytest.raises(ConfigError, match="neither"):
        read_start_pose(text)


@pytest.mark.parametrize(
    "value", ["2001-99-99", "[" * 2000, "0x" + "f" * 4000, "9" * 5000, "1" + "0" * 400]
)
def test_odd_values_of_settings(value: str) -> None:
    with pytest.raises(ConfigError):
        MeslamConfig.from_overrides([f"field.truncation_m={value}"])
