"""A small file of librealsense's own recorder, made by that recorder."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import pyrealsense2 as rs
from data.software_camera import PERIOD_MS, SoftwareCamera

START_MS = 1.7e12


def recorded(pairs: int = 4) -> bytes:
    """The bytes of a .db3 file with a few pairs of images."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.db3"
        camera = SoftwareCamera()
        recorder = rs.recorder(str(path), camera.device)
        sensors = recorder.query_sensors()
        for sensor in sensors:
            sensor.open(sensor.get_stream_profiles())
            sensor.start(lambda frame: None)
        for number in range(pairs):
            camera.send(number, START_MS + number * PERIOD_MS)
            # The recorder drops what comes while it is writing.
            time.sleep(0.05)
        for sensor in sensors:
            sensor.stop()
            sensor.close()
        del recorder, sensors, sensor
        return path.read_bytes()
