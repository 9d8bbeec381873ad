"""What `report.json` says about a run."""

from __future__ import annotations

import os
import platform
import resource
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import meslam_core
from meslam_core.pose_covariance import PoseCovariances
from meslam_core.regions.observed_mask import OBSERVED, ObservedMask
from meslam_core.slam import FrameResult, Slam, TrackingState
from meslam_core.trajectory import Trajectory

# A pose that is known later than this after its image was due is late.
LATE_MS = 100.0


@dataclass
class Tally:
    """What accumulates over the frames of a run; `reason` is why the latest was not trusted."""

    frames: int = 0
    degraded: int = 0
    reason: str = ""
    tracked_stamps_ns: list[int] = field(default_factory=list)
    tracked_covariances: list[NDArray[np.float64]] = field(default_factory=list)
    first_stamp_ns: int = 0
    last_stamp_ns: int = 0
    reading_ms: list[float] = field(default_factory=list)
    odometry_ms: list[float] = field(default_factory=list)
    lateness_ms: list[float] = field(default_factory=list)
    tracking_ms: list[float] = field(default_factory=list)
    mapping_ms: list[float] = field(default_factory=list)

    def add(self, result: FrameResult, reading_ms: float, odometry_ms: float) -> None:
        """Count one processed frame."""
        if not self.frames:
            self.first_stamp_ns = result.stamp_ns
        self.frames += 1
        self.last_stamp_ns = result.stamp_ns
        self.reason = result.reason or self.reason
        self.degraded += result.state is TrackingState.DEGRADED
        if is_tracked(result):
            self.tracked_stamps_ns.append(result.stamp_ns)
            self.tracked_covariances.append(result.covariance)
        self.reading_ms.append(reading_ms)
        self.odometry_ms.append(odometry_ms)
        self.tracking_ms.append(result.tracking_ms)
        self.mapping_ms.append(result.mapping_ms)

    def entries(self) -> dict[str, Any]:
        """What the report says about the frames."""
        tracked = len(self.tracked_stamps_ns)
        return {
            "frames": self.frames,
            "frames_tracked": tracked,
            "frames_lost": self.frames - tracked,
            "frames_degraded": self.degraded,
            "sensor_s": (self.last_stamp_ns - self.first_stamp_ns) * 1e-9,
            "lateness_ms": _spread(self.lateness_ms),
            "frames_late": sum(ms > LATE_MS for ms in self.lateness_ms),
            "stage_ms": {
                "reading": _spread(self.reading_ms),
                "odometry": _spread(self.odometry_ms),
                "tracking": _spread(self.tracking_ms),
                "mapping": _spread(self.mapping_ms),
            },
        }

    def covariances(self) -> PoseCovariances:
        """Of the poses that were measured, as they were known live."""
        stamps_ns = np.array(self.tracked_stamps_ns, np.int64)
        return PoseCovariances(stamps_ns, np.array(self.tracked_covariances).reshape(-1, 6, 6))

    def tracked(self, trajectory: Trajectory) -> Trajectory:
        """The poses of a trajectory that were measured, not extrapolated."""
        kept = np.isin(trajectory.stamps_ns, np.array(self.tracked_stamps_ns, np.int64))
        return trajectory.subset(np.flatnonzero(kept))


def is_tracked(result: FrameResult) -> bool:
    """Whether a frame's pose rests on a measurement: the map's, or at least the odometry's."""
    if result.state is TrackingState.OK:
        return True
    measured = result.odometry is not None and result.odometry.valid
    return result.state is TrackingState.DEGRADED and measured


def map_entries(slam: Slam) -> dict[str, Any]:
    """What the report says about the map."""
    if slam.atlas is None:
        return {"keyframes": 0, "regions": 0, "observed_volume_m3": 0.0}
    return {
        "keyframes": len(slam.keyframes) - slam.remembered,
        "regions": len(slam.atlas.regions),
        "observed_volume_m3": observed_volume_m3(slam),
    }


def observed_volume_m3(slam: Slam) -> float:
    """Volume of the observed space; where masks overlap, the nearest region's voxels count."""
    if slam.atlas is None:
        return 0.0
    regions = list(slam.atlas.regions.values())
    centers = np.array([region.T_map_region[:3, 3] for region in regions])
    volume = 0.0
    for number, region in enumerate(regions):
        mask = region.observed()
        positions = _observed_positions(mask) @ region.T_map_region[:3, :3].T + centers[number]
        own = np.linalg.norm(positions - centers[number], axis=1)
        nearest = np.ones(len(positions), bool)
        for other, center in enumerate(centers):
            if other != number:
                distance = np.linalg.norm(positions - center, axis=1)
                nearest &= own <= distance if number < other else own < distance
        volume += np.count_nonzero(nearest) * mask.voxel_m**3
    return float(volume)


def _observed_positions(mask: ObservedMask) -> NDArray[np.float64]:
    """Centres (N, 3) of the observed voxels about the region's centre [m]."""
    voxels = np.argwhere(mask.flags & OBSERVED)
    positions: NDArray[np.float64] = (voxels + 0.5) * mask.voxel_m - mask.half_extent_m
    return positions


def run_environment() -> dict[str, Any]:
    """When, on what and with which versions results were computed; the process's largest memory."""
    return {
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "memory_gb": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9,
            "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
            "system": platform.platform(),
        },
        "versions": {
            "meslam": meslam_core.__version__,
            "python": platform.python_version(),
            "machine": platform.machine(),
            "torch": str(torch.__version__),
            "numpy": np.__version__,
            "open3d": metadata.version("open3d-cpu"),
        },
    }


def rss_mb() -> float | None:
    """Memory that the process holds now; None where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_bytes().split()[1])
    except (OSError, IndexError, ValueError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 2.0**20


def _processor() -> str:
    """Name of the processor, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _spread(values: list[float]) -> dict[str, float | None]:
    """Median and 95th percentile; None without values."""
    if not values:
        return {"median": None, "p95": None}
    return {"median": float(np.median(values)), "p95": float(np.percentile(values, 95))}
