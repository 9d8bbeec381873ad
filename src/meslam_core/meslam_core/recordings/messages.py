"""Raw ROS messages out of a bag file, whatever its storage."""

from __future__ import annotations

import logging
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Protocol

from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_typestore

from meslam_core.errors import RecordingError

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
ROS1_MAGIC = b"#ROSBAG V2.0\n"

_ROS1_STAMP = struct.Struct("<4xII")
_CDR_STAMP = {0: struct.Struct(">4xiI"), 1: struct.Struct("<4xiI")}

logger = logging.getLogger(__name__)


class MessageSource(Protocol):
    """Messages of a bag in the order in which they were recorded."""

    format: str
    types: dict[str, str]
    """Topics that have messages, and their types as `package/msg/Name`."""

    def messages(
        self, topics: Collection[str], start_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """(topic, time of recording [ns], serialised message) of `topics`, from `start_ns` on.

        The order is the same on every call.

        Raises:
            RecordingError: where the data is damaged.
        """
        ...

    def stamp_ns(self, raw: bytes) -> int:
        """Header stamp [ns] of a serialised message that begins with a header."""
        ...

    def deserialize(self, raw: bytes, topic: str) -> Any:
        """The message as an object with the fields of its type.

        Raises:
            RecordingError: when the bytes do not fit the type.
        """
        ...

    def close(self) -> None:
        """Release the file; idempotent."""
        ...


class _Serialization:
    """Reads ROS 1 or CDR bytes with the definitions of the common interfaces.

    Bags may lack definitions, or carry some that rosbags cannot parse; the few messages that are
    needed here never changed, so the stock definitions always serve.
    """

    types: dict[str, str]

    def __init__(self, name: str, ros1: bool) -> None:
        self._name = name
        self._ros1 = ros1
        self._typestore = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)

    def stamp_ns(self, raw: bytes) -> int:
        try:
            if self._ros1:
                seconds, nanoseconds = _ROS1_STAMP.unpack_from(raw)
            else:
                seconds, nanoseconds = _CDR_STAMP[raw[1] & 1].unpack_from(raw)
        except (struct.error, IndexError) as error:
            raise RecordingError(
                f"{self._name} holds a message without a header; "
                "record topics of images with stamps"
            ) from error
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def deserialize(self, raw: bytes, topic: str) -> Any:
        read = self._typestore.deserialize_ros1 if self._ros1 else self._typestore.deserialize_cdr
        try:
            return read(raw, self.types[topic])
        # The deserialiser lets struct, numpy and decoding errors through.
        except Exception as error:
            raise RecordingError(
                f"{self._name}: a message on {topic} is not a valid {self.types[topic]} ({error})"
            ) from error


