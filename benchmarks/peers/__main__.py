"""Run one peer over a recording: `python -m peers tsdf RECORDING --out DIR`, in benchmarks/."""

from __future__ import annotations

import argparse
import ast
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from meslam_core.recordings import open_recording
from peers.peer import Peer, run_peer
from peers.pose_graph_slam import PoseGraphSlam, PoseGraphSlamConfig
from peers.tsdf_slam import TsdfSlam, TsdfSlamConfig

PEERS: dict[str, tuple[type[Any], Callable[[Any], Peer]]] = {
    "tsdf": (TsdfSlamConfig, TsdfSlam),
    "pose_graph": (PoseGraphSlamConfig, PoseGraphSlam),
}


def parsed_slice(text: str) -> slice:
    """`A:B[:STEP]` as a slice."""
    return slice(*(int(part) if part else None for part in text.split(":")))


def configured(kind: type[Any], settings: Sequence[str]) -> Any:
    """A configuration with `name=value` settings applied; tuples as `(1, 2)`."""
    values = dict(setting.split("=", 1) for setting in settings)
    return dataclasses.replace(kind(), **{k: ast.literal_eval(v) for k, v in values.items()})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("method", choices=PEERS)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=parsed_slice, default=slice(None), metavar="A:B:STEP")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    options = parser.parse_args()
    config_type, peer_type = PEERS[options.method]
    config = configured(config_type, options.set)
    recording = open_recording(options.recording)
    try:
        run = run_peer(peer_type(config), recording, options.frames)
    finally:
        recording.close()
    run.write(options.out, dataclasses.asdict(config))


if __name__ == "__main__":
    main()
