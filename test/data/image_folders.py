"""Writes frames as folders of image files: TUM's layout, and `color/` beside `depth/`."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from data.synthetic_frames import depth_mm

from meslam_core.frame import RgbdFrame

TUM_DEPTH_UNITS = 5000


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Write RGB or depth pixels; the suffix tells the format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels)


def seconds(stamp_ns: int) -> str:
    """A stamp as the benchmark writes it."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def write_tum(folder: Path, frames: list[RgbdFrame], depth_delay_ns: int = 5_000_000) -> Path:
    """Write a folder of the TUM benchmark without intrinsics."""
    lists: dict[str, list[str]] = {"rgb": ["# colour"], "depth": ["# depth"]}
    for frame in frames:
        depth_stamp_ns = frame.stamp_ns + depth_delay_ns
        units = np.rint(frame.depth_m * TUM_DEPTH_UNITS).astype(np.uint16)
        for kind, stamp_ns, pixels in (
            ("rgb", frame.stamp_ns, frame.color),
            ("depth", depth_stamp_ns, units),
        ):
            name = f"{kind}/{seconds(stamp_ns)}.png"
            write_image(folder / name, pixels)
            lists[kind].append(f"{seconds(stamp_ns)} {name}")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_folder(
    folder: Path, frames: list[RgbdFrame], stamps: bool = True, **description: object
) -> Path:
    """Write `color/`, `depth/`, `camera.json` and, where `stamps`, `timestamps.txt`."""
    for number, frame in enumerate(frames):
        # Without leading zeros: only the natural order is right from ten frames on.
        write_image(folder / "color" / f"{number}.png", frame.color)
        write_image(folder / "depth" / f"{number}.png", depth_mm(frame))
    camera = frames[0].camera.to_dict() | {"depth_scale_m": 0.001, "fps": 20} | description
    (folder / "camera.json").write_text(json.dumps(camera))
    if stamps:
        lines = [seconds(frame.stamp_ns) for frame in frames]
        (folder / "timestamps.txt").write_text("\n".join(lines) + "\n")
    return folder
