"""The benchmark of lost cameras: what its table says."""

from __future__ import annotations

import io

import numpy as np
import pytest
import relocalisation
from rich.console import Console

from meslam_core.evaluation.relocalisation import COVERED, UNSEEN, Outcome, Trial
from meslam_core.slam import TrackingState


def outcome(kind: str, found_s: float | None, error_m: float = np.nan, wrong: int = 0) -> Outcome:
    states = (TrackingState.LOST, TrackingState.OK if found_s is not None else TrackingState.LOST)
    return Outcome(Trial(kind, 3, 2), 1.5, 0.5, found_s, error_m, 0.01, 0.0, wrong, states, "")


def test_a_camera_is_found_when_it_is_soon_and_right():
    found = [
        outcome(COVERED, 0.1, 0.01),
        outcome(COVERED, 0.5, 0.3, wrong=2),
        outcome(COVERED, 2.2, 0.01),
        outcome(COVERED, None),
    ]
    summary = relocalisation.summary(found)
    assert (summary["trials"], summary["found"], summary["called_found"]) == (4, 1, 3)
    assert (summary["median_s"], summary["max_s"]) == (0.5, 2.2)
    assert summary["max_error_m"] == 0.3
    assert summary["wrong_frames"] == 2


def test_never_found_is_shown_as_such():
    summary = relocalisation.summary([outcome(UNSEEN, None)] * 3)
    assert summary["median_s"] is None
    text = io.StringIO()
    Console(file=text, width=140).print(relocalisation.table({"room": {UNSEEN: summary}}))
    assert "0 of 3" in text.getvalue()


def test_trials_are_written_without_what_json_lacks():
    entry = relocalisation.as_entry(outcome(UNSEEN, None))
    assert entry["error_m"] is None
    assert entry["states"] == "33"


def test_a_recording_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("MESLAM_DATA", str(tmp_path))
    with pytest.raises(SystemExit, match="tum_fr1_xyz"):
        relocalisation.located("tum_fr1_xyz", None)
    path, truth = relocalisation.located("room", tmp_path / "mine.mcap")
    assert path == tmp_path / "mine.mcap"
    assert truth == tmp_path / "mine.truth.txt"
