"""What a bag contains: kinds of topics, their first messages, frames, and statistics of all messages."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import I64
from scan2sim.pipeline.importers.bag import livox, point_cloud2
from scan2sim.pipeline.importers.bag.point_cloud2 import InvalidCloud, RawSweep
from scan2sim.pipeline.importers.bag.reader import Bag, Header, Message, plain
from scan2sim.pipeline.importers.bag.transforms import Frames, Series, transform_matrix

Kind = Literal["lidar", "image", "compressed", "info", "tf", "odometry", "pose", "fix", "imu", ""]
KINDS: dict[str, Kind] = {
    "sensor_msgs/msg/PointCloud2": "lidar", **dict.fromkeys(livox.TYPES, "lidar"),
    "sensor_msgs/msg/Image": "image", "sensor_msgs/msg/CompressedImage": "compressed",
    "sensor_msgs/msg/CameraInfo": "info", "tf2_msgs/msg/TFMessage": "tf", "tf/msg/tfMessage": "tf",
    "nav_msgs/msg/Odometry": "odometry", "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose", "sensor_msgs/msg/NavSatFix": "fix",
    "sensor_msgs/msg/Imu": "imu",
}  # fmt: skip
"""Kind of a topic by the type of its messages; "" for all others."""
HEAD_S = 5.0
"""Seconds at the beginning of the recording by which its frames and sources of poses are recognized."""
PROBED_SHARES, PROBE_S = (0.25, 0.5, 0.75, 0.97), 1.0
"""Shares of the recording at which a second of transforms is read, to recognize those that never change."""
MIN_GAP_S, GAP_RATIO = 0.5, 5.0
"""A gap is an interval longer than both: seconds, and times the median interval."""


@dataclass
class Contents:
    """Topics of a bag, with samples.

    Attributes:
        bag: the open bag.
        first: first message of each topic of a known kind, decoded; of lidars, a `RawSweep`, or an `InvalidCloud`.
        headers: headers of these messages; without those of `tf`.
        lags: seconds from the time stamp of a topic's message until it was recorded, the smallest of its samples;
            without messages that have no time stamp.
        link_lags: the same for moving transforms, by (parent, child).
        frames: all static transforms, and the moving ones of the first seconds.
        samples: messages of kinds odometry, fix and imu in the first seconds, and of the latter two one in the middle,
            decoded, by topic.
    """

    bag: Bag
    first: dict[str, Any] = field(default_factory=dict)
    headers: dict[str, Header] = field(default_factory=dict)
    frames: Frames = field(init=False)
    samples: dict[str, list[Any]] = field(default_factory=dict)
    lags: dict[str, float] = field(default_factory=dict)
    link_lags: dict[tuple[str, str], float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.frames = Frames(self.bag.path)

    def topics_of(self, *kinds: Kind) -> list[str]:
        """Names of the topics of some kinds."""
        return [name for name in self.bag.topics if self.kind(name) in kinds]

    def topics(self, *kinds: Kind) -> list[str]:
        """Names of the topics of some kinds that have a readable message."""
        return [name for name in self.topics_of(*kinds) if name in self.first or self.kind(name) == "tf"]

    def kind(self, topic: str) -> Kind:
        """Kind of a topic."""
        return KINDS.get(self.bag.topics[topic].type, "")

    def frame(self, topic: str) -> str:
        """Frame of a topic's first message; the name of the topic if its header names none."""
        return self.headers[topic].frame or plain(topic)


def inspected(bag: Bag) -> Contents:
    """Read the first seconds of a bag, the first message of each topic, and all static transforms.

    Transforms of `/tf` that never change, as ROS 1 publishes static ones, are taken as static.

    Raises:
        DataError: the bag has no messages. InputError: it is damaged.
    """
    if not bag.topics:
        raise DataError(bag.path, "contains no messages", "Check that the topics were published during the recording")
    found = Contents(bag)
    known = [name for name in bag.topics if found.kind(name)]
    static = [name for name in found.topics("tf") if is_static(name)]
    for message in bag.messages(static):
        add_transforms(found.frames, bag, message)
    large = found.topics_of("lidar", "image", "compressed")  # the first message suffices
    for message in bag.messages([name for name in known if name not in (*static, *large)], HEAD_S):
        _sample(found, message)
    for share in PROBED_SHARES:
        for message in bag.messages([name for name in found.topics("tf") if name not in static], PROBE_S, share):
            add_transforms(found.frames, bag, message, lags=found.link_lags)
    found.frames.fix_constant()
    for name in known:
        if name not in found.first and name not in static:
            _sample_one(found, name, 0.0)
    for name in found.topics("fix", "imu"):  # a receiver or an INS may start later
        _sample_one(found, name, 0.5)
    return found


def is_static(topic: str) -> bool:
    """Whether transforms of a topic hold for the whole recording."""
    return topic.endswith("tf_static")


