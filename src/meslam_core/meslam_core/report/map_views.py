"""The map beside the camera's images: rendered from the same poses, with the depth's error."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from meslam_core.camera import PinholeCamera
from meslam_core.errors import FrameError, RecordingError
from meslam_core.frame import RgbdFrame
from meslam_core.map.view import render_view
from meslam_core.report.run_folder import RunFolder
from meslam_core.trajectory import Trajectory

WIDTH_PX = 320
LIMIT_M = 0.05
UNKNOWN_RGB = (170, 170, 170)
LEVELS = 33
JPEG_QUALITY = 82
FAR_M = 8.0
FAR_SHARE = 1.2


@dataclass(frozen=True)
class MapView:
    """One pose: what the camera saw and what the map shows.

    Attributes:
        seconds: since the run's first frame.
        image: of the camera; a data URI, or empty where the recording is not at hand.
        rendered: the stored networks from the same pose; a data URI.
        depth_error: rendered minus measured depth; a data URI, or empty.
        error_m: median of its size [m]; NaN where unknown.
        compared: share of the pixels that have both depths.
        covered: share of the pixels that show a surface of the map.
    """

    seconds: float
    image: str
    rendered: str
    depth_error: str
    error_m: float
    compared: float
    covered: float


def chosen_stamps(runs: Sequence[RunFolder], count: int) -> list[NDArray[np.int64]]:
    """Stamps [ns] of the tracked frames to show, for every run; runs with a path alone.

    Spread over the time of the path; runs of one recording show the same moments.
    """
    paths = [_path(run) for run in runs]
    result = []
    for run, path in zip(runs, paths, strict=True):
        same = [
            other
            for each, other in zip(runs, paths, strict=True)
            if each.entries.get("recording") == run.entries.get("recording")
        ]
        first = max(int(other.stamps_ns[0]) for other in same)
        last = min(int(other.stamps_ns[-1]) for other in same)
        if first >= last:
            first, last = int(path.stamps_ns[0]), int(path.stamps_ns[-1])
        wanted = first + ((np.arange(count) + 0.5) / count * (last - first)).astype(np.int64)
        nearest = [int(np.abs(path.stamps_ns - stamp).argmin()) for stamp in wanted]
        result.append(path.stamps_ns[np.unique(np.array(nearest, np.intp))])
    return result


def map_views(
    run: RunFolder, stamps_ns: NDArray[np.int64], progress: Callable[[], None]
) -> list[MapView]:
    """The map of a run that has one, from its poses at stamps.

    What cannot be read of the recording is left out; the run's `missing` says so.
    """
    path = _path(run)
    views = []
    for stamp_ns in stamps_ns:
        pose = path.poses[int(np.searchsorted(path.stamps_ns, stamp_ns))]
        frame = _frame_at(run, int(stamp_ns))
        camera = run.camera if frame is None else frame.camera
        if camera is not None:
            views.append(_view(run, int(stamp_ns), pose, camera, frame))
        progress()
    return views


def color_bar() -> str:
    """CSS colours of a depth error from -LIMIT_M to LIMIT_M, for a gradient."""
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in _palette()[::4])


def _view(
    run: RunFolder,
    stamp_ns: int,
    pose: NDArray[np.float64],
    camera: PinholeCamera,
    frame: RgbdFrame | None,
) -> MapView:
    assert run.map is not None
    camera = camera.scaled(min(1.0, WIDTH_PX / camera.width))
    size = (camera.width, camera.height)
    image, measured_m = "", np.zeros(size[::-1], np.float32)
    if frame is not None:
        measured_m = cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST)
        resized = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
        image = _photograph(np.asarray(resized, np.uint8))
    far_m = FAR_SHARE * float(measured_m.max()) if measured_m.any() else FAR_M
    rendered, depth_m = render_view(run.map, camera, pose, far_m)
    rendered[depth_m == 0] = UNKNOWN_RGB
    both = (depth_m > 0) & (measured_m > 0)
    error_m = np.where(both, depth_m - measured_m, np.nan)
    return MapView(
        seconds=(stamp_ns - run.first_stamp_ns) * 1e-9,
        image=image,
        rendered=_photograph(rendered),
        depth_error=_error_map(error_m) if both.any() else "",
        error_m=float(np.nanmedian(np.abs(error_m))) if both.any() else float("nan"),
        compared=float(both.mean()),
        covered=float((depth_m > 0).mean()),
    )


def _frame_at(run: RunFolder, stamp_ns: int) -> RgbdFrame | None:
    """The recording's frame with a stamp; None, and a word in `missing`, where there is none."""
    if run.recording is None:
        return None
    try:
        number = int(np.searchsorted(run.recording.stamps_ns, stamp_ns))
        for frame in run.recording.frames(number, number + 1):
            if frame.stamp_ns == stamp_ns:
                return frame
        problem = f"{run.recording.path} has no image of {stamp_ns * 1e-9:.3f} s, so it is another"
    except (RecordingError, FrameError) as error:
        problem = str(error)
    note = f"Camera images: {problem}."
    if note not in run.missing:
        run.missing.append(note)
    return None


def _path(run: RunFolder) -> Trajectory:
    assert run.refined is not None, "only runs with a path have views"
    return run.refined


def _palette() -> NDArray[np.uint8]:
    """Colours (LEVELS, 3) from too near to too far, readable by people who are colour-blind."""
    shades = matplotlib.colormaps["RdBu_r"](np.linspace(0.0, 1.0, LEVELS))
    return np.asarray(np.round(255 * shades[:, :3]), np.uint8)


def _error_map(error_m: NDArray[np.floating]) -> str:
    """A picture of signed errors (H, W), NaN where unknown."""
    scaled = (np.nan_to_num(error_m) / LIMIT_M + 1.0) / 2.0
    levels = np.clip(scaled * LEVELS, 0, LEVELS - 1).astype(np.uint8)
    levels[np.isnan(error_m)] = LEVELS
    picture = Image.fromarray(levels).convert("P")
    picture.putpalette([*_palette().reshape(-1).tolist(), *UNKNOWN_RGB])
    return _data_uri(picture, "png", optimize=True)


def _photograph(image: NDArray[np.uint8]) -> str:
    return _data_uri(Image.fromarray(image), "jpeg", quality=JPEG_QUALITY)


def _data_uri(picture: Image.Image, kind: str, **options: int) -> str:
    buffer = io.BytesIO()
    picture.save(buffer, kind, **options)
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"
