"""The permissions for SROS2 name every topic and service that there is, and give none away."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from meslam_ros import topics
from meslam_ros.slam_node import NODES

ROOT = Path(__file__).resolve().parents[2]
POLICY = ROOT / "config/security_policy.xml"
ACTIONS = {topics.EXPORT}
SERVICES = {
    *(topics.RESET, topics.PAUSE, topics.USE_MAP, topics.EXPORT_MAP, topics.GET_MESH),
    *(topics.QUERY_OCCUPANCY, topics.GET_OCCUPANCY_GRID, topics.SAVE_MAP, topics.LOAD_MAP),
    *(topics.LIST_REGIONS, topics.PLAYER_PAUSE),
}
INPUTS = {topics.COLOR, topics.DEPTH, topics.COLOR_INFO, topics.DEPTH_INFO}


def names(enclave: str, kind: str, right: str) -> set[str]:
    """What the nodes of an enclave may do something with."""
    found = ElementTree.parse(POLICY).getroot().findall(f".//enclave[@path='/meslam/{enclave}']")
    assert len(found) == 1
    lists = found[0].findall(f".//{kind}s[@{right}='ALLOW']")
    return {entry.text or "" for each in lists for entry in each.findall(kind)}


def all_topics() -> set[str]:
    values = {value for name, value in vars(topics).items() if name.isupper()}
    return values - SERVICES - ACTIONS


def test_every_topic_has_who_publishes_and_who_subscribes() -> None:
    published = names("nodes", "topic", "publish") | names("camera", "topic", "publish")
    taken = names("nodes", "topic", "subscribe") | names("user", "topic", "subscribe")
    assert all_topics() <= published
    assert all_topics() - {t for t in all_topics() if t.startswith("meslam/")} <= taken
    assert "meslam/*" in taken


def test_every_service_has_who_answers_and_who_asks() -> None:
    answered = names("nodes", "service", "reply") | names("camera", "service", "reply")
    assert answered >= SERVICES
    asked = names("user", "service", "request") | names("nodes", "service", "request")
    assert asked >= SERVICES - {topics.PLAYER_PAUSE}
    assert names("nodes", "action", "execute") == names("user", "action", "call") == ACTIONS


def test_a_user_cannot_pretend_to_be_the_camera_or_tracking() -> None:
    published = names("user", "topic", "publish")
    assert published == {"/parameter_events", "/rosout"}
    assert topics.USE_MAP not in names("user", "service", "request")
    assert not INPUTS & names("nodes", "topic", "publish")
    assert names("camera", "topic", "publish") >= INPUTS


def test_every_node_has_a_profile() -> None:
    profiles = {each.get("node") for each in ElementTree.parse(POLICY).getroot().iter("profile")}
    assert {*NODES, "camera_node", "bag_player_node"} <= profiles
