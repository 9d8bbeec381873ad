"""The map as a mesh: in an answer, or written to a file with word on how far that is."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

from meslam_core.map.mesh import extract_mesh
from meslam_core.map.mesh_file import FORMATS, write_mesh
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.triangle_mesh import TriangleMesh
from meslam_core.regions.grid import RegionIndex
from meslam_interfaces.action import ExportMap as ExportAction
from meslam_interfaces.srv import ExportMap, GetMesh
from meslam_ros.answers import Code, RequestError, exclusive
from meslam_ros.conversions import numbers
from meslam_ros.folders import make_folder, path_below
from meslam_ros.region_catalog import region_index
from meslam_ros.served_map import Box, ServedMap, requested_box

Request = ExportMap.Request | GetMesh.Request | ExportAction.Goal
Progress = Callable[[str, int, int], None]
"""Called with the stage, the parts done and their total; stops the work by raising."""

MESHING, WRITING = "meshing", "writing"


class MeshRequests:
    """Handlers of the requests for meshes.

    Args:
        served: the map.
    """

    def __init__(self, served: ServedMap) -> None:
        self._served = served
        self._exporting = threading.Lock()

    def export_map(
        self,
        request: ExportMap.Request | ExportAction.Goal,
        response: ExportMap.Response | ExportAction.Result,
        progress: Progress = lambda stage, done, total: None,
    ) -> None:
        """Write the mesh to a file below the export folder."""
        path = path_below(self._served.settings.export_folder, request.path, "export_folder")
        if path.suffix.lower() not in FORMATS:
            raise RequestError(
                Code.INVALID_REQUEST,
                f"{request.path!r} does not end in {', '.join(FORMATS)}; the ending chooses the "
                "format",
            )
        with exclusive(self._exporting, "another export is running"):
            parts = 0

            def meshing(done: int, total: int) -> None:
                nonlocal parts
                parts = total
                progress(MESHING, done, total)

            mesh = self._mesh(self._served.snapshot().map, request, meshing)
            progress(WRITING, parts, parts)
            make_folder(path.parent)
            write_mesh(mesh, path)
        response.path = str(path)
        response.vertices, response.triangles = len(mesh.vertices), len(mesh.triangles)
        response.bytes = path.stat().st_size
        response.message = f"{len(mesh.triangles)} triangles written to {path}"

    def get_mesh(self, request: GetMesh.Request, response: GetMesh.Response) -> None:
        """The mesh in the answer itself."""
        snapshot = self._served.snapshot()
        mesh = self._mesh(snapshot.map, request)
        response.header = self._served.header(snapshot)
        response.vertices = numbers("f", mesh.vertices)
        response.colors = numbers("B", mesh.colors)
        response.triangles = numbers("I", mesh.triangles)
        response.message = f"{len(mesh.triangles)} triangles"

    def _mesh(
        self,
        neural_map: NeuralMap,
        request: Request,
        progress: Callable[[int, int], None] | None = None,
    ) -> TriangleMesh:
        """The mesh that a request asks for, unless it is too large."""
        default_m = neural_map.config.mesh_resolution_m
        resolution_m = self._served.resolution(request.resolution_m, default_m)
        regions = _chosen(neural_map, request.regions)
        box = requested_box(request)
        self._bound(neural_map, regions, box, resolution_m)
        mesh = extract_mesh(neural_map, resolution_m, box=box, regions=regions, progress=progress)
        if not len(mesh.triangles):
            raise RequestError(Code.EMPTY_MAP, "no surface has been observed where you ask")
        return mesh

    def _bound(
        self,
        neural_map: NeuralMap,
        regions: list[RegionIndex] | None,
        box: Box | None,
        resolution_m: float,
    ) -> None:
        """Refuse meshes over more cells than the limit."""
        chosen = neural_map.regions if regions is None else neural_map.subset(regions)
        volume_m3 = 0.0
        for region in chosen:
            centers = region.observed_centers(near_surface=True)
            if box is not None:
                centers = centers[((centers >= box[0]) & (centers <= box[1])).all(axis=1)]
            volume_m3 += len(centers) * region.stored.mask.voxel_m**3
        self._served.limit_cells(volume_m3 / resolution_m**3)


def _chosen(neural_map: NeuralMap, requested: Iterable[Any]) -> list[RegionIndex] | None:
    indices = [region_index(entry.index) for entry in requested]
    known = {region.stored.index for region in neural_map.regions}
    missing = [index for index in indices if index not in known]
    if missing:
        raise RequestError(
            Code.NOT_FOUND, f"there is no region {missing[0]}; the map has {sorted(known)}"
        )
    return indices or None
