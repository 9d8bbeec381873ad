"""What a node does not need it does not load: start time and memory on a small computer."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = {"torch", "open3d", "gtsam", "matplotlib"}


@pytest.mark.parametrize(
    ("node", "needed"),
    [
        ("slam_node", set()),
        ("bag_player_node", set()),
        ("region_manager_node", set()),
        ("odometry_node", set()),
        ("viewer_node", set()),
        ("map_server_node", {"torch"}),
        ("tracking_node", {"torch", "gtsam"}),
    ],
)
def test_a_node_loads_only_what_it_needs(node: str, needed: set[str]) -> None:
    program = f"import sys, meslam_ros.{node}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120
    )
    assert HEAVY & set(done.stdout.split()) == needed
