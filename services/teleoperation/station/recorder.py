"""Drive recorder of a station: video, state, commands and what drivers do, as MCAP files of ROS 2 messages (rosbags).

    FOLDER/drive-20260501-120000-000/   a bag: metadata.yaml and one .mcap file; the next one begins when it is full

| topic | type | |
| --- | --- | --- |
| /video/CAMERA | foxglove_msgs/msg/CompressedVideo | VP8, as received |
| /state | std_msgs/msg/String | JSON of the driver page, ten times a second |
| /command | scan2sim_msgs/msg/Command | as sent to the vehicle |
| /event | std_msgs/msg/String | JSON: what a driver did |

Header stamps are capture times, log times are those of recording; both by the station's wall clock. The oldest bags are
deleted when all together exceed the limit. Recording never delays driving: what the disk can't take is dropped.
"""

from __future__ import annotations

import json
import logging
import queue
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from scan2sim.pipeline.core.errors import InputError, from_os_error
from scan2sim.services.supervision import SupervisedThread
from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command
from scan2sim.services.teleoperation.video.jitter_buffer import Frame

log = logging.getLogger(__name__)

PREFIX = "drive-"
SEGMENTS = 16
"""Number of bags that the limit is divided into."""
STATE_PERIOD_S = 0.1
"""Interval at which the state is recorded."""
QUEUE_MAX = 2000
"""Messages that may wait for the disk; more are dropped."""
VIDEO, COMMAND, STRING = "foxglove_msgs/msg/CompressedVideo", "scan2sim_msgs/msg/Command", "std_msgs/msg/String"
_DEFINITIONS = {
    VIDEO: "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
    COMMAND: "float32 steering\nfloat32 throttle\nfloat32 brake\nint8 gear\nbool horn\nbool lights\nuint32 stop\n"
    "bool agree\nbool emergency\n",
}
VIDEO_TOPIC = "/video/"
KEY_FORMAT, DELTA_FORMAT = "vp8", "vp8 delta"
"""Formats of key frames, and of frames that need those before them."""


