"""Recordings of RGB-D cameras in any known format, and the writer of mcap files."""

from meslam_core.recordings.description import describe
from meslam_core.recordings.recording import Recording
from meslam_core.recordings.registry import open_recording
from meslam_core.recordings.topics import RecordingTopics
from meslam_core.recordings.writer import McapWriter, convert

__all__ = [
    "McapWriter",
    "Recording",
    "RecordingTopics",
    "convert",
    "describe",
    "open_recording",
]
