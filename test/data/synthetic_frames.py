"""Tiny RGB-D frames of a textured, slanted plane; every frame differs from every other."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meslam_core.camera import PinholeCamera
from meslam_core.frame import RgbdFrame

CAMERA = PinholeCamera(width=32, height=24, fx=30.0, fy=31.0, cx=15.5, cy=11.5)
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 50_000_000


def plane_frame(number: int, camera: PinholeCamera = CAMERA) -> RgbdFrame:
    """The `number`-th frame; depth is whole millimetres with a hole in the corner."""
    v, u = np.mgrid[: camera.height, : camera.width]
    color = np.stack([u * 5 + number, v * 7 + 2 * number, (u + v) * 3], axis=-1) % 256
    depth_mm = 1000 + 10 * u + 5 * v + 3 * number
    depth_mm[:2, :2] = 0
    return RgbdFrame(
        stamp_ns=START_NS + number * PERIOD_NS,
        color=color.astype(np.uint8),
        depth_m=depth_mm.astype(np.float32) * np.float32(0.001),
        camera=camera,
    )


def plane_frames(count: int) -> list[RgbdFrame]:
    """The first `count` frames."""
    return [plane_frame(number) for number in range(count)]


def depth_mm(frame: RgbdFrame) -> np.ndarray:
    """Depth of a frame as 16UC1."""
    return np.rint(frame.depth_m * 1000).astype(np.uint16)


def assert_same_frame(actual: RgbdFrame, expected: RgbdFrame, depth_atol_m: float = 1e-6) -> None:
    """Assert that two frames agree in stamp, colour, depth and camera."""
    assert actual.stamp_ns == expected.stamp_ns
    assert actual.camera == expected.camera
    np.testing.assert_array_equal(actual.color, expected.color)
    np.testing.assert_allclose(actual.depth_m, expected.depth_m, atol=depth_atol_m)


def cut(path: Path, share: float) -> Path:
    """Truncate a file to a share of its length."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path
