"""What the doctor says of each fault, and how `meslam doctor` says it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from typer.testing import CliRunner

from meslam_core import cli_doctor
from meslam_core.cli import app
from meslam_core.doctor import (
    Finding,
    Status,
    devices,
    diagnosis,
    fail,
    ok,
    packages,
    processor,
    storage,
    warn,
)
from meslam_core.doctor.diagnosis import Area, diagnose, examinations, gravest

PINS = {"numpy": "2.4.6", "torch": "2.13.0", "pyrealsense2": "2.59.1"}


def installed(**changed: str | None):
    """The pinned versions, but for some, or without some."""
    versions = {**PINS, "torch": "2.13.0+cpu", **changed}

    def version(name: str) -> str:
        found = versions[name]
        if found is None:
            raise metadata.PackageNotFoundError(name)
        return found

    return version


def only(findings) -> Finding:
    [finding] = findings
    return finding


def test_nothing_is_wrong_without_a_remedy():
    with pytest.raises(ValueError, match="without a remedy"):
        Finding("disk", Status.FAIL, "full")


@pytest.mark.parametrize(
    ("version", "status"),
    [
        ((3, 11), Status.OK),
        ((3, 12), Status.OK),
        ((3, 10), Status.FAIL),
        ((3, 13), Status.WARN),
    ],
)
def test_python(version, status):
    finding = packages.python_version(version)
    assert finding.status is status
    assert ("MESLAM_PYTHON" in finding.remedy) == (status is not Status.OK)


def test_pinned_packages_are_one_line():
    finding = only(packages.pinned_packages(PINS, installed()))
    assert finding == ok("packages", "all 3 are the pinned versions")


def test_a_missing_package():
    finding = only(packages.pinned_packages(PINS, installed(torch=None)))
    assert (finding.subject, finding.status) == ("torch", Status.FAIL)
    assert "make setup" in finding.remedy


def test_a_missing_package_that_not_everybody_needs():
    finding = only(packages.pinned_packages(PINS, installed(pyrealsense2=None)))
    assert finding.status is Status.WARN
    assert "RealSense" in finding.told


def test_a_package_of_another_version():
    finding = only(packages.pinned_packages(PINS, installed(numpy="1.26.4")))
    assert finding.status is Status.WARN
    assert "1.26.4" in finding.told
    assert "numpy==2.4.6" in finding.remedy


def test_the_pins_are_those_of_the_repository(tmp_path):
    assert {"numpy", "torch", "typer", "open3d-cpu"} <= set(packages.pins())
    assert packages.pins(tmp_path / "requirements.txt") == {}
    assert only(packages.pinned_packages({}, installed())).status is Status.OK


@pytest.mark.parametrize(
    ("reason", "isas", "environment", "status", "words"),
    [
        ("", ("amx", "avx2", "portable"), {}, Status.OK, "AMX"),
        ("no _kernel", (), {}, Status.FAIL, "make build"),
        ("", ("avx2", "portable"), {"MESLAM_KERNEL_ISA": "avx2"}, Status.WARN, "unset"),
    ],
)
def test_kernel(reason, isas, environment, status, words):
    finding = processor.kernel_path(reason, isas, environment)
    assert finding.status is status
    assert words in finding.told + finding.remedy


def test_a_processor_without_vectors_is_slow(monkeypatch):
    monkeypatch.setattr(processor.platform, "machine", lambda: "x86_64")
    assert processor.kernel_path("", ("portable",), {}).status is Status.WARN


def test_cores_are_those_of_the_containers_quota(tmp_path):
    quota = tmp_path / "cpu.max"
    allowed = len(os.sched_getaffinity(0))
    assert processor.usable_cores(quota) == allowed
    quota.write_text("max 100000\n")
    assert processor.usable_cores(quota) == allowed
    quota.write_text("50000 100000\n")
    assert processor.usable_cores(quota) == 0.5


def test_one_core_is_few():
    finding = processor.cores(1.0, 8)
    assert finding.status is Status.WARN
    assert "--cpus" in finding.remedy
    assert processor.cores(2.0, 8).status is Status.OK


def test_threads_that_are_bound_to_cores():
    assert processor.thread_binding({"OMP_PROC_BIND": "false"}).status is Status.OK
    finding = processor.thread_binding({"OMP_PROC_BIND": "true"})
    assert finding.status is Status.WARN
    assert "unset OMP_PROC_BIND" in finding.remedy


@pytest.mark.parametrize(
    ("free_mb", "status"),
    [(500.0, Status.FAIL), (1000.0, Status.WARN), (4000.0, Status.OK), (None, Status.OK)],
)
def test_memory(free_mb, status):
    assert storage.memory(free_mb).status is status


def test_memory_is_that_of_the_container(tmp_path):
    known, limit, used = (tmp_path / name for name in ("meminfo", "max", "current"))
    known.write_text("MemTotal: 9000000 kB\nMemAvailable: 4000000 kB\n")
    assert storage.free_memory_mb(known, limit, used) == pytest.approx(4096.0)
    limit.write_text("1000000000\n")
    used.write_text("400000000\n")
    assert storage.free_memory_mb(known, limit, used) == pytest.approx(600.0)
    limit.write_text("max\n")
    assert storage.free_memory_mb(known, limit, used) == pytest.approx(4096.0)


@pytest.mark.parametrize(
    ("free", "status"), [(5e7, Status.FAIL), (1e9, Status.WARN), (9e9, Status.OK)]
)
def test_disk(monkeypatch, tmp_path, free, status):
    usage = storage.shutil._ntuple_diskusage(1e10, 0, free)
    monkeypatch.setattr(storage.shutil, "disk_usage", lambda _: usage)
    assert storage.disk(tmp_path / "not" / "there" / "yet").status is status


def test_a_folder_that_is_a_file(tmp_path):
    (tmp_path / "results").write_text("")
    finding = storage.disk(tmp_path / "results")
    assert finding.status is Status.FAIL
    assert "--out" in finding.remedy


def refused() -> list[tuple[str, str]]:
    raise ImportError("No module named 'pyrealsense2'")


@pytest.mark.parametrize(
    ("opened", "on_bus", "rules", "status", "words"),
    [
        (list, 0, False, Status.OK, "recordings work without"),
        (lambda: [("D435", "3.2")], 1, True, Status.OK, "D435, USB 3.2"),
        (lambda: [("D435", "2.1")], 1, True, Status.WARN, "USB 3 port"),
        (list, 1, False, Status.WARN, "99-realsense-libusb.rules"),
        (list, 1, True, Status.WARN, "--device-cgroup-rule"),
        (refused, 0, False, Status.WARN, "pip install pyrealsense2"),
    ],
)
def test_cameras(opened, on_bus, rules, status, words):
    finding = only(devices.cameras(opened, on_bus, rules))
    assert finding.status is status
    assert words in finding.told + finding.remedy


def test_a_camera_on_the_bus_is_counted(tmp_path):
    for name, vendor, product in (("1-1", "8086", "0b07"), ("1-2", "046d", "c077")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "idVendor").write_text(f"{vendor}\n")
        (tmp_path / name / "idProduct").write_text(f"{product}\n")
    (tmp_path / "usb1").mkdir()
    assert devices.plugged_in(tmp_path) == 1


def test_without_a_screen_the_viewer_is_elsewhere():
    assert "ssh -L" in devices.browser({}, True).told
    assert "ssh -L" not in devices.browser({"DISPLAY": ":0"}, True).told


def broken():
    yield ok("one", "is fine")
    raise OSError("nobody is there")


def test_an_examination_that_breaks_is_a_finding():
    [area] = diagnose({"things": broken})
    assert [finding.status for finding in area.findings] == [Status.OK, Status.FAIL]
    assert "nobody is there" in area.findings[-1].told


def test_the_gravest_decides():
    fine, odd, bad = ok("a", "b"), warn("a", "b", "c"), fail("a", "b", "c")
    for findings, status in (((fine,), "ok"), ((odd, fine), "warn"), ((odd, bad), "fail")):
        assert gravest([Area("things", findings)]) == status


def test_without_ros_it_is_said_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setattr(diagnosis.metadata, "entry_points", lambda group: [])
    finding = only(examinations(tmp_path)["ROS"]())
    assert finding.status is Status.WARN
    assert "source env.bash" in finding.remedy


def test_what_another_package_looks_at_belongs_to_it(monkeypatch, tmp_path):
    point = metadata.EntryPoint("lidar", f"{__name__}:absent", diagnosis.ENTRY_POINTS)
    monkeypatch.setattr(diagnosis.metadata, "entry_points", lambda group: [point])
    [area] = diagnose({"lidar": examinations(tmp_path)["lidar"]})
    assert area.findings[0].status is Status.FAIL


@pytest.fixture
def doctor(monkeypatch):
    """`meslam doctor` of a machine with given findings."""

    def run(*findings: Finding, arguments: tuple[str, ...] = ()):
        wanted = {"things": lambda: findings}
        monkeypatch.setattr(diagnosis, "examinations", lambda folder: wanted)
        return CliRunner().invoke(app, ["doctor", *arguments])

    return run


def test_the_table_has_the_remedy(doctor):
    shown = doctor(warn("disk", "nearly full", "free some"))
    assert shown.exit_code == 0
    assert "nearly full" in shown.stdout
    assert "-> free some" in shown.stdout


def test_a_failure_is_the_exit_status(doctor):
    assert doctor(fail("disk", "full", "free some")).exit_code == cli_doctor.UNHEALTHY


def test_json_holds_every_finding(doctor):
    shown = doctor(ok("cores", "2"), fail("disk", "full", "free"), arguments=("--json",))
    assert shown.exit_code == cli_doctor.UNHEALTHY
    told = json.loads(shown.stdout)
    assert told["status"] == "fail"
    assert told["areas"]["things"][1] == {
        "subject": "disk",
        "status": "fail",
        "told": "full",
        "remedy": "free",
    }


def test_this_machine_can_be_examined_without_ros(tmp_path):
    """With the sources alone on the path, as where no workspace is sourced."""
    source = Path(packages.__file__).resolve().parents[2]
    program = "from meslam_core.cli import main; main()"
    ended = subprocess.run(
        [sys.executable, "-c", program, "doctor", "--json", "--out", str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(source)},
        capture_output=True,
        text=True,
        check=False,
    )
    told = json.loads(ended.stdout)
    assert {"Python", "computing", "storage", "devices", "ROS"} <= set(told["areas"])
    subjects = {finding["subject"] for area in told["areas"].values() for finding in area}
    assert {"Python", "kernel", "torch", "memory", "disk", "meslam_ros"} <= subjects
    assert (ended.returncode == cli_doctor.UNHEALTHY) == (told["status"] == "fail")
