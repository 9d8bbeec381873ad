"""What a recording holds, for `meslam info`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from meslam_core.errors import RecordingError
from meslam_core.frame import RgbdFrame
from meslam_core.recordings.recording import Recording


def describe(recording: Recording) -> dict[str, Any]:
    """Facts about a recording in plain types, ready for JSON.

    Only the first frame is decoded.

    Returns:
        name, path, format, frames, duration_s, rate_hz (None for fewer than two frames), start_s,
        bytes, camera (width, height, fx, fy, cx, cy), topics (by role; empty for image files),
        depth_coverage (share of pixels of the first frame with a measurement, 0 to 1) and
        depth_range_m (1st and 99th percentile of the first frame, None without any measurement).

    Raises:
        RecordingError: when the first frame cannot be decoded.
    """
    first = next(iter(recording.frames(0, 1)), None)
    if first is None:
        raise RecordingError(f"{recording.path} has no frames; record it again")
    stamps_ns = recording.stamps_ns
    duration_s = float(stamps_ns[-1] - stamps_ns[0]) * 1e-9
    return {
        "name": recording.name,
        "path": str(recording.path),
        "format": recording.format,
        "frames": len(recording),
        "duration_s": duration_s,
        "rate_hz": (len(recording) - 1) / duration_s if duration_s > 0 else None,
        "start_s": float(stamps_ns[0]) * 1e-9,
        "bytes": _size(recording.path),
        "camera": recording.camera.to_dict(),
        "topics": dict(recording.topics),
        **_depth_facts(first),
    }


def _depth_facts(frame: RgbdFrame) -> dict[str, Any]:
    measured = frame.depth_m[frame.depth_m > 0]
    spread = np.percentile(measured, (1, 99)).tolist() if measured.size else None
    return {"depth_coverage": measured.size / frame.depth_m.size, "depth_range_m": spread}


def _size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files)
