"""Every command in the documents names what exists: nodes, parameters, arguments, services."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import typer
import yaml

from meslam_core.cli import app
from meslam_core.config import settings
from meslam_ros import node_settings, topics
from meslam_ros.call_service import fill, interface
from meslam_ros.launch_plan import ARGUMENTS
from meslam_ros.parameters import node_settings as entries_of
from meslam_ros.viewer_settings import ViewerSettings

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [
    path
    for path in (ROOT / "README.md", ROOT / "bags/README.md", *sorted((ROOT / "docs").glob("*.md")))
    if path.name != "decisions.md"
]
METHOD = {entry.path for entry in settings()}
FRAMES = (node_settings.FrameSettings, node_settings.InputSettings)
NODES = {
    "odometry_node": (*FRAMES, node_settings.OdometrySettings),
    "tracking_node": (*FRAMES, node_settings.TrackingSettings),
    "region_manager_node": (node_settings.MapFrameSettings, node_settings.RegionManagerSettings),
    "map_server_node": (node_settings.MapFrameSettings, node_settings.MapServerSettings),
    "bag_player_node": (node_settings.PlayerSettings,),
    "camera_node": (node_settings.CameraSettings,),
    "viewer_node": (node_settings.FrameSettings, ViewerSettings),
}
SERVICES = {f"/{value}": name for name, value in vars(topics).items() if name.isupper()}


@cache
def parameters(node: str) -> frozenset[str]:
    """All parameters of a node, by the settings it declares."""
    if node == "slam_node":
        return frozenset().union(*(parameters(name) for name in NODES))
    own = {entry.name for kind in NODES[node] for entry in entries_of(kind)}
    return frozenset(own | METHOD | {"use_sim_time", "autostart"})


def commands(path: Path) -> Iterator[list[str]]:
    """The words of every command in a document's shell blocks."""
    for block in re.findall(r"```bash\n(.*?)```", path.read_text(), re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words:
                yield words


def assignments(words: list[str], flag: str | None = None) -> Iterator[tuple[str, str]]:
    """`name:=value` pairs; only those after a flag such as -p where one is given."""
    for before, word in zip(["", *words], words, strict=False):
        if ":=" in word and (flag is None or before == flag):
            name, _, value = word.partition(":=")
            yield name, value


def check_node(name: str, arguments: list[str]) -> None:
    assert name in {*NODES, "slam_node"}, name
    for parameter, _ in assignments(arguments, "-p"):
        assert parameter in parameters(name), f"{name} has no parameter {parameter}"


def check_service(name: str, kind: str, request: str = "{}") -> None:
    assert name in SERVICES or name == "/bag_player_node/pause", name
    fill(interface(kind).Request(), yaml.safe_load(request))


def check_launch(arguments: list[str]) -> None:
    for name, value in assignments(arguments):
        assert name in ARGUMENTS, f"the launch file has no argument {name}"
        choices = ARGUMENTS[name].choices
        assert not choices or value in choices, f"{name}:={value}"


def check(words: list[str]) -> None:
    """Check one command, if it is one of this project."""
    match words:
        case ["ros2", "run", "meslam_ros", node, *rest]:
            check_node(node, rest)
        case ["ros2", "launch", "meslam_ros", name, *rest]:
            assert (ROOT / "src" / "meslam_ros" / "launch" / name).is_file()
            check_launch(rest)
        case ["ros2", "service", "call", name, kind, *rest] if name.startswith("/"):
            check_service(name, kind, *rest)
        case ["ros2", "topic", "echo", name, *_]:
            assert name in SERVICES, name
        case ["meslam", command, *_] if not command.startswith("-"):
            known = typer.main.get_command(app).commands[command]
            options = {option for parameter in known.params for option in parameter.opts}
            used = {word for word in words if word.startswith("--")}
            assert used <= options, used - options
        case ["make", target, *_]:
            assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        case [node, *rest] if node in {*NODES, "slam_node"}:
            check_node(node, rest)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_commands_name_what_exists(path: Path) -> None:
    for words in commands(path):
        try:
            check(words)
        except Exception as error:
            raise AssertionError(f"{path.name}: {' '.join(words)}: {error}") from error


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        linked = path.parent / name if name else path
        assert linked.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", linked.read_text(), re.MULTILINE)
            slugs = {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}
            assert anchor in slugs, target


def yaml_block(document: str, name: str) -> dict:
    """A YAML example that a comment names."""
    text = (ROOT / "docs" / document).read_text()
    match = re.search(rf"<!-- {name} -->\n```yaml\n(.*?)```", text, re.DOTALL)
    assert match is not None, name
    return yaml.safe_load(match[1])


def test_the_robots_parameters_are_the_nodes() -> None:
    values = yaml_block("nav2.md", "robot.yaml")["/**"]["ros__parameters"]
    known = {entry.name: entry for entry in entries_of(node_settings.MapServerSettings)}
    for name, value in values.items():
        known[name].checked(value)


def test_nav2_is_told_what_the_nodes_publish() -> None:
    values = yaml_block("nav2.md", "nav2.yaml")
    costmap = values["global_costmap"]["global_costmap"]["ros__parameters"]
    layer = costmap["static_layer"]
    assert layer["map_topic"] == f"/{topics.OCCUPANCY_GRID}"
    assert layer["map_subscribe_transient_local"] is True
    assert set(costmap["plugins"]) <= set(costmap)
    assert costmap["global_frame"] == node_settings.MapFrameSettings().map_frame
    assert values["bt_navigator"]["ros__parameters"]["odom_topic"] == f"/{topics.ODOMETRY}"
