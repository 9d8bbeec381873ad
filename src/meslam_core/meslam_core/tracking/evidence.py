"""Whether the map shows at a frame's points what the frame shows: evidence besides their depth."""

from __future__ import annotations

import numpy as np

from meslam_core.field.model import LUMA
from meslam_core.mapping.keyframes import Rays
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose, inverse

# Fewer points, or less contrast in frame or map (standard deviation of luma), tell nothing.
MIN_POINTS = 50
MIN_CONTRAST = 0.03
SATURATION = 0.95


def colour_likeness(region: Region, rays: Rays, T_map_camera: Pose) -> float | None:
    """Correlation in [-1, 1] of measured and mapped luma at a frame's points.

    It does not depend on exposure, and hardly on geometry: along a plain floor a wrong pose fits
    in depth but not in this. None where nothing can be said, such as of a white wall.

    Args:
        region: whose map is asked, awake.
        rays: of the frame, camera frame.
        T_map_camera: (4, 4).
    """
    ends = rays.directions.numpy() * rays.distances_m.numpy()[:, None]
    T_region_camera = (inverse(region.T_map_region) @ T_map_camera).astype(np.float32)
    points = ends @ T_region_camera[:3, :3].T + T_region_camera[:3, 3]
    observed = region.mask.lookup(points) > 0
    if np.count_nonzero(observed) < MIN_POINTS:
        return None
    values = region.field.predict(points[observed] / np.float32(region.half_side_m))
    near = np.abs(values[:, 0]) < SATURATION
    if np.count_nonzero(near) < MIN_POINTS:
        return None
    weights = np.array(LUMA, np.float32)
    measured = (rays.colors.numpy()[observed] @ weights)[near]
    mapped = (values[:, 1:] @ weights)[near]
    if min(measured.std(), mapped.std()) < MIN_CONTRAST:
        return None
    return float(np.corrcoef(measured, mapped)[0, 1])
