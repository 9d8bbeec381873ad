"""Records that rest on disk."""

from __future__ import annotations

import os

import pytest

from meslam_core.errors import OutputError
from meslam_core.scratch import Record, ScratchFile


def test_records_come_back_as_they_went(tmp_path):
    scratch = ScratchFile(str(tmp_path))
    records = [scratch.put(b"x" * n, b"end") for n in (0, 1, 5000)]
    for n, record in zip((0, 1, 5000), records, strict=True):
        assert scratch.get(record) == b"x" * n + b"end"


def test_nothing_is_left_behind_however_the_program_ends(tmp_path):
    scratch = ScratchFile(str(tmp_path))
    scratch.put(b"x" * 10000)
    assert os.listdir(tmp_path) == []


def test_a_released_place_is_used_again_by_a_record_of_its_size(tmp_path):
    scratch = ScratchFile(str(tmp_path))
    kept, released = scratch.put(b"kept"), scratch.put(b"gone")
    scratch.release(released)
    size = scratch.size
    assert scratch.get(scratch.put(b"here")) == b"here"
    assert scratch.size == size
    scratch.put(b"longer")
    assert scratch.size == size + 6
    assert scratch.get(kept) == b"kept"


def test_the_folder_is_made_where_it_is_missing(tmp_path):
    assert ScratchFile(str(tmp_path / "a" / "b")).put(b"x") == Record(0, 1)


def test_a_place_that_cannot_be_written_is_named_with_the_remedy(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file: .*runtime\.work_dir"):
        ScratchFile(str(tmp_path / "file"))


def test_a_failed_write_loses_nothing(tmp_path, monkeypatch):
    scratch = ScratchFile(str(tmp_path))
    kept = scratch.put(b"kept")

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "pwrite", full)
        with pytest.raises(OutputError, match="No space left"):
            scratch.put(b"more")
    assert scratch.get(kept) == b"kept"
    assert scratch.get(scratch.put(b"more")) == b"more"
