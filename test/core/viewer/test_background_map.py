"""Meshes and occupancy out of the map process."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from meslam_core.errors import MapError
from meslam_core.map.codec import encode
from meslam_core.map.stored_region import StoredRegion
from meslam_core.viewer.background_map import GROWING_RESOLUTION_M, MAX_FAILURES, BackgroundMap
from meslam_core.viewer.scene import Scene, ViewControls

WAIT_S = 60.0
HERE, BESIDE = (0, 0, 0), (1, 0, 0)


def wait_for(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@dataclass
class Watched:
    scene: Scene
    controls: ViewControls
    map: BackgroundMap
    eyes: threading.Event

    def version(self, index: tuple[int, int, int]) -> int:
        surface = self.scene.surfaces.value.get(index)
        return -1 if surface is None else surface.version


@pytest.fixture(scope="module")
def shared() -> Iterator[Watched]:
    scene, controls, eyes = Scene(), ViewControls(mesh_resolution_m=0.05), threading.Event()
    background = BackgroundMap(scene, controls, eyes.is_set)
    yield Watched(scene, controls, background, eyes)
    background.close()


@pytest.fixture
def watched(shared: Watched) -> Watched:
    """Somebody who looks at an empty map."""
    shared.map.begin()
    shared.controls.occupancy_shown = False
    shared.eyes.set()
    wait_for(lambda: not shared.scene.surfaces.value)
    return shared


def test_a_region_is_meshed_coarsely_then_finely(watched: Watched, region: StoredRegion) -> None:
    watched.map.take(HERE, region.version, encode(region))
    wait_for(lambda: watched.version(HERE) == region.version)
    assert watched.scene.surfaces.value[HERE].resolution_m == GROWING_RESOLUTION_M
    wait_for(lambda: watched.scene.surfaces.value[HERE].resolution_m == 0.05)
    surface = watched.scene.surfaces.value[HERE]
    assert surface.glb.startswith(b"glTF")
    assert surface.triangles > 1000
    assert np.allclose(surface.bounds, [[-1.4] * 3, [1.4] * 3], atol=0.05)


def test_only_the_region_that_changed_is_meshed_anew(
    watched: Watched, region: StoredRegion
) -> None:
    watched.controls.mesh_resolution_m = 0.1
    neighbour = replace(region, index=BESIDE)
    for each in (region, neighbour):
        watched.map.take(each.index, each.version, encode(each))
    wait_for(lambda: watched.version(BESIDE) >= 0 and watched.version(HERE) >= 0)
    before = watched.scene.surfaces.value[BESIDE]
    changed = replace(region, version=region.version + 1)
    watched.map.take(HERE, changed.version, encode(changed))
    wait_for(lambda: watched.version(HERE) == changed.version)
    assert watched.scene.surfaces.value[BESIDE] is before


def test_nothing_is_done_while_nobody_looks(watched: Watched, region: StoredRegion) -> None:
    watched.eyes.clear()
    revision = watched.scene.surfaces.revision
    watched.map.take(HERE, region.version, encode(region))
    # An export is done whoever looks, and after everything before it.
    assert watched.map.export(0.1, ".ply").startswith(b"ply")
    assert watched.scene.surfaces.revision == revision
    watched.eyes.set()
    wait_for(lambda: watched.version(HERE) == region.version)


def test_the_slice_follows_its_height(watched: Watched, region: StoredRegion) -> None:
    watched.controls.occupancy_shown = True
    watched.map.take(HERE, region.version, encode(region))
    wait_for(lambda: watched.scene.occupancy.value is not None)
    middle = watched.scene.occupancy.value
    assert middle is not None
    row, column = np.floor(-middle.origin[::-1] / middle.resolution_m).astype(int)
    assert middle.height_m == 0.0
    assert middle.cells[row, column + 8] == 100, "the ball's inside, near its surface"
    assert middle.cells[row, column + 18] == 0, "the room"
    watched.controls.occupancy_height_m = 0.9
    wait_for(lambda: watched.scene.occupancy.value.height_m == 0.9)
    above = watched.scene.occupancy.value
    assert above.cells[row, column] == 0, "above the ball"


def test_damaged_and_mistaken_models_are_left_out(watched: Watched, region: StoredRegion) -> None:
    data = encode(region)
    watched.map.take(BESIDE, 1, data)
    watched.map.take((2, 0, 0), 1, data[:-7])
    watched.map.take(HERE, region.version, data)
    wait_for(lambda: watched.version(HERE) == region.version)
    assert set(watched.scene.surfaces.value) == {HERE}


def test_what_cannot_be_exported_says_why(watched: Watched, region: StoredRegion) -> None:
    with pytest.raises(MapError, match="no region"):
        watched.map.export(0.05, ".ply")
    watched.map.take(HERE, region.version, encode(region))
    with pytest.raises(MapError, match="too fine"):
        watched.map.export(0.001, ".ply")
    with pytest.raises(MapError, match="choose one of them"):
        watched.map.export(0.1, ".docx")
    assert watched.map.export(0.1, ".glb").startswith(b"glTF")


def test_a_killed_process_is_replaced(watched: Watched, region: StoredRegion) -> None:
    os.kill(watched.map.process.pid, signal.SIGKILL)
    watched.map.take(HERE, region.version, encode(region))
    wait_for(lambda: watched.version(HERE) == region.version)


def test_a_process_that_ends_again_and_again_is_given_up() -> None:
    background = BackgroundMap(Scene(), ViewControls(), lambda: False)
    try:
        for _ in range(MAX_FAILURES + 1):
            process = background.process
            os.kill(process.pid, signal.SIGKILL)
            # Asking finds that it has ended.
            with pytest.raises(MapError, match=r"has ended; try again|no mesh any more"):
                background.export(0.1, ".ply")
            wait_for(lambda ended=process: background.process is not ended or background.given_up)
        with pytest.raises(MapError, match="no mesh any more"):
            background.export(0.1, ".ply")
    finally:
        background.close()


def test_the_process_works_only_when_no_other_program_does(watched: Watched) -> None:
    wait_for(lambda: os.sched_getscheduler(watched.map.process.pid) == os.SCHED_IDLE)
