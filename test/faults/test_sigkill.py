"""The program that kills whole runs works; what it found out is in docs/reliability."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from faults import sigkill


def test_a_killed_run_leaves_a_map_and_room_for_the_next(tmp_path: Path) -> None:
    record = tmp_path / "sigkill.json"
    command = [sys.executable, sigkill.__file__, "--trials", "1", "--results", "1"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--record", str(record)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    kills = json.loads(record.read_text())["kills"]
    assert [kill["series"] for kill in kills] == ["whole run", "results"]
    assert all(kill["next_run"] == "begins" and kill["regions"] > 0 for kill in kills)


def test_the_record_is_of_two_hundred_killed_runs() -> None:
    record = json.loads(sigkill.RECORD.read_text())
    whole = [kill for kill in record["kills"] if kill["series"] == "whole run"]
    killed = [kill for kill in whole if kill["stage"] != "ended"]
    assert len(killed) >= 200
    assert record["kills_survived"] == record["kills_total"]
