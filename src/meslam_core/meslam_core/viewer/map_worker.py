"""The program that asks the regions' networks for the viewer, in a process of its own.

It computes only when no other program wants the processor, so that it slows nothing down, and
ends with the program that started it.
"""

from __future__ import annotations

import io
import os
import socket
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from meslam_core.errors import MapError, MeslamError
from meslam_core.map.codec import decode
from meslam_core.map.mesh import extract_mesh
from meslam_core.map.mesh_file import write_glb, write_mesh
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.occupancy import occupancy_grid
from meslam_core.map.placed_region import PlacedRegion
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import NEAR_SURFACE
from meslam_core.threads import limit_threads
from meslam_core.viewer.channel import Channel

MAX_MESH_CELLS = 400_000_000

Answer = tuple[dict[str, Any], bytes]


class MapWorker:
    """Answers requests about the regions that it was given."""

    def __init__(self) -> None:
        self._regions: dict[RegionIndex, PlacedRegion] = {}

    def answer(self, request: dict[str, Any], blocks: list[bytes]) -> Answer:
        """The answer to one request; `error` in it says why there is none."""
        try:
            if request["do"] == "take":
                return self._take(tuple(request["index"]), blocks[0])
            if request["do"] == "forget":
                self._regions.clear()
                return {}, b""
            if request["do"] == "mesh":
                return self._mesh(request)
            if request["do"] == "layer":
                return self._layer(request)
            return {}, self._export(request)
        except MeslamError as error:
            return {"error": str(error)}, b""

    def _take(self, index: RegionIndex, data: bytes) -> Answer:
        """Keep a region in the place of an earlier version of it."""
        region = decode(data, f"region {index}")
        if region.index != index:
            raise MapError(f"what was sent as region {index} is region {region.index}")
        self._regions[region.index] = PlacedRegion(region, "auto")
        return {}, b""

    def _mesh(self, request: dict[str, Any]) -> Answer:
        """The mesh of one region as binary glTF; nothing where it is empty."""
        index: RegionIndex = tuple(request["index"])
        mesh = extract_mesh(
            self._map(request["resolution_m"]), request["resolution_m"], regions=[index]
        )
        if not len(mesh.triangles):
            return {"triangles": 0, "bounds": np.zeros((2, 3)).tolist()}, b""
        buffer = io.BytesIO()
        write_glb(mesh, buffer)
        bounds = [mesh.vertices.min(axis=0).tolist(), mesh.vertices.max(axis=0).tolist()]
        return {"triangles": len(mesh.triangles), "bounds": bounds}, buffer.getvalue()

    def _layer(self, request: dict[str, Any]) -> Answer:
        """The cells of a slice as thick as they are."""
        height_m, resolution_m = request["height_m"], request["resolution_m"]
        grid = occupancy_grid(self._map(), height_m, height_m, resolution_m)
        return {"shape": grid.cells.shape, "origin": grid.origin.tolist()}, grid.cells.tobytes()

    def _export(self, request: dict[str, Any]) -> bytes:
        """The mesh of the whole map as a file."""
        mesh = extract_mesh(self._map(request["resolution_m"]), request["resolution_m"])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"mesh{request['suffix']}")
            write_mesh(mesh, path)
            return path.read_bytes()

    def _map(self, resolution_m: float = np.inf) -> NeuralMap:
        """All regions as one map, unless a mesh of it would be too large."""
        neural_map = NeuralMap(self._regions.values())
        near_m3 = 0.0
        for region in neural_map.regions:
            mask = region.stored.mask
            near_m3 += np.count_nonzero(mask.flags & NEAR_SURFACE) * mask.voxel_m**3
        if near_m3 / resolution_m**3 > MAX_MESH_CELLS:
            raise MapError(
                f"a mesh of {resolution_m} m is too fine for this map; choose a coarser one"
            )
        return neural_map


def main() -> None:
    """Serve on the socket whose number is the program's argument, until it is closed."""
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except OSError:  # containers may forbid it
        os.nice(19)
    limit_threads(1, load_open3d=False)
    channel = Channel(socket.socket(fileno=int(sys.argv[1])))
    worker = MapWorker()
    while True:
        try:
            header, block = worker.answer(*channel.receive())
            channel.send(header, block)
        except (EOFError, OSError):
            return


if __name__ == "__main__":
    main()
