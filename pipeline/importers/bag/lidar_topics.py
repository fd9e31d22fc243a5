"""Choice of the topics with sweeps: one of each lidar; not depth cameras, radars, maps and repeated points."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from scan2sim.pipeline.importers.bag.contents import Contents
from scan2sim.pipeline.importers.bag.point_cloud2 import InvalidCloud
from scan2sim.pipeline.importers.bag.transforms import BODY_FRAMES, WORLD_FRAMES

RADAR_FIELD = re.compile("rcs|rcs_.*|.*_rcs|radar_?cross_?section|snr_db|v_?doppler_mps")
"""Names of fields that only radars have."""
DEPTH_CAMERA = "not used: points of a depth camera (--lidar uses it)"
SAME_POINTS = 0.8
"""Share of points from which two topics have the same ones, as whole sweeps and their segments."""
MIN_SHARE_OF_SINGLE = 0.5
"""Points of single lidars, as a share of those of a topic in the vehicle's frame, from which that one repeats them."""


@dataclass
class LidarTopics:
    """Choice of topics of lidars.

    Attributes:
        found: contents of the bag.
        uses: receives why a topic isn't used.
        warnings: receives lidars that are left out for a missing transform.
    """

    found: Contents
    uses: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def chosen(self) -> list[str]:
        """One topic of each frame, the best one; that with most points first. May be empty."""
        found, best = self.found, dict[str, str]()
        for topic in found.topics("lidar"):
            reason = self._unsuitable(topic)
            if reason:
                self.uses[topic] = reason
                continue
            frame = found.frame(topic)
            old = best.setdefault(frame, topic)
            if old != topic:
                loser, best[frame] = (old, topic) if self._better(topic, old) else (topic, old)
                self.uses[loser] = f"not used: of the same lidar as {best[frame]} (--lidar uses it)"
        names = self._scanners(sorted(best.values(), key=lambda topic: -self._points(topic)))
        usable = names[:1]
        for topic in names[1:]:
            if found.frames.connected(found.frame(names[0]), found.frame(topic)):
                usable.append(topic)
            else:
                missing = f"no static transform to {found.frame(names[0])!r} from {found.frame(topic)!r}"
                self.uses[topic] = f"not used: {missing} (--transform adds it)"
                self.warnings.append(f"{topic} is left out: {missing}; give it with --transform")
        return usable

    def _unsuitable(self, topic: str) -> str:
        """Why a topic isn't a lidar's; "" if it may be."""
        found = self.found
        sweep, frame, samples = found.first[topic], found.frame(topic), found.samples.get(topic)
        if isinstance(sweep, InvalidCloud):
            return f"not used: {sweep}"
        if samples and frame in self._worlds():
            return f"not used: in the frame {frame}, not a lidar's (--lidar uses it)"
        if samples and sweep.rgb is not None and samples[0].height > 1:
            return DEPTH_CAMERA
        if samples and _is_radar(topic, samples[0]):
            return "not used: points of a radar (--lidar uses it)"
        return ""

    def _worlds(self) -> set[str]:
        """Frames that don't move with the vehicle."""
        moving = {parent for parent, _ in self.found.frames.moving}  # with joints of wheels, also the vehicle's frame
        odometries = {self.found.frame(topic) for topic in self.found.topics("odometry")}
        return (moving | odometries | set(WORLD_FRAMES)) - set(BODY_FRAMES)

    def _scanners(self, topics: list[str]) -> list[str]:
        """Topics without depth cameras, and without points of other topics in the vehicle's frame, if others remain."""
        found = self.found
        lidars = [topic for topic in topics if not self._by_depth_camera(topic)]
        if lidars:
            self.uses.update(dict.fromkeys((topic for topic in topics if topic not in lidars), DEPTH_CAMERA))
            topics = lidars
        single = [topic for topic in topics if found.frame(topic) not in BODY_FRAMES]
        for topic in (topic for topic in topics if topic not in single):
            near = [one for one in single if found.frames.connected(found.frame(topic), found.frame(one))]
            if sum(map(self._points, near)) > MIN_SHARE_OF_SINGLE * self._points(topic):
                text = f"not used: probably the points of {', '.join(near)} in the vehicle's frame (--lidar uses it)"
                self.uses[topic] = text
                topics = [other for other in topics if other != topic]
        return topics

    def _better(self, topic: str, other: str) -> bool:
        """Whether a topic of a lidar is better than another: times, more points, or as many in larger sweeps."""
        timed = [self.found.first[name].time is not None for name in (topic, other)]
        points = [self._points(name) for name in (topic, other)]
        if timed[0] != timed[1]:
            return timed[0]
        if min(points) < SAME_POINTS * max(points):
            return points[0] > points[1]
        return len(self.found.first[topic]) > len(self.found.first[other])

    def _points(self, topic: str) -> int:
        """Number of points of a topic, by its first sweep."""
        return len(self.found.first[topic]) * self.found.bag.topics[topic].count

    def _by_depth_camera(self, topic: str) -> bool:
        """Whether points without times have colours or are in the frame of a camera."""
        sweep, frame = self.found.first[topic], self.found.frame(topic)
        return sweep.time is None and (sweep.rgb is not None or frame.endswith(("optical_frame", "_optical")))


def _is_radar(topic: str, cloud: Any) -> bool:
    """Whether a PointCloud2 is a radar's: by its topic, or radar cross-sections."""
    return "radar" in topic.lower() or any(RADAR_FIELD.fullmatch(field.name.lower()) for field in cloud.fields)
