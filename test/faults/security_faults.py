"""Input that is made to do harm: code, lengths that lie, names that lead elsewhere."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import resource
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from data.stored_maps import resealed
from faults import material
from faults.bench import Bench
from faults.expectations import ended, refused, run, seen_of
from faults.fault import Group, Seen, faults_of

GIGABYTE = 1 << 30
ROOM = 6 * GIGABYTE
"""Of addresses, torch's libraries included; what a lie asks for is more."""


class Exploit:
    """Touches a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def __reduce__(self) -> tuple[Callable[..., int], tuple[str]]:
        return os.system, (f"touch '{self._file}'",)


def bounded() -> None:
    """In a new process: who believes a length that lies gets no memory."""
    resource.setrlimit(resource.RLIMIT_AS, (ROOM, ROOM))


def _harmless(*words: str) -> Callable[[Seen], str]:
    """Refused in words, and what an attacker wanted did not happen."""

    def problem(seen: Seen) -> str:
        if seen.facts["bench"].joinpath("owned").exists():
            return "foreign code ran"
        return refused(*words)(seen)

    return problem


def _pickled_points(bench: Bench) -> Seen:
    payload = np.array([Exploit(bench.folder / "owned")], object)
    np.save(bench.folder / "points.npy", payload, allow_pickle=True)
    return _asked(bench)


def _pickled_map(bench: Bench) -> Seen:
    stored = bench.copy(material.stored_map(bench), "harmed.meslam")
    region = next(stored.glob("region_*"))
    region.write_bytes(pickle.dumps(Exploit(bench.folder / "owned")))
    return _told(bench, bench.meslam("info", stored, before=bounded))


def _code_in_settings(bench: Bench) -> Seen:
    command = f"__import__('os').system('touch {bench.folder / 'owned'}')"
    done = [
        bench.meslam("run", material.bag(bench), "--out", "out", "--set", text)
        for text in (
            f"mapping.iterations={command}",
            f"mapping.iterations=!!python/object/apply:os.system ['touch {bench.folder}/owned']",
            "__class__.__init__=1",
        )
    ]
    return _told(bench, *done)


def _asked(bench: Bench) -> Seen:
    options = ("--points", "points.npy", "--out", "answers.npy")
    return _told(bench, bench.meslam("query", material.stored_map(bench), *options, before=bounded))


def _told(bench: Bench, *done: object) -> Seen:
    seen = seen_of(bench, *done)
    return Seen(seen.words, {**seen.facts, "bench": bench.folder})


def _lying_points(bench: Bench) -> Seen:
    with (bench.folder / "points.npy").open("wb") as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**13, 3)}
        np.lib.format.write_array_header_1_0(file, header)
        file.write(b"\0" * 240)
    return _asked(bench)


def _png(width: int, height: int) -> bytes:
    """A PNG that claims a size; behind it is a small stream of zeros."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    body = zlib.compress(b"\0" * 1_000_000)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def _image_bomb(bench: Bench) -> Seen:
    recording = bench.copy(material.tum(bench))
    for image in (recording / "depth").iterdir():
        image.write_bytes(_png(60_000, 60_000))
    return run(bench, recording, before=bounded)


def _camera_bomb(bench: Bench) -> Seen:
    recording = bench.copy(material.tum(bench))
    camera = json.loads((recording / "camera.json").read_text())
    (recording / "camera.json").write_text(json.dumps(camera | {"width": 10**9, "height": 10**9}))
    return run(bench, recording, before=bounded)