def add_transforms(
    frames: Frames,
    bag: Bag,
    message: Message,
    log_times: bool = False,
    links: Collection[tuple[str, str]] | None = None,
    lags: dict[tuple[str, str], float] | None = None,
) -> None:
    """Add the transforms of a TFMessage.

    Args:
        frames: frames to add them to.
        bag: the bag.
        message: the message.
        log_times: take the time at which it was recorded, instead of those of the headers.
        links: add only these; None: all.
        lags: receives seconds from time stamp to recording of moving transforms (`Contents.link_lags`).

    Raises:
        InputError: it can't be decoded, or a transform is invalid.
    """
    for one in bag.decode(message).transforms:
        link = plain(one.header.frame_id), plain(one.child_frame_id)
        if links is not None and link not in links:
            continue
        try:
            T = transform_matrix(one.transform)
        except ValueError:
            raise bag.bad(message, f"has an invalid transform {link[0]} > {link[1]} (NaN or no rotation)") from None
        if is_static(message.topic):
            frames.static[link] = T
        else:
            stamp = stamp_seconds(one)
            time = message.log_ns * 1e-9 if log_times else stamp
            if lags is not None and stamp:
                lags[link] = min(lags.get(link, np.inf), message.log_ns * 1e-9 - stamp, key=abs)
            frames.moving.setdefault(link, Series()).add(time, T)


def decode_sweep(bag: Bag, message: Message) -> RawSweep:
    """The points of a message of kind lidar.

    Raises:
        InvalidCloud: the message is inconsistent. InputError: it can't be decoded.
    """
    if message.type in livox.TYPES:
        return livox.decode(message.raw, bag.ros2)
    return point_cloud2.decode(bag.decode(message))


def _sample_one(found: Contents, topic: str, share: float) -> None:
    """Keep what is needed of a topic's first message after a share of the recording."""
    for message in found.bag.messages([topic], share=share):
        _sample(found, message)
        break


def _sample(found: Contents, message: Message) -> None:
    """Keep what is needed of a message."""
    bag, kind, topic = found.bag, found.kind(message.topic), message.topic
    if kind == "tf":
        add_transforms(found.frames, bag, message, lags=found.link_lags)
        found.first[topic] = None
        return
    if topic not in found.first or kind in ("odometry", "fix", "imu"):
        stamp_ns = bag.header(message).stamp_ns
        if stamp_ns:
            found.lags[topic] = min(found.lags.get(topic, np.inf), (message.log_ns - stamp_ns) * 1e-9, key=abs)
    if topic not in found.first:
        found.headers[topic] = bag.header(message)
        found.first[topic] = None
        if kind == "lidar":
            try:
                found.first[topic] = decode_sweep(bag, message)
                if message.type not in livox.TYPES:
                    found.samples[topic] = [bag.decode(message)]
            except InvalidCloud as error:
                found.first[topic] = error
        else:
            found.first[topic] = bag.decode(message)
    if kind in ("odometry", "fix", "imu"):
        found.samples.setdefault(topic, []).append(bag.decode(message))


@dataclass(frozen=True)
class Statistics:
    """Statistics of a topic.

    Attributes:
        count: messages.
        start, end: seconds of the recording at its first and last message.
        rate: Hz, by the median interval; 0 for one message.
        gaps: number of intervals that are much longer than usual.
        longest: the longest interval, seconds.
    """

    count: int
    start: float
    end: float
    rate: float
    gaps: int
    longest: float


def statistics(bag: Bag, report: Report = silent) -> dict[str, Statistics]:
    """Statistics of all topics by log time; reads the whole bag.

    Raises:
        InputError: the bag is damaged.
    """
    times = {name: array("q") for name in bag.topics}
    duration = max(1, bag.end_ns - bag.start_ns)
    for i, message in enumerate(bag.messages()):
        if i % 1000 == 0:
            report((message.log_ns - bag.start_ns) / duration, message.topic)
        times[message.topic].append(message.log_ns)
    return {name: _statistics(np.array(log, np.int64), bag.start_ns) for name, log in times.items() if log}


def _statistics(log: I64, start: int) -> Statistics:
    seconds = (log - start) * 1e-9
    steps = np.diff(seconds)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return Statistics(
        len(log), float(seconds[0]), float(seconds[-1]), 1 / usual if usual > 0 else 0.0,
        int((steps > max(MIN_GAP_S, GAP_RATIO * usual)).sum()), float(steps.max(initial=0.0)),
    )  # fmt: skip


def rate(messages: Sequence[Any]) -> float:
    """Rate in Hz of decoded messages with headers; 0 if unknown."""
    seconds = [stamp_seconds(m) for m in messages]
    steps = np.diff(seconds) if len(seconds) > 1 else np.zeros(0)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return 1 / usual if usual > 0 else 0.0


def stamp_seconds(message: Any) -> float:
    """Time of a decoded message's header, seconds."""
    stamp = message.header.stamp
    return float(stamp.sec + stamp.nanosec * 1e-9)
