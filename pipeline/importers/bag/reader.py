"""An open bag: its topics, and its messages in order of log time. Errors of the library become errors for the user."""

from __future__ import annotations

import errno
import re
import struct
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, NamedTuple
from urllib.parse import unquote

from scan2sim.pipeline.core.errors import InputError, SpaceError, from_os_error
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.io import file_checks

SUFFIXES = (".mcap", ".db3", ".bag")
METADATA = "metadata.yaml"
REPAIR = {
    ".mcap": "If the recording was interrupted, repair it with `mcap recover`; otherwise copy it again",
    ".db3": "If the recording was interrupted, run `ros2 bag reindex` on its folder; otherwise copy it again",
    ".bag": "If the recording was interrupted, repair it with `rosbag reindex`; otherwise copy it again",
    "": "If the recording was interrupted, run `ros2 bag reindex` on the folder; otherwise copy it again",
}
"""Remedy for a bag that can't be read, by suffix; "" for a folder."""
MCAP_MAGIC, MCAP_HEAD_BYTES = b"\x89MCAP0\r\n", 512
"""Beginning of an MCAP file; a record with its length (9 bytes), and the length of the profile's name (4) follow."""
COMPRESSION_MODE = re.compile(r"^ *compression_mode:[ ]*(\S*)", re.MULTILINE)
LISTED_FILES = re.compile(r"^ *relative_file_paths: *\n((?: *- *\S.*\n)+)", re.MULTILINE)
"""Fields of a metadata.yaml: how the files are compressed, and their paths, one a line."""
EXPECTED = "Give an .mcap, .db3 or .bag file, or the folder of a bag with its metadata.yaml"


class Message(NamedTuple):
    """A message: `log_ns` is the time at which it was recorded, in nanoseconds; `raw` are its serialized bytes."""

    topic: str
    type: str
    log_ns: int
    raw: bytes


class Header(NamedTuple):
    """The `std_msgs/Header` of a message: time in nanoseconds, and frame without a leading slash."""

    stamp_ns: int
    frame: str


@dataclass(frozen=True)
class Topic:
    """A topic: `type` as in "sensor_msgs/msg/Image", also for ROS 1; number of messages."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class Bag:
    """An open bag (`opened`).

    Attributes:
        path: the file or folder.
        topics: by name; those without messages are left out.
        start_ns, end_ns: log times of the first message, and just after the last.
    """

    path: Path
    topics: dict[str, Topic]
    start_ns: int
    end_ns: int
    _reader: Any = field(repr=False)

    @property
    def ros2(self) -> bool:
        """Whether it is a ROS 2 bag."""
        return bool(self._reader.is2)

    def messages(
        self, topics: Collection[str] | None = None, seconds: float | None = None, share: float = 0.0
    ) -> Iterator[Message]:
        """Messages in order of log time.

        Args:
            topics: those to read; None: all.
            seconds: duration of the part that is read; None: to the end.
            share: share of the recording after which to begin.

        Raises:
            InputError: the bag is damaged.
        """
        known = self._reader.connections
        wanted = [c for c in known if topics is None or c.topic in topics]
        if not wanted:
            return
        last = self.start_ns
        try:
            start = self.start_ns + int(share * (self.end_ns - self.start_ns))
            stop = None if seconds is None else start + int(seconds * 1e9)
            for connection, log_ns, raw in self._reader.messages(wanted, start=start if share else None, stop=stop):
                last = log_ns
                yield Message(connection.topic, connection.msgtype, log_ns, bytes(raw))
        except (GeneratorExit, InputError):
            raise
        except Exception as error:  # decompressors, SQLite and the parsers raise any exception on damaged files
            at, of = (last - self.start_ns) / 1e9, (self.end_ns - self.start_ns) / 1e9
            cause = f"is damaged after {at:.1f} of {of:.1f} s ({_text(error)})"
            raise InputError(self.path, cause, _repair(self.path)) from None

    def decode(self, message: Message) -> Any:
        """The message as an object with the fields of its definition.

        Raises:
            InputError: its bytes don't fit the definition, or its type is unknown.
        """
        try:
            return self._reader.deserialize(message.raw, message.type)
        except Exception as error:  # any exception of the library's generated parsers
            raise self.bad(message, f"can't be decoded as {message.type} ({_text(error)})") from None

    def header(self, message: Message) -> Header:
        """The header of a message whose definition begins with one.

        Raises:
            InputError: the message is too short.
        """
        try:
            order = ">" if self.ros2 and message.raw[1] == 0 else "<"
            seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", message.raw, 4)
            frame = message.raw[16 : 16 + length]
            if len(frame) < length:
                raise IndexError
        except (struct.error, IndexError):
            raise self.bad(message, f"is too short ({len(message.raw)} bytes)") from None
        return Header(seconds * 10**9 + nanoseconds, plain(frame.rstrip(b"\0").decode(errors="replace")))

    def at(self, message: Message) -> str:
        """Topic and time of a message within the recording, for errors and warnings."""
        return f"{message.topic} at {(message.log_ns - self.start_ns) / 1e9:.3f} s"

    def bad(self, message: Message, cause: str, remedy: str = "") -> InputError:
        """The error about a message."""
        fallback = f"Leave the topic out (docs/rosbag.md), or repair the bag: {_repair(self.path)}"
        return InputError(self.path, f"the message of {self.at(message)} {cause}", remedy or fallback)


def plain(frame: str) -> str:
    """Name of a frame without the leading slash of ROS 1."""
    return frame.lstrip("/")


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: by its suffix, or the content of the folder."""
    if path.is_dir():
        return bool(_files(path)) or (path / METADATA).is_file()
    return path.suffix.lower() in SUFFIXES


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """Open a bag: an .mcap, .db3 or .bag file, or a folder of them (with or without `metadata.yaml`).

    Raises:
        InputError: it isn't one, or is damaged. DataError is left to the callers: an empty bag opens.
        SpaceError: the folder for temporary files has no space for the content of a compressed bag.
        UnavailableError: the package `rosbags` isn't installed.
    """
    require("ROS bags", "rosbags", extra="bag")
    paths = _paths(path)
    for one in paths:
        _check_name(one)
        _check_log(one)
        _check_profile(one)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        reader = AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        bag = _described(path, reader)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            cause = f"has no space for {path.name}, which is compressed and is unpacked there"
            raise SpaceError(tempfile.gettempdir(), cause, "Set TMPDIR to a folder on a larger disk") from None
        raise from_os_error(error, path) from None
    except Exception as error:  # any exception of SQLite, YAML and the library's parsers
        raise InputError(path, f"is not a readable bag ({_text(error)})", _repair(path)) from None
    try:
        yield bag
    finally:
        reader.close()


