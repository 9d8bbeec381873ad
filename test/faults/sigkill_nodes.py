"""Kill all nodes at once, at random images of a run: python test/faults/sigkill_nodes.py

Every trial starts `slam_node` and a player on one `map_folder`, kills every process (SIGKILL) some
time after a random image, and loads what the map server kept without being asked. At last a map
server is started on the folder, which must serve the newest map that was kept.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "test"))

from data import ros_domain  # noqa: E402
from data.bag_builder import aligned_bag  # noqa: E402
from data.textured_room import frame_at, path  # noqa: E402

from meslam_core.errors import MeslamError  # noqa: E402
from meslam_core.map.lock import locked  # noqa: E402
from meslam_core.map.manifest import MANIFEST  # noqa: E402
from meslam_core.map.store import MapStore  # noqa: E402
from meslam_interfaces.srv import ListRegions  # noqa: E402
from meslam_ros import topics  # noqa: E402
from meslam_ros.client import MeslamClient  # noqa: E402
from meslam_ros.processes import NodeProcess, ros_arguments  # noqa: E402

RECORD = ROOT / "docs/reliability/sigkill_nodes.json"
FRAMES = 20
LONGEST_WAIT_S = 1.0
STARTING_S = 600.0
SETTINGS = {
    "regions.volume_m3": 3.0,
    "keyframes.rays": 1024,
    "mapping.first_iterations": 60,
    "mapping.iterations": 4,
    "mapping.keyframe_iterations": 8,
    "mapping.final_iterations": 10,
    "model_period_s": 0.1,
    "idle_s": 0.3,
    "keep_period_s": 0.1,
}


@dataclass(frozen=True)
class Kill:
    """One trial.

    Attributes:
        number: of the trial.
        image: after which all processes were killed.
        wait_s: so long after it [s].
        maps: that were kept so far and load whole.
        unfinished: folders of maps whose first save did not end.
        lost: what is wrong with the others; empty when nothing is.
    """

    number: int
    image: int
    wait_s: float
    maps: int
    unfinished: int
    lost: str


def family(process: int) -> list[int]:
    """A process and all that it started, the youngest first."""
    try:
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        children = []
    return [pid for child in children for pid in family(int(child))] + [process]


def kill_all(processes: Sequence[NodeProcess]) -> None:
    """End processes and what they started, before any of them can react."""
    for process in processes:
        process.signal(signal.SIGSTOP)
    for process in processes:
        for pid in family(process.pid) if process.status is None else []:
            os.kill(pid, signal.SIGKILL)
        process.wait(STARTING_S)


def trial(recording: Path, folder: Path, number: int) -> Kill:
    """Kill the system after a random image, and look at the maps that were kept."""
    generator = Random(number)
    image, wait_s = generator.randint(1, FRAMES), generator.uniform(0.0, LONGEST_WAIT_S)
    importlib.reload(ros_domain).enter()
    nodes = ros_arguments(SETTINGS | {"map_folder": folder / "maps"})
    player = ros_arguments({"recording": recording, "rate": 0.0, "wait_timeout_s": STARTING_S})
    processes = []
    with MeslamClient("killer", domain_id=int(os.environ["ROS_DOMAIN_ID"])) as client:
        try:
            for name, arguments in (("slam_node", nodes), ("bag_player_node", player)):
                processes.append(NodeProcess(name, arguments, log=folder / f"{name}.log"))
            # A client that came late has missed the first ones.
            if not client.spin_until(
                lambda: len(client.statuses) >= image or client.settled, STARTING_S
            ):
                raise RuntimeError((folder / "slam_node.log").read_text()[-3000:])
            time.sleep(wait_s)
        finally:
            kill_all(processes)
    return looked_at(folder / "maps/recent", number, image, round(wait_s, 3))


def looked_at(folder: Path, number: int, image: int, wait_s: float) -> Kill:
    """What became of the maps in a folder."""
    whole, unfinished, lost = 0, 0, ""
    for path_ in sorted(folder.iterdir()) if folder.is_dir() else []:
        if not (path_ / MANIFEST).exists():
            unfinished += 1
            continue
        try:
            loaded = MapStore(path_).load()
            with locked(path_):
                whole += bool(loaded.regions) and not loaded.warnings
            lost = lost or "; ".join(loaded.warnings)
        except MeslamError as error:
            lost = lost or str(error)
    return Kill(number, image, wait_s, whole, unfinished, lost)


def served_again(folder: Path) -> str:
    """Start a map server on the folder; what it serves, and whether that is the newest map."""
    importlib.reload(ros_domain).enter()
    maps = [path_ for path_ in (folder / "maps/recent").iterdir() if (path_ / MANIFEST).exists()]
    newest = max(maps, key=lambda path_: (path_ / MANIFEST).stat().st_mtime_ns)
    arguments = ros_arguments({"map_folder": folder / "maps"})
    server = NodeProcess("map_server_node", arguments, log=folder / "server.log")
    try:
        with MeslamClient("asker", domain_id=int(os.environ["ROS_DOMAIN_ID"])) as client:
            answer = client.call(ListRegions, topics.LIST_REGIONS, timeout_s=STARTING_S)
    finally:
        server.stop()
    expected = MapStore(newest).manifest()
    same = answer.regions.map_id == expected.map_id
    same = same and len(answer.regions.regions) == len(expected.regions)
    return f"{len(answer.regions.regions)} regions, {'the newest map' if same else 'another map'}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Do the trials; exit status 1 when anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--record", type=Path, default=RECORD, help="where the table is kept")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="sigkill-") as name:
        folder = Path(name)
        frames = [frame_at(pose, n) for n, pose in enumerate(path(FRAMES, 0.03, 1.5))]
        recording = aligned_bag(frames, folder)
        kills: list[Kill] = []
        for number in range(given.trials):
            kills.append(trial(recording, folder, number))
            print(kills[-1], flush=True)
            _write(given.record, kills, "")
        served = served_again(folder)
    print(f"a map server on what is left serves {served}")
    _write(given.record, kills, served)
    lost = [kill for kill in kills if kill.lost]
    return 1 if lost or "newest" not in served else 0


def _write(record: Path, kills: list[Kill], served: str) -> None:
    document = {
        "kills_survived": sum(not kill.lost for kill in kills),
        "kills_total": len(kills),
        "served_afterwards": served,
        "kills": [asdict(kill) for kill in kills],
    }
    record.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
