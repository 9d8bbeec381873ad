"""A small file of librealsense's own recorder, made by that recorder."""

from __future__ import annotations

import sqlite3
import tempfile
import time
from pathlib import Path

import pyrealsense2 as rs
from data.software_camera import PERIOD_MS, SoftwareCamera

START_MS = 1.7e12
PAIRS = 4
PAUSES_S = (0.05, 0.2, 1.0, 3.0)
IMAGES = (
    "SELECT count(*) FROM messages JOIN topics ON topics.id = topic_id "
    "WHERE topics.name LIKE '%/image/data%'"
)


def recorded() -> bytes:
    """The bytes of a .db3 file with a few pairs of images."""
    for pause_s in PAUSES_S:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "camera.db3"
            _record(path, pause_s)
            if _images(path) == 2 * PAIRS:
                return path.read_bytes()
    raise RuntimeError("librealsense's recorder drops images on this computer")


def _record(path: Path, pause_s: float) -> None:
    """The recorder drops what comes while it is writing."""
    camera = SoftwareCamera()
    recorder = rs.recorder(str(path), camera.device)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(lambda frame: None)
    for number in range(PAIRS):
        camera.send(number, START_MS + number * PERIOD_MS)
        time.sleep(pause_s)
    for sensor in sensors:
        sensor.stop()
        sensor.close()


def _images(path: Path) -> int:
    database = sqlite3.connect(path)
    try:
        return int(database.execute(IMAGES).fetchone()[0])
    except sqlite3.Error:
        return 0
    finally:
        database.close()
