"""Fast DDS: domain, discovery, the profile for images, and shared memory."""

from __future__ import annotations

import os
import shutil
import socket
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from xml.etree import ElementTree

from meslam_core.doctor import Finding, fail, ok, warn
from meslam_ros.input_silence import PROFILES

# Domains above collide with the ports that Linux hands out to other programs.
LAST_GOOD_DOMAIN, LAST_DOMAIN = 101, 232
# Fast DDS looks for others there.
GROUP, LOOPBACK = "239.255.0.1", "127.0.0.1"
MULTICAST_S = 1.0
IMAGE_BYTES = 640 * 480 * 3
SHARED_MEMORY = Path("/dev/shm")
PROCESSES = Path("/proc")
SEGMENT_MB = 33.6
# Camera, SLAM, and whoever looks on: a segment each.
LEAST_SEGMENTS, WANTED_SEGMENTS = 2, 6
LOAD_PROFILE = "run `source env.bash`, or `export {}=/path/to/config/fastdds.xml`, in every program"
CLEAN = (
    "when no ROS program runs here or in another container: "
    "`rm -f /dev/shm/fastrtps_* /dev/shm/sem.fastrtps_*` (or `fastdds shm clean`)"
)


def examine_fast_dds() -> Iterator[Finding]:
    """Domain, multicast, profile and shared memory."""
    yield domain(os.environ.get("ROS_DOMAIN_ID", ""))
    yield multicast(multicast_arrives)
    yield profile(os.environ)
    yield room(SHARED_MEMORY)
    yield leftovers(stale_files(SHARED_MEMORY, PROCESSES))


def domain(text: str) -> Finding:
    """Whether the domain's ports are free for it."""
    number = int(text) if text.isdecimal() else 0
    if text and (not text.isdecimal() or number > LAST_DOMAIN):
        remedy = f"run `export ROS_DOMAIN_ID=N` with N from 0 to {LAST_GOOD_DOMAIN}, or unset it"
        return fail("domain", f"ROS_DOMAIN_ID={text} is no domain", remedy)
    told = f"{number}" if text else "0, as ROS_DOMAIN_ID is not set"
    if number > LAST_GOOD_DOMAIN:
        remedy = f"use one up to {LAST_GOOD_DOMAIN}: `export ROS_DOMAIN_ID=N`"
        return warn("domain", f"{told}: its ports may belong to other programs", remedy)
    return ok("domain", told)


def multicast_arrives() -> bool:
    """Whether a datagram to Fast DDS's group comes back on the loopback device.

    Raises:
        OSError: when the group cannot be joined, or nothing can be sent to it.
    """
    kind = (socket.AF_INET, socket.SOCK_DGRAM)
    with closing(socket.socket(*kind)) as listening, closing(socket.socket(*kind)) as sending:
        listening.bind(("", 0))
        listening.settimeout(MULTICAST_S)
        device = socket.inet_aton(LOOPBACK)
        membership = struct.pack("4s4s", socket.inet_aton(GROUP), device)
        listening.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        sending.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, device)
        sending.sendto(b"meslam", (GROUP, listening.getsockname()[1]))
        try:
            return listening.recv(16) == b"meslam"
        except TimeoutError:
            return False


def multicast(arrives: Callable[[], bool]) -> Finding:
    """Whether programs on this computer can find each other."""
    try:
        reason = "" if arrives() else "nothing sent to it arrives"
    except OSError as error:
        reason = str(error)
    if not reason:
        return ok("multicast", "works on the loopback device")
    remedy = (
        "run `sudo ip link set lo multicast on`, and allow 239.255.0.0/16 and UDP ports from 7400 "
        "in the firewall; in a container use `--network host`"
    )
    return warn("multicast", f"{GROUP} on the loopback device: {reason}", remedy)


def profile(environment: Mapping[str, str]) -> Finding:
    """Whether Fast DDS is told to make its shared memory large enough for images."""
    subject, remedy = "image profile", LOAD_PROFILE.format(PROFILES)
    name = environment.get(PROFILES) or environment.get("FASTDDS_DEFAULT_PROFILES_FILE", "")
    if not name:
        return warn(subject, f"{PROFILES} is not set: images will be lost", remedy)
    try:
        document = ElementTree.parse(name)
    except (OSError, ElementTree.ParseError) as error:
        return fail(subject, f"{name} cannot be read: {error}", remedy)
    # Names carry a namespace, which differs between versions.
    sizes = [each.text for each in document.iter() if each.tag.endswith("segment_size")]
    largest = max((int(text) for text in sizes if text and text.isdecimal()), default=0)
    if largest < IMAGE_BYTES:
        told = f"{name}: shared memory of {largest} bytes is smaller than an image"
        return warn(subject, told, f"add a SHM transport with a segment_size, or {remedy}")
    return ok(subject, name)


def room(folder: Path) -> Finding:
    """Whether every program gets its segment of shared memory."""
    try:
        usage = shutil.disk_usage(folder)
    except OSError as error:
        remedy = "mount it: `mount -t tmpfs shm /dev/shm`; without it images travel by UDP"
        return warn("shared memory", f"{folder} cannot be used: {error}", remedy)
    return segments(usage.free / 1e6, folder)


def segments(free_mb: float, folder: Path) -> Finding:
    """Judge what is free of the shared memory [MB]."""
    told = f"{free_mb:.0f} MB free in {folder}, a program takes {SEGMENT_MB:.0f} MB"
    remedy = (
        "in a container, start it with `--shm-size 1g` or `--ipc host`; else "
        f"`sudo mount -o remount,size=1G {folder}`"
    )
    if free_mb < LEAST_SEGMENTS * SEGMENT_MB:
        return fail("shared memory", told, remedy)
    if free_mb < WANTED_SEGMENTS * SEGMENT_MB:
        return warn("shared memory", told, remedy)
    return ok("shared memory", told)


def stale_files(folder: Path, processes: Path) -> list[Path]:
    """Fast DDS's files of this user that no process has mapped."""
    mapped = set()
    for maps in processes.glob("[0-9]*/maps"):
        try:
            lines = maps.read_text().splitlines()
        except OSError:
            # Of another user, or gone.
            continue
        mapped |= {line.split()[-1] for line in lines if "fastrtps_" in line}
    stale = []
    for file in folder.glob("fastrtps_*"):
        try:
            own = file.stat().st_uid == os.getuid()
        except OSError:
            continue
        # Locks are not mapped, and go with their segment.
        if own and not file.name.endswith(("_el", "_sl")) and str(file) not in mapped:
            stale.append(file)
    return stale


def leftovers(stale: list[Path]) -> Finding:
    """Whether programs that were killed have left shared memory behind."""
    if not stale:
        return ok("stale files", "none")
    size_mb = sum(file.stat().st_size for file in stale if file.exists()) / 1e6
    told = (
        f"{len(stale)} of {size_mb:.0f} MB, left by killed programs; who gets the same port "
        "hears nothing"
    )
    return warn("stale files", told, CLEAN)