class BagSource(_Serialization):
    """A rosbag2 folder, a single .mcap or .db3 file, or a ROS 1 .bag, through rosbags."""

    def __init__(self, path: Path, ros1: bool = False) -> None:
        """Open the bag.

        Raises:
            RecordingError: when the bag is damaged, or its index is missing.
        """
        super().__init__(path.name, ros1)
        self._path = path
        self.format = "ROS 1 bag" if ros1 else _rosbag2_format(path)
        self._reader = _open_reader(path, ros1)
        self._open = True
        self.types = {
            connection.topic: connection.msgtype
            for connection in self._reader.connections
            if connection.msgcount
        }

    def messages(
        self, topics: Collection[str], start_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        connections = [entry for entry in self._reader.connections if entry.topic in topics]
        if not connections:
            return
        messages = self._reader.messages(connections, start=start_ns)
        while True:
            try:
                connection, time_ns, raw = next(messages)
            except StopIteration:
                return
            # rosbags lets the errors of sqlite, zstd, lz4 and struct through.
            except Exception as error:
                raise RecordingError(
                    f"{self._path} is damaged: {error}; record it again, or restore a copy"
                ) from error
            yield connection.topic, time_ns, bytes(raw)

    def close(self) -> None:
        if self._open:
            self._open = False
            self._reader.close()


class TruncatedMcapSource(_Serialization):
    """An .mcap whose recorder was interrupted: no index and no end, but whole chunks before it."""

    format = "rosbag2 mcap (truncated)"

    def __init__(self, path: Path) -> None:
        """Find out what can be read.

        Raises:
            RecordingError: when no message can be read.
        """
        super().__init__(path.name, ros1=False)
        self._path = path
        self.types = {}
        count = 0
        for topic, schema, _ in self._records():
            self.types[topic] = schema
            count += 1
        if count == 0:
            raise RecordingError(
                f"{path} is truncated and holds no complete message; record it again"
            )
        logger.warning(
            "%s is truncated; recovered the %d messages before the break. "
            "`mcap recover` writes a whole file",
            path,
            count,
        )

    def _records(self) -> Iterator[tuple[str, str, Message]]:
        schemas: dict[int, str] = {0: ""}
        channels: dict[int, tuple[str, str]] = {}
        with self._path.open("rb") as stream:
            records = StreamReader(stream, validate_crcs=True).records
            while True:
                try:
                    record = next(records)
                except (StopIteration, McapError):
                    return
                # A half-written record can fail in any decoder: that is where the file ends.
                except Exception as error:
                    logger.debug("%s ends with %r", self._path, error)
                    return
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = (record.topic, schemas.get(record.schema_id, ""))
                elif isinstance(record, Message) and record.channel_id in channels:
                    yield *channels[record.channel_id], record

    def messages(
        self, topics: Collection[str], start_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        for topic, _, message in self._records():
            if topic in topics and (start_ns is None or message.log_time >= start_ns):
                yield topic, message.log_time, message.data

    def close(self) -> None:
        """Nothing stays open between iterations."""


def open_source(path: Path) -> MessageSource:
    """Open a bag by its content.

    Raises:
        RecordingError: when it is damaged beyond recovery.
    """
    if path.is_dir():
        return _open_folder(path)
    with path.open("rb") as stream:
        magic = stream.read(16)
    if magic.startswith(ROS1_MAGIC):
        return BagSource(path, ros1=True)
    if magic.startswith(SQLITE_MAGIC):
        _check_sqlite_is_whole(path)
    if magic.startswith(MCAP_MAGIC) and not _ends_with_magic(path):
        return TruncatedMcapSource(path)
    return BagSource(path)


def _open_folder(path: Path) -> MessageSource:
    """Open a rosbag2 folder; a killed recorder leaves a lone file without `metadata.yaml`."""
    files = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    lone = len(files) == 1
    if lone and files[0].suffix == ".mcap" and not _ends_with_magic(files[0]):
        return TruncatedMcapSource(files[0])
    if lone and not (path / "metadata.yaml").exists():
        return open_source(files[0])
    for file in files:
        if file.suffix == ".db3":
            _check_sqlite_is_whole(file)
    return BagSource(path)


def _check_sqlite_is_whole(path: Path) -> None:
    """Raise when pages are missing at the end: SQLite would read zeros in their place."""
    with path.open("rb") as stream:
        header = stream.read(100)
    if len(header) == 100:
        # https://www.sqlite.org/fileformat.html, sections 1.3.2 and 1.3.7; a size of 1 is 65536,
        # and the number of pages counts only where both change counters agree.
        (page_bytes,) = struct.unpack_from(">H", header, 16)
        (pages,) = struct.unpack_from(">I", header, 28)
        valid = header[24:28] == header[92:96]
        if not valid or path.stat().st_size >= pages * (65536 if page_bytes == 1 else page_bytes):
            return
    raise RecordingError(
        f"{path} cannot be read: it is truncated. "
        "`sqlite3 FILE .recover` may save a part of it; else record it again"
    )


def _ends_with_magic(path: Path) -> bool:
    with path.open("rb") as stream:
        stream.seek(0, 2)
        stream.seek(max(0, stream.tell() - len(MCAP_MAGIC)))
        return stream.tell() > 0 and stream.read() == MCAP_MAGIC


def _rosbag2_format(path: Path) -> str:
    if path.is_dir():
        return "rosbag2 folder"
    return "rosbag2 mcap" if path.suffix == ".mcap" else "rosbag2 sqlite3"


def _open_reader(path: Path, ros1: bool) -> Ros1Reader | Ros2Reader:
    reader: Ros1Reader | Ros2Reader | None = None
    try:
        reader = Ros1Reader(path) if ros1 else Ros2Reader(path)
        reader.open()
    # Besides its own errors rosbags lets assertions and those of sqlite and struct through.
    except Exception as error:
        remedy = {
            ".bag": "`rosbag reindex` may repair it",
            ".mcap": "`mcap recover` may repair it",
            ".db3": "`sqlite3 FILE .recover` may repair it",
        }.get(path.suffix, "`ros2 bag reindex` may repair it")
        raise RecordingError(
            f"{path} cannot be read: {error}. "
            f"It is damaged, truncated or was never closed; {remedy}"
        ) from error
    return reader
