"""What the doctor says of ROS and DDS: each fault, and real processes that exchange images."""

from __future__ import annotations

import json
import mmap
import subprocess
import sys
from pathlib import Path

import pytest

from meslam_core.doctor import Finding, Status
from meslam_core.doctor.diagnosis import examinations
from meslam_ros.doctor import fast_dds, installation
from meslam_ros.doctor.exchange import COUNT, examine_exchange, exchanged

PROFILE = """<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
<transport_descriptors><transport_descriptor><segment_size>{}</segment_size>
</transport_descriptor></transport_descriptors></profiles>"""
LOADED = {"middleware": "rmw_fastrtps_cpp"}


def only(findings) -> Finding:
    [finding] = findings
    return finding


def test_the_package_adds_its_examination(tmp_path):
    assert "ROS" in examinations(tmp_path)


@pytest.mark.parametrize(
    ("name", "status"), [("jazzy", Status.OK), ("humble", Status.WARN), ("", Status.FAIL)]
)
def test_distribution(name, status):
    finding = installation.distribution(name)
    assert finding.status is status
    assert ("env.bash" in finding.remedy) == (status is not Status.OK)


def test_what_is_installed_here_can_be_loaded():
    assert {finding.status for finding in installation.libraries(installation.probe)} == {Status.OK}


def test_without_ros_rclpy_cannot_be_loaded(monkeypatch):
    monkeypatch.setattr(installation, "PROBE", "import rclpy_that_is_not_there")
    finding = only(installation.libraries(installation.probe))
    assert (finding.subject, finding.status) == ("rclpy", Status.FAIL)
    assert "rclpy_that_is_not_there" in finding.told
    assert "env.bash" in finding.remedy


def test_an_rclpy_that_ends_the_process_is_told(monkeypatch):
    monkeypatch.setattr(installation, "PROBE", "import os; os.abort()")
    finding = only(installation.libraries(installation.probe))
    assert finding.status is Status.FAIL
    assert "-6" in finding.told


def test_an_rclpy_that_hangs_is_told(monkeypatch):
    monkeypatch.setattr(installation, "PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(installation, "IMPORT_S", 0.3)
    assert only(installation.libraries(installation.probe)).status is Status.FAIL


def test_interfaces_that_are_not_built():
    found = list(installation.libraries(lambda: {**LOADED, "interfaces": "ImportError: none"}))
    finding = next(each for each in found if each.subject == "meslam_interfaces")
    assert finding.status is Status.FAIL
    assert "make build" in finding.remedy


def test_another_middleware():
    found = list(installation.libraries(lambda: {"middleware": "rmw_cyclonedds_cpp"}))
    finding = next(each for each in found if each.subject == "middleware")
    assert finding.status is Status.WARN
    assert "RMW_IMPLEMENTATION" in finding.remedy


@pytest.mark.parametrize(
    ("text", "status"),
    [
        ("", Status.OK),
        ("42", Status.OK),
        ("150", Status.WARN),
        ("233", Status.FAIL),
        ("-1", Status.FAIL),
    ],
)
def test_domain(text, status):
    finding = fast_dds.domain(text)
    assert finding.status is status
    assert ("ROS_DOMAIN_ID=N" in finding.remedy) == (status is not Status.OK)


def unreachable() -> bool:
    raise OSError("Network is unreachable")


def test_multicast():
    assert fast_dds.multicast(lambda: True).status is Status.OK
    for arrives in (lambda: False, unreachable):
        finding = fast_dds.multicast(arrives)
        assert finding.status is Status.WARN
        assert "multicast on" in finding.remedy


def test_the_image_profile(tmp_path):
    file = tmp_path / "profile.xml"
    environment = {fast_dds.PROFILES: str(file)}
    assert fast_dds.profile({}).status is Status.WARN
    assert fast_dds.profile(environment).status is Status.FAIL
    for text, status in (
        ("<profiles", Status.FAIL),
        (PROFILE.format(524288), Status.WARN),
        (PROFILE.format(33554432), Status.OK),
    ):
        file.write_text(text)
        finding = fast_dds.profile(environment)
        assert finding.status is status
        assert ("env.bash" in finding.remedy) == (status is not Status.OK)


@pytest.mark.parametrize(
    ("free_mb", "status"), [(60.0, Status.FAIL), (150.0, Status.WARN), (1000.0, Status.OK)]
)
def test_small_shared_memory(free_mb, status):
    finding = fast_dds.segments(free_mb, Path("/dev/shm"))
    assert finding.status is status
    assert ("--shm-size" in finding.remedy) == (status is not Status.OK)


def test_no_shared_memory(tmp_path):
    assert fast_dds.room(tmp_path / "shm").status is Status.WARN


def test_files_of_killed_programs_are_stale(tmp_path):
    used, left = tmp_path / "fastrtps_aaaa", tmp_path / "fastrtps_port7411"
    for file in (used, left, tmp_path / "fastrtps_aaaa_el", tmp_path / "something"):
        file.write_bytes(bytes(4096))
    with used.open("r+b") as opened, mmap.mmap(opened.fileno(), 0):
        assert fast_dds.stale_files(tmp_path, Path("/proc")) == [left]
    finding = fast_dds.leftovers([left])
    assert finding.status is Status.WARN
    assert "fastdds shm clean" in finding.remedy
    assert fast_dds.leftovers([]).status is Status.OK


@pytest.mark.parametrize(
    ("got", "sent", "status"),
    [(30, 30, Status.OK), (20, 30, Status.WARN), (0, 0, Status.FAIL)],
)
def test_images_that_are_lost(got, sent, status):
    finding = exchanged(got, sent, 5.0)
    assert finding.status is status
    assert bool(finding.remedy) == (status is not Status.OK)


def test_two_processes_exchange_images():
    """With real DDS; how many a loaded computer loses is not the point."""
    finding = examine_exchange()
    assert finding.status in (Status.OK, Status.WARN), finding.told
    assert f"of {COUNT}" in finding.told or finding.status is Status.WARN


def test_a_listener_that_hears_nothing_ends():
    listen = [sys.executable, "-m", "meslam_ros.doctor.exchange", "listen", "/meslam_nobody"]
    ended = subprocess.run([*listen, "--limit", "1"], capture_output=True, text=True, check=True)
    assert json.loads(ended.stdout)["got"] == 0