def typestore() -> Any:
    """Message types of recordings."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in _DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    return store


def command_message(store: Any, command: Command) -> Any:
    """A command as a message of the types in `store`."""
    one = command.controls
    return store.types[COMMAND](
        one.steering, one.throttle, one.brake, int(one.gear), one.horn, one.lights, command.stop,
        command.agree, command.emergency,
    )  # fmt: skip


class Recorder:
    """Records from creation to `close`; all methods are thread-safe and return at once.

    Attributes:
        dropped: number of messages that the disk could not take.

    Raises:
        SpaceError: the folder can't be written to.
    """

    def __init__(
        self,
        folder: Path,
        limit_bytes: float,
        state: Callable[[], dict[str, Any]],
        begun: Callable[[], None] = lambda: None,
    ) -> None:
        """Start recording.

        Args:
            limit_bytes: maximum size of all bags.
            state: returns the state to record, as for the driver page.
            begun: called when a bag begins, which should have a key frame soon.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise from_os_error(error, folder) from None
        self.dropped = 0
        self._folder, self._limit, self._state, self._begun = folder, limit_bytes, state, begun
        self._begun_ms = 0
        self._store = typestore()
        self._queue: queue.Queue[tuple[str, str, int, Any]] = queue.Queue(QUEUE_MAX)
        self._ended = threading.Event()
        self._thread = SupervisedThread(self._run, "recorder")
        self._thread.start()

    def frame(self, name: str, frame: Frame, age_ms: float) -> None:
        """Record a frame of a camera."""
        now = time.time_ns()
        captured = now - round(age_ms * 1e6) if age_ms < 1e7 else now
        self._put(VIDEO_TOPIC + (name or str(frame.camera)), VIDEO, now, (captured, frame))

    def command(self, command: Command) -> None:
        """Record a command that is sent."""
        self._put("/command", COMMAND, time.time_ns(), command)

    def event(self, what: str, driver: str) -> None:
        """Record what a driver did."""
        self._put("/event", STRING, time.time_ns(), json.dumps({"what": what, "driver": driver}))

    def close(self) -> None:
        """Write what is queued, and close the files."""
        self._ended.set()
        self._thread.join(10.0)

    def _put(self, topic: str, kind: str, now: int, content: Any) -> None:
        try:
            self._queue.put_nowait((topic, kind, now, content))
        except queue.Full:
            self.dropped += 1

    def _run(self) -> None:
        while not self._ended.is_set() or not self._queue.empty():
            try:
                self._record_bag()
            except Exception as error:  # of the disk or of rosbags: driving continues
                log.error("%s can't be written (%s); recording continues when it can", self._folder, error)
                self._ended.wait(1.0)
        if self.dropped:
            log.warning("the recorder dropped %d messages: the disk is too slow", self.dropped)

    def _record_bag(self) -> None:
        """Record until a bag is full."""
        self._delete_oldest()
        size, due = 0, 0.0
        with Writer(self._new_path(), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            self._begun()
            connections: dict[str, Any] = {}
            while size < self._limit / SEGMENTS and not (self._ended.is_set() and self._queue.empty()):
                if time.monotonic() >= due:
                    due = time.monotonic() + STATE_PERIOD_S
                    self._put("/state", STRING, time.time_ns(), json.dumps(self._state()))
                try:
                    topic, kind, now, content = self._queue.get(timeout=STATE_PERIOD_S)
                except queue.Empty:
                    continue
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self._store)
                data = self._store.serialize_cdr(self._message(topic, kind, content), kind)
                writer.write(connections[topic], now, data)
                size += len(data)

    def _message(self, topic: str, kind: str, content: Any) -> Any:
        types = self._store.types
        if kind == STRING:
            return types[STRING](content)
        if kind == COMMAND:
            return command_message(self._store, content)
        captured, frame = content
        stamp = types["builtin_interfaces/msg/Time"](captured // 10**9, captured % 10**9)
        form = KEY_FORMAT if frame.key else DELTA_FORMAT
        return types[VIDEO](stamp, topic.removeprefix(VIDEO_TOPIC), np.frombuffer(frame.data, np.uint8), form)

    def _new_path(self) -> Path:
        """Path of the next bag; names are in order of recording, also if the clock is set back."""
        self._begun_ms = max(time.time_ns() // 10**6, self._begun_ms + 1)
        return self._folder / bag_name(self._begun_ms)

    def _delete_oldest(self) -> None:
        """Delete the oldest bags, so that with a new one all fit the limit."""
        bags = sorted(self._folder.glob(f"{PREFIX}*"))
        sizes = {bag: sum(file.stat().st_size for file in bag.glob("*")) for bag in bags}
        while bags and sum(sizes[bag] for bag in bags) > self._limit * (1 - 1 / SEGMENTS):
            shutil.rmtree(bags.pop(0), ignore_errors=True)


def bag_name(begun_ms: int) -> str:
    """Name of a bag by the UNIX time of its beginning in milliseconds; sorted by name, bags are in order of time."""
    seconds, ms = divmod(begun_ms, 1000)
    return f"{PREFIX}{time.strftime('%Y%m%d-%H%M%S', time.gmtime(seconds))}-{ms:03}"


class Recorded(NamedTuple):
    """A recorded message; times in ns of the station's wall clock.

    Attributes:
        content: a `Command`, a `RecordedFrame`, or the dictionary of a state or event.
    """

    topic: str
    at: int
    content: Any


class RecordedFrame(NamedTuple):
    """A frame of a camera; `captured`: ns of the station's wall clock."""

    camera: str
    key: bool
    captured: int
    data: bytes


def read(path: Path) -> Iterator[Recorded]:
    """Messages of a bag, or of all bags in a recorder's folder, in order of recording.

    Raises:
        InputError: there is none, or one can't be read.
    """
    bags = [path] if (path / "metadata.yaml").is_file() else sorted(path.glob(f"{PREFIX}*/metadata.yaml"))
    if not bags:
        raise InputError(path, "contains no recorded drive", "Give the folder of `teleop station --record`")
    store = typestore()
    for bag in bags:
        folder = bag if bag.is_dir() else bag.parent
        try:
            with Reader(folder) as reader:
                for connection, at, data in reader.messages():
                    message = store.deserialize_cdr(data, connection.msgtype)
                    yield Recorded(connection.topic, at, _content(connection.msgtype, message))
        except Exception as error:
            raise InputError(folder, f"can't be read ({error})", "Check that the recorder has closed it") from None


def _content(kind: str, message: Any) -> Any:
    if kind == STRING:
        return json.loads(message.data)
    if kind == COMMAND:
        one = message
        controls = Controls(one.steering, one.throttle, one.brake, Gear(one.gear), one.horn, one.lights)
        return Command(controls, one.stop, one.agree, one.emergency)
    captured = message.timestamp.sec * 10**9 + message.timestamp.nanosec
    return RecordedFrame(message.frame_id, message.format == KEY_FORMAT, captured, message.data.tobytes())
