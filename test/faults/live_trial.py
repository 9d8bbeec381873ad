"""A fault in running nodes: they were well before, must be well afterwards, and nothing is lost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from data import ros_domain
from faults.bench import Bench
from faults.fault import Fault, Group, Seen
from faults.live_graph import LiveGraph, live_graph

from meslam_interfaces.msg import TrackingStatus
from meslam_interfaces.srv import SaveMap
from meslam_ros import topics

CAMERA_SIDE = ("odometry_node", "tracking_node")
WITH_MAP = ("map_server_node", *CAMERA_SIDE)
STATES = ("INITIALISING", "OK", "DEGRADED", "LOST", "RELOCALISING")

Disturbance = Callable[[LiveGraph], str]


def live(
    name: str,
    injected: str,
    expected: str,
    disturb: Disturbance,
    nodes: tuple[str, ...] = WITH_MAP,
    same_map: bool = True,
    from_start: bool = False,
    quick: bool = False,
    alone: bool = False,
    limit_s: float = 120.0,
    **parameters: Any,
) -> Fault:
    """A fault in a running graph.

    Args:
        name, injected, expected, quick, alone, limit_s: of the fault.
        disturb: does it, asserts what must be seen meanwhile, and tells it in words.
        nodes: to start. With a map server, the map is saved at the end and must load.
        same_map: whether tracking must go on in the map from before.
        from_start: whether it is so before there is a map.
        parameters: of all nodes.
    """

    def inject(bench: Bench) -> Seen:
        ros_domain.enter()
        with live_graph(bench.folder, nodes=nodes, **parameters) as graph:
            try:
                return Seen(f"{_trial(graph, disturb, same_map, from_start)}", {"problem": ""})
            except AssertionError as error:
                (bench.folder / "logs.txt").write_text(graph.logs())
                return Seen("", {"problem": str(error).split("\n")[0]})

    return Fault(
        name=name,
        group=Group.LIVE,
        injected=injected,
        expected=expected,
        inject=inject,
        problem=lambda seen: str(seen.facts["problem"]),
        limit_s=limit_s,
        quick=quick,
        alone=alone,
    )


def _trial(graph: LiveGraph, disturb: Disturbance, same_map: bool, from_start: bool) -> str:
    before = None if from_start else graph.track_well()
    seen = disturb(graph)
    sent = len(graph.client.statuses)
    after = graph.track_well()
    needed = len(graph.client.statuses) - sent
    goes_on = before is None or after.map_id == before.map_id
    assert goes_on or not same_map, "a new map was begun"
    if "map_server_node" in graph.processes:
        graph.settle()
        saved = graph.client.call(SaveMap, topics.SAVE_MAP, SaveMap.Request(name="room.meslam"))
        assert saved.result == saved.SUCCESS, f"the map is not saved: {saved.message}"
    graph.assert_alive()
    statuses = graph.stop()
    assert not any(statuses), f"exit statuses {statuses}"
    return f"{seen}; OK again, {needed} images later"


def refused(answers: list[TrackingStatus], *words: str) -> str:
    """None of the images was tracked, and each answer says why, with all words; in words."""
    for answer in answers:
        assert answer.state != TrackingStatus.OK, f"an image that cannot be used is OK: {words}"
        missing = [word for word in words if word not in answer.reason]
        assert not missing, f"not told: {missing} in {answer.reason!r}"
    return f"{STATES[answers[-1].state]}: {answers[-1].reason}"