def _yaml_bomb(bench: Bench) -> Seen:
    """A billion laughs."""
    recording = bench.copy(material.bag(bench).parent)
    lines = ['a0: &a0 ["ha","ha"]']
    lines += [f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    lines += ["rosbag2_bagfile_information: *a11"]
    (recording / "metadata.yaml").write_text("\n".join(lines))
    return run(bench, recording, before=bounded)


def _listed_elsewhere(bench: Bench) -> Seen:
    recording = bench.copy(material.tum(bench))
    for name in ("rgb.txt", "depth.txt"):
        text = (recording / name).read_text()
        (recording / name).write_text(
            text.replace(" rgb/", " ../../rgb/").replace(" depth/", " /etc/")
        )
    return run(bench, recording)


def _manifest_elsewhere(name: str) -> Callable[[Bench], Seen]:
    def inject(bench: Bench) -> Seen:
        stored = bench.copy(material.stored_map(bench), "harmed.meslam")
        secret = bench.copy(next(stored.glob("region_*")), "region_0_0_0.0123456789abcdef.msr")
        manifest = stored / "manifest.json"
        document = json.loads(manifest.read_bytes())
        document["regions"][0]["file"] = name.format(secret)
        manifest.write_bytes(resealed(document))
        return _told(bench, bench.meslam("info", stored, before=bounded))

    return inject


def _read_no_other_file(seen: Seen) -> str:
    """The map is put together from its own files, or refused."""
    return ended("manifest.json", status=2)(seen)


def _huge(name: str) -> Callable[[Bench], Seen]:
    """A file of 40 GB that takes no room on the disk."""

    def inject(bench: Bench) -> Seen:
        stored = bench.copy(material.stored_map(bench), "harmed.meslam")
        os.truncate(next(stored.glob(name)), 40 * GIGABYTE)
        return _told(bench, bench.meslam("info", stored, before=bounded))

    return inject


def _inflating(bench: Bench) -> Seen:
    """A region of some kilobytes that unpacks to 2 GB, and says so or not; checksums are right."""
    import zstandard

    packer = zstandard.ZstdCompressor(level=1).compressobj(size=2 * GIGABYTE)
    payload = b"".join(packer.compress(b"\0" * (1 << 24)) for _ in range(128)) + packer.flush()
    done = []
    for claimed in (2 * GIGABYTE, 4096):
        stored = bench.copy(material.stored_map(bench), f"harmed{claimed}.meslam")
        region = next(stored.glob("region_*"))
        head = struct.pack("<8sIIQQ", b"MESLAMRG", 1, 0, len(payload), claimed)
        data = head + hashlib.sha256(head + payload).digest() + payload
        region.unlink()
        name = f"region_0_0_0.{hashlib.sha256(data).hexdigest()[:16]}.msr"
        (stored / name).write_bytes(data)
        manifest = json.loads((stored / "manifest.json").read_bytes())
        manifest["regions"][0] |= {
            "file": name,
            "sha256": hashlib.sha256(data).hexdigest(),
            "bytes": len(data),
        }
        (stored / "manifest.json").write_bytes(resealed(manifest))
        done.append(bench.meslam("info", stored, before=bounded))
    return _told(bench, *done)


def _message_lies(bench: Bench) -> Seen:
    """Images whose messages claim four billion rows."""
    recording = bench.copy(material.bag(bench, "db3"))
    data = recording.read_bytes()
    size = struct.pack("<II", 120, 160)
    recording.write_bytes(data.replace(size, struct.pack("<II", 0xFFFFFFF0, 0xFFFFFFF0)))
    return run(bench, recording, before=bounded)


def _escape_codes(bench: Bench) -> Seen:
    """A name that would rewrite the terminal."""
    recording = bench.folder / "\x1b[2J\x1b]0;owned\x07.mcap"
    shutil.copyfile(material.bag(bench), recording)
    recording.write_bytes(recording.read_bytes()[:1000])
    done = bench.meslam("info", recording)
    return Seen("a terminal's control codes in a name", {"ended": (done,)})


def _no_codes(seen: Seen) -> str:
    (told,) = seen.facts["ended"]
    if told.unexplained:
        return str(told.unexplained)
    return "control codes reach the terminal" if "\x1b" in told.stderr + told.stdout else ""


_fault = faults_of(Group.SECURITY)
FAULTS = (
    _fault(
        "pickle-in-points",
        "the file of points is a pickle that runs a command",
        "refused; the command does not run",
        _pickled_points,
        _harmless("points.npy"),
    ),
    _fault(
        "pickle-in-map",
        "a region's file is a pickle that runs a command",
        "refused; the command does not run",
        _pickled_map,
        _harmless("region_0_0_0"),
        harmed=("harmed.meslam",),
    ),
    _fault(
        "code-in-settings",
        "settings hold Python code and a YAML object that runs a command",
        "refused; the command does not run",
        _code_in_settings,
        _harmless(),
    ),
    _fault(
        "points-that-lie",
        "a file of points says that it holds ten billion times what it does",
        "refused before memory is taken",
        _lying_points,
        _harmless("points.npy"),
    ),
    _fault(
        "image-bomb",
        "depth PNGs of a kilobyte that say they are 60000 pixels wide and high",
        "refused before memory is taken; the file is named",
        _image_bomb,
        refused(".png"),
    ),
    _fault(
        "camera-bomb",
        "camera.json says that images are a billion pixels wide and high",
        "refused before memory is taken; the file is named",
        _camera_bomb,
        refused("camera.json"),
    ),
    _fault(
        "yaml-bomb",
        "metadata.yaml of a kilobyte that unfolds to a terabyte",
        "refused before memory is taken; the recording is named",
        _yaml_bomb,
        refused("recording", "metadata"),
    ),
    _fault(
        "list-leads-elsewhere",
        "a TUM folder's lists name files above the folder, and below /etc",
        "refused; the line is named",
        _listed_elsewhere,
        refused("line"),
    ),
    _fault(
        "manifest-leads-elsewhere",
        "a map's manifest, with a right checksum, names a region's file above the folder",
        "the name is refused; the map's own files are used, and that is told",
        _manifest_elsewhere("../region_0_0_0.0123456789abcdef.msr"),
        _read_no_other_file,
        harmed=("harmed.meslam",),
    ),
    _fault(
        "manifest-leads-to-the-root",
        "a map's manifest, with a right checksum, names a region's file by its absolute path",
        "the name is refused; the map's own files are used, and that is told",
        _manifest_elsewhere("{}"),
        _read_no_other_file,
        harmed=("harmed.meslam",),
    ),
    _fault(
        "region-of-40-gb",
        "a region's file has grown to 40 GB",
        "refused before memory is taken; the file is named",
        _huge("region_*"),
        refused("region_0_0_0"),
        harmed=("harmed.meslam",),
    ),
    _fault(
        "manifest-of-40-gb",
        "a map's manifest has grown to 40 GB",
        "not read; the map's own files are used, or it is refused; the file is named",
        _huge("manifest.json"),
        refused("manifest.json"),
        harmed=("harmed.meslam",),
    ),
    _fault(
        "region-that-inflates",
        "a region of kilobytes, with right checksums, unpacks to 2 GB; its size lies or not",
        "refused before memory is taken",
        _inflating,
        refused("region_0_0_0"),
        harmed=("harmed2147483648.meslam", "harmed4096.meslam"),
    ),
    _fault(
        "messages-that-lie",
        "a bag's images say that they have four billion rows and columns",
        "refused before memory is taken",
        _message_lies,
        refused(),
    ),
    _fault(
        "escape-codes-in-a-name",
        "a damaged recording's name holds codes that would rewrite the terminal",
        "the message shows them as text",
        _escape_codes,
        _no_codes,
    ),
)
