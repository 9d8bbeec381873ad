"""Recordings and a map to spoil, made once and shared by all faults."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from data import image_folders
from data.bag_builder import (
    ALIGNED_DEPTH,
    ALIGNED_DEPTH_INFO,
    COLOR,
    COLOR_FRAME,
    COLOR_INFO,
    BagBuilder,
    Storage,
    aligned_bag,
)
from data.textured_room import frame_at, path
from faults.bench import Bench
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose
from meslam_core.trajectory import Trajectory, write_tum

FRAMES = 24
MIDDLE = FRAMES // 2
WHILE = slice(8, 14)
"""The frames of a fault that passes by."""
START_NS = 1_700_000_000_000_000_000
QUICK = tuple(
    word
    for setting in (
        "keyframes.rays=2048",
        "mapping.first_iterations=150",
        "mapping.iterations=8",
        "mapping.keyframe_iterations=16",
        "mapping.final_iterations=20",
    )
    for word in ("--set", setting)
)
"""Makes a run short, and still accurate to millimetres in the room."""


@dataclass
class Shot:
    """One moment of the walk, to be spoilt before it is recorded.

    Attributes:
        stamp_ns: of both images.
        color: (H, W, 3) uint8, RGB, or what a fault makes of it; None for no image.
        depth: (H, W) uint16 [mm] or float32 [m]; None for no image.
        camera: what the camera infos say; None for no message.
        T_map_camera: true pose (4, 4).
        recorded_ns: when it arrived; by default its stamp.
    """

    stamp_ns: int
    color: NDArray[Any] | None
    depth: NDArray[Any] | None
    camera: PinholeCamera | None
    T_map_camera: Pose
    color_encoding: str = "rgb8"
    depth_encoding: str = ""
    recorded_ns: int | None = None


@cache
def poses() -> tuple[Pose, ...]:
    """True T_map_camera of the walk: half a metre and a quarter turn through a furnished room."""
    return tuple(path(FRAMES, step_m=0.02, step_deg=1.0))


@cache
def frames() -> tuple[RgbdFrame, ...]:
    """What the camera sees on the walk."""
    seen = []
    for number, pose in enumerate(poses()):
        frame = frame_at(pose, number)
        stamp_ns = START_NS + frame.stamp_ns
        seen.append(RgbdFrame(stamp_ns, frame.color, frame.depth_m, frame.camera))
    return tuple(seen)


def shots() -> list[Shot]:
    """The walk as a camera with millimetre depth sends it."""
    return [
        Shot(
            frame.stamp_ns,
            frame.color.copy(),
            np.rint(frame.depth_m * 1000).astype(np.uint16),
            frame.camera,
            pose,
        )
        for frame, pose in zip(frames(), poses(), strict=True)
    ]


def record(taken: list[Shot], folder: Path, storage: Storage = "mcap") -> Path:
    """Write shots as realsense2_camera's topics, and `truth.txt`; returns the recording."""
    folder.mkdir(parents=True, exist_ok=True)
    write_truth(taken, folder / "truth.txt")
    builder = BagBuilder(ros1=storage == "bag")
    for shot in taken:
        when = shot.stamp_ns if shot.recorded_ns is None else shot.recorded_ns
        if shot.camera is not None:
            for topic in (COLOR_INFO, ALIGNED_DEPTH_INFO):
                builder.camera_info(topic, when, shot.camera)
        if shot.color is not None:
            builder.image(COLOR, shot.stamp_ns, shot.color, shot.color_encoding, COLOR_FRAME, when)
        if shot.depth is not None:
            encoding = shot.depth_encoding or ("32FC1" if shot.depth.dtype.kind == "f" else "16UC1")
            builder.image(ALIGNED_DEPTH, shot.stamp_ns, shot.depth, encoding, COLOR_FRAME, when)
    return builder.write(folder, storage)


def write_truth(taken: list[Shot], file: Path) -> None:
    """Write the true poses of shots, the first one of each stamp, as TUM text."""
    first = {shot.stamp_ns: shot.T_map_camera for shot in reversed(taken)}
    stamps = sorted(first)
    write_tum(file, Trajectory(np.array(stamps), np.array([first[stamp] for stamp in stamps])))


def shared(bench: Bench, name: str, make: Callable[[Path], object]) -> Path:
    """Something in the cache, made by whoever needs it first."""
    target = bench.cache / name
    bench.cache.mkdir(parents=True, exist_ok=True)
    with (bench.cache / f".{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not target.exists():
            partial = bench.cache / f".{name}.{os.getpid()}"
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            make(partial)
            partial.replace(target)
    return target


def bag(bench: Bench, storage: Storage = "mcap") -> Path:
    """The whole walk as a ROS bag; shared, not to be changed."""
    folder = shared(
        bench, f"walk-{storage}", lambda target: aligned_bag(list(frames()), target, storage)
    )
    (file,) = [p for p in folder.rglob("*") if p.suffix == f".{storage}"] or [folder / "recording"]
    return file


def tum(bench: Bench) -> Path:
    """The walk as a folder of the TUM benchmark; shared."""

    def make(target: Path) -> None:
        image_folders.write_tum(target, list(frames()))
        (target / "camera.json").write_text(json.dumps(frames()[0].camera.to_dict()))

    return shared(bench, "walk-tum", make)


def folder(bench: Bench) -> Path:
    """The walk as a folder of images; shared."""
    return shared(
        bench, "walk-folder", lambda target: image_folders.write_folder(target, list(frames()))
    )


def truth(bench: Bench) -> Path:
    """The true poses of the walk as TUM text; shared."""
    folder = shared(bench, "truth", lambda target: write_truth(shots(), target / "truth.txt"))
    return folder / "truth.txt"


def stored_map(bench: Bench) -> Path:
    """The map of the whole walk; shared, not to be changed."""

    def make(target: Path) -> None:
        ended = bench.meslam("run", bag(bench), "--out", target, *QUICK)
        if ended.status != 0:
            raise RuntimeError(f"the walk cannot be mapped: {ended.stderr}")

    return shared(bench, "walk-mapped", make) / "map.meslam"
