"""The viewer's benchmark: what it makes of what a browser got."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import viewer
from viewer import PlayedRun, Watched, met


def test_rates_are_those_between_the_first_and_the_last_frame() -> None:
    spectator = SimpleNamespace(
        moves=[9.0, 10.5, 11.0, 11.5, 12.0, 15.0],
        meshes=[9.5, 11.0, 12.0, 13.5, 20.0],
        bytes=[(9.0, 1000), (11.0, 400), (13.0, 400)],
    )
    got = viewer.seen(spectator, [10.0, 11.0, 12.0, 13.0, 14.0], 0.2)
    assert got.first_map_s == pytest.approx(1.0)
    assert got.camera_hz == pytest.approx(1.0)
    assert got.mesh_hz == pytest.approx(1.0)
    assert got.longest_gap_s == pytest.approx(1.5)
    assert got.bytes_per_s == pytest.approx(200.0)


@pytest.mark.parametrize(
    ("changed", "loss", "good"),
    [({}, 0.04, True), ({}, 0.06, False), ({"camera_hz": 9.0}, 0.0, False)],
)
def test_all_targets_must_be_met(changed, loss, good) -> None:
    numbers = {
        "first_map_s": 2.0,
        "camera_hz": 15.0,
        "mesh_hz": 1.1,
        "longest_gap_s": 1.2,
        "bytes_per_s": 1e5,
        "viewer_cpu": 0.3,
    }
    pair = PlayedRun(15.0, None), PlayedRun(14.5, Watched(**numbers | changed))
    assert met([pair], loss) == good
