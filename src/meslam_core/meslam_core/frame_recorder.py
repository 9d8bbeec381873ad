"""Records every frame of a run that feeds a `Slam`."""

from __future__ import annotations

import time
from pathlib import Path
from types import TracebackType

from meslam_core.frame_log import FrameEntry, FrameLog
from meslam_core.frame_result import FrameResult
from meslam_core.map_growth import MapGrowth
from meslam_core.odometry_worker import TimedFrame
from meslam_core.run_report import is_tracked, rss_mb
from meslam_core.slam import Slam


class FrameRecorder:
    """Writes `frames.csv`; a context manager.

    Args:
        path: of the file.
        precision: of the weights that the map is going to be stored with.

    Raises:
        OutputError: on entry or when adding, when the file cannot be written.
    """

    def __init__(self, path: Path, precision: str) -> None:
        self._log = FrameLog(path)
        self._growth = MapGrowth(precision)
        self._last_s = time.perf_counter()

    def __enter__(self) -> FrameRecorder:
        self._log.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._growth.close()
        self._log.__exit__(kind, error, traceback)

    def add(
        self,
        slam: Slam,
        result: FrameResult,
        timed: TimedFrame,
        latency_ms: float | None,
        skipped: int,
    ) -> None:
        """Record a frame that is done.

        Args:
            slam: after the frame.
            result: of the frame.
            timed: how long it took to read it, and its odometry.
            latency_ms: from when it was due until its pose was known; None without a pace [ms].
            skipped: frames passed over since the start.
        """
        now_s = time.perf_counter()
        elapsed_s, self._last_s = now_s - self._last_s, now_s
        losses = result.losses
        self._log.add(
            FrameEntry(
                stamp_ns=result.stamp_ns,
                state=result.state.name,
                reason=result.reason,
                tracked=is_tracked(result),
                keyframe=result.is_keyframe,
                residual_m=result.residual_m,
                inlier_ratio=result.inlier_ratio,
                loss_distance=losses.distance if losses.steps else None,
                loss_depth=losses.depth if losses.steps else None,
                loss_color=losses.color if losses.steps else None,
                iterations=losses.steps,
                reading_ms=timed.reading_ms,
                odometry_ms=timed.odometry_ms,
                tracking_ms=result.tracking_ms,
                mapping_ms=result.mapping_ms,
                frame_ms=elapsed_s * 1e3,
                latency_ms=latency_ms,
                skipped=skipped,
                keyframes=len(slam.keyframes) - slam.remembered,
                regions=0 if slam.atlas is None else len(slam.atlas.regions),
                map_bytes=self._growth.measured_bytes(slam, result.stamp_ns),
                rss_mb=rss_mb(),
            )
        )
