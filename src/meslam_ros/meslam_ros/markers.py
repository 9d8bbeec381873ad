"""The map as markers and points that RViz and Foxglove show without plugins."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import Point, Pose, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from meslam_interfaces.msg import Region
from meslam_ros.conversions import byte_array
from meslam_ros.region_catalog import RegionEntry

if TYPE_CHECKING:
    from meslam_core.map.surface import SurfacePoints
    from meslam_core.map.triangle_mesh import TriangleMesh

BOXES, INTERSECTIONS, LABELS, MESHES = "regions", "intersections", "region_labels", "mesh"
STATE_COLORS = {
    Region.AT_REST: (0.55, 0.55, 0.60, 0.10),
    Region.TRAINING: (0.95, 0.75, 0.20, 0.14),
    Region.WORKING: (0.15, 0.75, 0.35, 0.18),
}
INTERSECTION_COLOR = (0.30, 0.50, 0.95, 0.15)
STATE_NAMES = {Region.AT_REST: "at rest", Region.TRAINING: "training", Region.WORKING: "working"}
LABEL_HEIGHT_M = 0.15


def delete_all(header: Header) -> Marker:
    """Removes all markers of a topic."""
    return Marker(header=header, action=Marker.DELETEALL)


def region_markers(entries: Iterable[RegionEntry], header: Header) -> list[Marker]:
    """Boxes with labels of all regions, and the intersections of neighbours."""
    entries = list(entries)
    markers = [delete_all(header)]
    for number, entry in enumerate(entries):
        side = Vector3(x=entry.side_m, y=entry.side_m, z=entry.side_m)
        markers.append(_box(header, BOXES, number, entry.pose, side, STATE_COLORS[entry.state]))
        markers.append(_label(header, number, entry))
    for number, (first, second) in enumerate(combinations(entries, 2)):
        overlap = _intersection(first, second)
        if overlap is not None:
            pose, size = overlap
            markers.append(_box(header, INTERSECTIONS, number, pose, size, INTERSECTION_COLOR))
    return markers


def mesh_marker(mesh: TriangleMesh, number: int, header: Header) -> Marker:
    """A coloured mesh as a triangle list; an empty one deletes the marker.

    Args:
        mesh: in the map frame.
        number: id of the marker.
        header: stamp and map frame.
    """
    marker = Marker(header=header, ns=MESHES, id=number, type=Marker.TRIANGLE_LIST)
    if not len(mesh.triangles):
        marker.action = Marker.DELETE
        return marker
    marker.scale = Vector3(x=1.0, y=1.0, z=1.0)
    marker.color = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)
    marker.pose.orientation.w = 1.0
    vertices = [Point(x=x, y=y, z=z) for x, y, z in mesh.vertices.astype(float).tolist()]
    colors = [ColorRGBA(r=r, g=g, b=b, a=1.0) for r, g, b in (mesh.colors / 255.0).tolist()]
    order = mesh.triangles.reshape(-1).tolist()
    marker.points = [vertices[i] for i in order]
    marker.colors = [colors[i] for i in order]
    return marker


def point_cloud(points: SurfacePoints, header: Header) -> PointCloud2:
    """Surface points with colours, as `x y z rgb`."""
    rows = np.zeros(len(points.positions), [("position", "<f4", 3), ("rgb", "<u4")])
    rows["position"] = points.positions
    red, green, blue = points.colors.astype(np.uint32).T
    rows["rgb"] = red << 16 | green << 8 | blue
    fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate(("x", "y", "z", "rgb"))
    ]
    return PointCloud2(
        header=header,
        height=1,
        width=len(rows),
        fields=fields,
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        is_dense=True,
        data=byte_array(rows.view(np.uint8)) if len(rows) else byte_array(b""),
    )


def _box(
    header: Header,
    namespace: str,
    number: int,
    pose: Pose,
    size: Vector3,
    color: tuple[float, float, float, float],
) -> Marker:
    red, green, blue, alpha = color
    return Marker(
        header=header,
        ns=namespace,
        id=number,
        type=Marker.CUBE,
        pose=pose,
        scale=size,
        color=ColorRGBA(r=red, g=green, b=blue, a=alpha),
    )


def _label(header: Header, number: int, entry: RegionEntry) -> Marker:
    marker = _box(
        header, LABELS, number, entry.pose, Vector3(z=LABEL_HEIGHT_M), (1.0, 1.0, 1.0, 0.9)
    )
    marker.type = Marker.TEXT_VIEW_FACING
    marker.text = (
        f"{entry.index[0]} {entry.index[1]} {entry.index[2]}: {STATE_NAMES[entry.state]}\n"
        f"{entry.keyframes} keyframes, {entry.size / 1000:.0f} kB"
    )
    return marker


def _intersection(first: RegionEntry, second: RegionEntry) -> tuple[Pose, Vector3] | None:
    """Centre and size of what two boxes share; their axes are taken as the map's."""
    low = np.maximum(_corner(first, -0.5), _corner(second, -0.5))
    high = np.minimum(_corner(first, 0.5), _corner(second, 0.5))
    if not (high > low).all():
        return None
    x, y, z = (0.5 * (low + high)).tolist()
    size_x, size_y, size_z = (high - low).tolist()
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = x, y, z
    return pose, Vector3(x=size_x, y=size_y, z=size_z)


def _corner(entry: RegionEntry, sign: float) -> NDArray[np.float64]:
    center = entry.pose.position
    return np.array([center.x, center.y, center.z]) + sign * entry.side_m
