from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory

from meslam_ros import topics

SHARE = Path(get_package_share_directory("meslam_ros"))
KNOWN = {f"/{value}" for name, value in vars(topics).items() if name.isupper()}
KNOWN |= {value for name, value in vars(topics).items() if name.isupper()}


def values_of(tree: Any) -> Iterator[str]:
    """All texts in nested lists and mappings, keys included."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from values_of(key)
            yield from values_of(value)
    elif isinstance(tree, list):
        for value in tree:
            yield from values_of(value)
    elif isinstance(tree, str):
        yield tree


@pytest.mark.parametrize("name", ["meslam.rviz", "meslam.foxglove.json"])
def test_layouts_show_topics_that_exist(name: str) -> None:
    text = (SHARE / "config" / name).read_text()
    tree = json.loads(text) if name.endswith("json") else yaml.safe_load(text)
    shown = {value.partition(".")[0] for value in values_of(tree) if value.startswith("/")}
    assert shown <= KNOWN
    for needed in (topics.MESH, topics.REGION_MARKERS, topics.PATH, topics.OCCUPANCY_GRID):
        assert f"/{needed}" in shown


def test_launch_file_starts_the_nodes() -> None:
    launch = pytest.importorskip("launch", reason="launch comes with a ROS installation only")
    pytest.importorskip("launch_ros", reason="launch_ros comes with a ROS installation only")
    path = SHARE / "launch" / "meslam.launch.py"
    spec = importlib.util.spec_from_file_location("meslam_launch", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    description = module.generate_launch_description()
    assert isinstance(description, launch.LaunchDescription)
    executables = {getattr(entity, "node_executable", None) for entity in description.entities}
    assert set(module.NODES) <= executables
