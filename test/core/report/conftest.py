"""Runs to report on: copies of one that was really made, beside its recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from data.image_folders import write_folder
from data.run_folders import copied_run


@pytest.fixture(scope="session")
def walk(tmp_path_factory, room_frames) -> Path:
    """The recording of `finished_run` on disk."""
    return write_folder(tmp_path_factory.mktemp("recording") / "walk", room_frames)


@pytest.fixture
def make_run(tmp_path, finished_run, walk) -> Callable[..., Path]:
    """Copies the finished run under a name, with other entries in its report.json."""

    def make(name: str = "run", **entries: object) -> Path:
        return copied_run(
            finished_run.out, tmp_path / name, **{"recording_path": str(walk), **entries}
        )

    return make
