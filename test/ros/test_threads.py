from __future__ import annotations

import cv2
import pytest
import torch

from meslam_ros.managed_node import ManagedNode
from meslam_ros.map_server_node import MapServerNode
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.tracking_node import TrackingNode


@pytest.mark.parametrize("kind", [OdometryNode, TrackingNode, MapServerNode])
@pytest.mark.parametrize("count", [1, 2])
def test_nodes_keep_libraries_to_their_threads(
    start_node, tmp_path, monkeypatch, kind: type[ManagedNode], count: int
) -> None:
    monkeypatch.chdir(tmp_path)
    before = cv2.getNumThreads(), torch.get_num_threads()
    try:
        cv2.setNumThreads(3 - count)
        torch.set_num_threads(3 - count)
        start_node(kind, runtime__threads=count)
        assert (cv2.getNumThreads(), torch.get_num_threads()) == (count, count)
    finally:
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])