def _described(path: Path, reader: Any) -> Bag:
    """The bag of an open reader. Raises TypeError or ValueError if its metadata have wrong types."""
    counts: dict[str, Topic] = {}
    for c in reader.connections:
        before = counts[c.topic].count if c.topic in counts else 0
        counts[c.topic] = Topic(str(c.topic), str(c.msgtype), before + int(c.msgcount))
    topics = {name: topic for name, topic in sorted(counts.items()) if topic.count}
    start, end = (int(reader.start_time), int(reader.end_time)) if topics else (0, 0)
    return Bag(path, topics, start, end, reader)


def _files(folder: Path) -> list[Path]:
    """Files of a bag in a folder: those of the suffix that comes first in `SUFFIXES`."""
    found = [p for p in sorted(folder.iterdir()) if p.suffix.lower() in SUFFIXES and not file_checks.hidden(p)]
    return [p for p in found if p.suffix == found[0].suffix]


def _paths(path: Path) -> list[Path]:
    if path.is_dir():
        if (path / METADATA).is_file():
            return _listed(path) or [path]
        files = _files(path)
        if not files:
            raise InputError(path, "contains no bag (no metadata.yaml, .mcap, .db3 or .bag)", EXPECTED)
        return files
    if path.name == METADATA:
        return [path.parent]
    file_checks.check(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(path, f"is not a bag ({path.suffix or 'no suffix'})", EXPECTED)
    if path.stat().st_size == 0:
        raise InputError(path, "is an empty file", _repair(path))
    return [path]


def _listed(folder: Path) -> list[Path]:
    """Files of an uncompressed bag that its metadata.yaml lists; empty if they aren't readable without it.

    The files have all that is needed; `ros2 bag reindex` writes metadata that contradict them (no storage, other QoS).
    """
    try:
        text = (folder / METADATA).read_text(encoding="utf-8", errors="replace")
    except OSError:  # the library's error names it
        return []
    mode, listed = COMPRESSION_MODE.search(text), LISTED_FILES.search(text)
    if listed is None or (mode is not None and mode[1].strip("'\"").lower() not in ("", "none")):
        return []
    names = [line.strip().removeprefix("-").strip().strip("'\"") for line in listed[1].splitlines()]
    files = [folder / PurePath(name).name for name in names]
    return (
        files if all(file.is_file() and file.suffix in SUFFIXES[:2] and file.stat().st_size for file in files) else []
    )


def _check_log(path: Path) -> None:
    """Check that an SQLite file has all its messages: after a crash, some may still be in its write-ahead log."""
    for file in path.glob("*.db3") if path.is_dir() else [path]:
        log = file.with_name(f"{file.name}-wal")
        if file.suffix == ".db3" and log.is_file() and log.stat().st_size:
            cause = f"is incomplete: messages are still in {log.name}, as the recording was interrupted"
            raise InputError(
                file, cause, f"Write them into the file: sqlite3 {file.name} 'PRAGMA wal_checkpoint(TRUNCATE)'"
            )


def _check_profile(path: Path) -> None:
    """Check that an MCAP file contains messages of ROS 2: other programs write the same format."""
    if path.suffix != ".mcap":
        return
    with open(path, "rb") as file:
        head = file.read(MCAP_HEAD_BYTES)
    if not head.startswith(MCAP_MAGIC) or len(head) < len(MCAP_MAGIC) + 13:
        return
    start, length = len(MCAP_MAGIC) + 13, int.from_bytes(head[len(MCAP_MAGIC) + 9 : len(MCAP_MAGIC) + 13], "little")
    profile = head[start : start + length].decode(errors="replace")
    if profile == "ros1":
        remedy = "Give the .bag file that it was converted from, or convert it back"
    else:
        remedy = "Convert it to a ROS 2 bag with sensor_msgs (Foxglove's own schemas and Protobuf aren't read)"
    if profile != "ros2":
        raise InputError(path, f"is an MCAP file without ROS 2 messages (profile {profile[:40]!r})", remedy)


def _check_name(path: Path) -> None:
    """Check that SQLite, to which the library passes the path as a URI, finds the file."""
    files = path.glob("*.db3") if path.is_dir() else [path] if path.suffix == ".db3" else []
    for file in files:
        if unquote(str(file)) != str(file) or any(c in str(file) for c in "?#"):
            cause = "has `?`, `#` or a code such as `%20` in its path"
            raise InputError(file, cause, "Rename it, or link to its folder")


def _repair(path: Path) -> str:
    return REPAIR["" if path.is_dir() else path.suffix.lower()]


def _text(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0][:200] or type(error).__name__
