"""The RViz configuration and the Foxglove layout show what the nodes publish."""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory

from meslam_ros import topics
from meslam_ros.launch_plan import SHOWN

ROOT = Path(__file__).resolve().parents[2]
CONFIG = Path(get_package_share_directory("meslam_ros")) / "config"
DOCUMENT = (ROOT / "docs" / "interfaces.md").read_text()
# What a display subscribes to.
RVIZ_TYPES = {
    "Marker": "visualization_msgs/Marker",
    "MarkerArray": "visualization_msgs/MarkerArray",
    "Path": "nav_msgs/Path",
    "PoseWithCovariance": "geometry_msgs/PoseWithCovarianceStamped",
    "PointCloud2": "sensor_msgs/PointCloud2",
    "Map": "nav_msgs/OccupancyGrid",
    "Image": "sensor_msgs/Image",
}
WITHOUT_TOPIC = {"Grid", "TF"}


def documented() -> dict[str, tuple[str, str]]:
    """Type and quality of every topic in docs/interfaces.md, by its absolute name."""
    rows = re.findall(r"^\| `([^`]+)` \| `(\w+/\w+)` \|([^\n]*)\|$", DOCUMENT, re.MULTILINE)
    return {"/" + name.lstrip("/"): (kind, rest) for name, kind, rest in rows}


@pytest.fixture(scope="module")
def rviz() -> dict[str, Any]:
    return yaml.safe_load((CONFIG / "meslam.rviz").read_text())


@pytest.fixture(scope="module")
def foxglove() -> dict[str, Any]:
    return json.loads((CONFIG / "meslam.foxglove.json").read_text())


def displays(rviz: dict[str, Any]) -> list[dict[str, Any]]:
    return rviz["Visualization Manager"]["Displays"]


def kind(display: dict[str, Any]) -> str:
    package, _, name = display["Class"].partition("/")
    assert package == "rviz_default_plugins", "a plugin would have to be installed"
    return name


def test_rviz_displays_show_topics_of_their_type_with_a_quality_that_fits(rviz) -> None:
    known = documented()
    for display in displays(rviz):
        if kind(display) in WITHOUT_TOPIC:
            continue
        topic = display["Topic"]
        message_type, quality = known[topic["Value"]]
        assert message_type == RVIZ_TYPES[kind(display)], topic["Value"]
        latched = "latched" in quality
        # A volatile reader would miss what was published before it came.
        expected = "Transient Local" if latched else "Volatile"
        assert topic["Durability Policy"] == expected, topic["Value"]


def test_rviz_shows_everything_at_once(rviz) -> None:
    shown = {d["Topic"]["Value"]: d["Enabled"] for d in displays(rviz) if "Topic" in d}
    assert set(shown) == {f"/{topic}" for topic in SHOWN}
    # Points show the same surfaces as the mesh; they are there to be switched on.
    assert [topic for topic, enabled in shown.items() if not enabled] == [f"/{topics.MAP_POINTS}"]
    assert "TF" in {kind(display) for display in displays(rviz)}
    assert rviz["Visualization Manager"]["Global Options"]["Fixed Frame"] == "map"


def panels(tree: Any) -> Iterator[str]:
    """Panels that a Foxglove layout places."""
    if isinstance(tree, str):
        yield tree
    else:
        for side in ("first", "second"):
            yield from panels(tree[side])


def test_foxglove_places_the_panels_it_configures(foxglove) -> None:
    assert sorted(panels(foxglove["layout"])) == sorted(foxglove["configById"])


def test_foxglove_shows_topics_that_exist(foxglove) -> None:
    panel = foxglove["configById"]["3D!map"]
    for topic in SHOWN:
        shown = f"/{topic}" in panel["topics"]
        assert shown or topic == topics.COLOR
    assert set(panel["topics"]) <= set(documented())
    assert panel["followTf"] == "map"
    image = foxglove["configById"]["Image!color"]["imageMode"]
    assert image["imageTopic"] == f"/{topics.COLOR}"
    assert image["calibrationTopic"] == f"/{topics.COLOR_INFO}"


def test_foxglove_plots_fields_that_exist(foxglove) -> None:
    known = documented()
    paths = [
        series["value"]
        for name, panel in foxglove["configById"].items()
        if name.startswith("Plot!")
        for series in panel["paths"]
    ]
    assert paths
    for path in paths:
        topic, _, name = path.partition(".")
        package, _, message = known[topic][0].partition("/")
        fields = getattr(importlib.import_module(f"{package}.msg"), message)
        assert name in fields.get_fields_and_field_types(), path
