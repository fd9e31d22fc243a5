"""What each topic of a bag is used for: lidars, cameras with their calibration, and the source of poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import DataError, InputError, ScanError, SettingError
from scan2sim.pipeline.core.parameters import Seconds
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.importers.bag import contents, images
from scan2sim.pipeline.importers.bag.cameras import InvalidCamera, camera_of
from scan2sim.pipeline.importers.bag.contents import Contents
from scan2sim.pipeline.importers.bag.point_cloud2 import InvalidCloud
from scan2sim.pipeline.importers.bag.reader import plain
from scan2sim.pipeline.importers.bag.transforms import WORLD_FRAMES
from scan2sim.pipeline.io import urdf as urdf_io
from scan2sim.pipeline.io.calibration import read_camera

AUTO, NONE, TF, GNSS, SWEEPS = "auto", "none", "tf", "gnss", "sweeps"
MIN_FIX_RATE_HZ, MAX_FIX_SIGMA_M = 4.0, 0.5
"""GPS with an IMU places sweeps alone if it is at least that frequent and exact; otherwise it is fused with them."""
BODY_FRAMES = ("base_link", "base_footprint", "base", "body")
"""Names of the vehicle's frame (REP 105), the preferred one first."""
NAMES_OF_IMAGES = ("image", "image_raw", "image_rect", "image_color", "image_rect_color", "image_mono", "raw")
URDF_TOLERANCE = 0.005
"""Difference between a link of a URDF and that of the bag that is worth a warning: metres, and rotation elements."""
LIST_TOPICS = "`scan2sim inspect` lists its topics"
LIDAR_PACKETS = (
    "VelodyneScan", "VelodynePacket", "PacketMsg", "PandarScan", "PandarPacket", "UdpFrame", "UdpPacket",
    "NebulaPackets", "RslidarPacket", "RslidarScan", "LslidarPacket", "LslidarScan",
)  # fmt: skip
"""Types, without their package, of a lidar's raw packets, which only its driver can decode."""
VIDEOS = ("CompressedVideo", "FFMPEGPacket", "theora_image_transport/msg/Packet")
"""Ends of the types of compressed videos."""


class BagParams(Params):
    """Which topics of a bag are imported, and how.

    Attributes:
        lidar: topics of sweeps; default: one of each lidar. The first one's frame is the scanner's.
        camera: topics of images; default: one of each camera that has a CameraInfo; "none" for no photos.
        poses: "tf", "gnss", "sweeps" (lidar odometry), or a topic of nav_msgs/Odometry; "auto": the first of them. Or a
            topic of PoseStamped or PoseWithCovarianceStamped, which "auto" doesn't use: it could be a goal.
        pose_frame: frame whose poses such a topic gives; default: `BODY_FRAMES`.
        gps: topic of a NavSatFix that is fused with lidar odometry and georeferences the world; or "none".
        world_frame: frame of the world in /tf; default: map, world or odom, else the root.
        stamps: times of messages: of their headers, or at which they were recorded.
        transform: further static transforms, "PARENT CHILD x y z qx qy qz qw".
        photo_interval: least time between two photos of a camera, seconds; default: all photos.
    """

    lidar: tuple[str, ...] = Field((), description="Topic of sweeps; repeatable; default: one of each lidar.")
    camera: tuple[str, ...] = Field(
        (), description="Topic of images, or none; repeatable; default: one of each camera with a CameraInfo."
    )
    poses: str = Field(
        AUTO,
        description="Source of poses: tf, an Odometry topic, gnss (NavSatFix and Imu), sweeps (lidar odometry), or "
        "auto: the first of these that the bag has; or a PoseStamped topic, with covariance or without.",
    )
    pose_frame: str | None = Field(
        None, description="Frame whose poses a PoseStamped topic gives; default: base_link, if there is one."
    )
    gps: str = Field(
        AUTO, description="NavSatFix topic to fuse with lidar odometry and to georeference by; auto, or none."
    )
    world_frame: str | None = Field(
        None, description="Frame of the world in /tf; default: map, world or odom, else the root of the tree."
    )
    stamps: Literal["header", "log"] = Field(
        "header", description="Times of messages: header (of the sensors), or log (when they were recorded)."
    )
    transform: tuple[str, ...] = Field(
        (), description="Static transform missing in the bag: 'PARENT CHILD x y z qx qy qz qw'; repeatable."
    )
    photo_interval: Seconds | None = Field(
        None, description="Least time between two photos of a camera in seconds; default: all photos."
    )


@dataclass(frozen=True)
class Lidar:
    """A lidar: topic, frame, T_scanner_lidar (4, 4) to the axes of the first one, and whether its points have times."""

    topic: str
    frame: str
    T_scanner_lidar: F64
    timed: bool


@dataclass(frozen=True)
class PhotoSource:
    """A camera: topic, id (name of its folder), frame, intrinsics, and T_camera_scanner (4, 4)."""

    topic: str
    id: str
    frame: str
    camera: Camera
    T_camera_scanner: F64


@dataclass(frozen=True)
class PoseSource:
    """Where poses come from.

    Attributes:
        kind: transforms, an odometry, satellites and an IMU, or the sweeps themselves.
        topic: of the odometry, the poses or the fixes.
        child: frame whose pose the odometry gives.
        imu: topic of the IMU.
        frames: frames of the receiver and the IMU.
        world: frame of the poses in /tf.
    """

    kind: Literal["tf", "odometry", "gnss", "sweeps"]
    topic: str = ""
    child: str = ""
    imu: str = ""
    frames: tuple[str, str] = ("", "")
    world: str = ""

    @property
    def setting(self) -> str:
        """The value of `BagParams.poses` that selects it."""
        return self.topic if self.kind == "odometry" else self.kind


@dataclass(frozen=True)
class Plan:
    """What an import uses.

    Attributes:
        lidars: the first one's axes are the scanner's.
        cameras: cameras.
        poses: source of poses.
        gps: topic of fixes that are fused with lidar odometry; "" for none.
        uses: use of each topic, or why it isn't used, as text.
        warnings: assumptions.
    """

    lidars: tuple[Lidar, ...]
    cameras: tuple[PhotoSource, ...]
    poses: PoseSource
    gps: str
    uses: dict[str, str]
    warnings: tuple[str, ...] = ()

    @property
    def timed(self) -> bool:
        """Whether points of sweeps have times of their own: those of the lidar, or of one of several lidars."""
        return len(self.lidars) > 1 or self.lidars[0].timed


@dataclass
class _Planner:
    found: Contents
    params: BagParams
    intrinsics: Path | None
    urdf: Path | None = None
    uses: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def path(self) -> Path:
        return self.found.bag.path

    def plan(self) -> Plan:
        self._add_urdf()
        self.found.frames.add_given(self.params.transform)
        lidars = self.lidars()
        scanner = lidars[0].frame
        poses = self.poses(scanner)
        gps = self.gps(poses)
        cameras = self.cameras(scanner)
        return Plan(lidars, cameras, poses, gps, self.all_uses(), tuple(self.warnings))

    def _add_urdf(self) -> None:
        """Add the fixed joints of the robot's description; links of the bag itself are kept."""
        if self.urdf is None:
            return
        static = self.found.frames.static
        for link, T in urdf_io.read_fixed_joints(self.urdf).items():
            own = static.setdefault(link, T)
            shift = float(np.linalg.norm(own[:3, 3] - T[:3, 3]))
            turn = float(np.linalg.norm(own[:3, :3] - T[:3, :3]))
            if shift > URDF_TOLERANCE or turn > URDF_TOLERANCE:
                self.warnings.append(
                    f"{link[0]} > {link[1]} of {self.urdf.name} differs by {shift:.3f} m from the bag's, which is used"
                )

    def all_uses(self) -> dict[str, str]:
        """Use of every topic, as far as it is decided."""
        return {topic: self.uses.get(topic, _unused(self.found, topic)) for topic in self.found.bag.topics}

    def lidars(self) -> tuple[Lidar, ...]:
        topics = [self._known(name, "--lidar", "lidar") for name in self.params.lidar] or self._default_lidars()
        if not topics:
            cause = f"contains no sweeps (PointCloud2 or Livox CustomMsg); its topics: {self._listed()}"
            packets = [topic for topic in self.found.bag.topics if _is_packets(self.found, topic)]
            remedy = "Record the lidar's topic, or name one with --lidar"
            if packets:
                remedy = (
                    f"{', '.join(packets)} has the lidar's raw packets: play the bag while the lidar's driver runs, "
                    "and record the PointCloud2 that it publishes together with the other topics"
                )
            raise DataError(self.path, cause, remedy)
        lidars: list[Lidar] = []
        for topic in topics:
            sweep, frame = self.found.first[topic], self.found.frame(topic)
            if isinstance(sweep, InvalidCloud):
                raise InputError(self.path, f"the first message of {topic} {sweep}", "Name another topic with --lidar")
            timed = sweep.time is not None
            T = np.eye(4) if not lidars else self.found.frames.between(lidars[0].frame, frame)
            lidars.append(Lidar(topic, frame, T, timed))
            role = "sweeps" if len(lidars) == 1 else f"sweeps, added to those of {topics[0]}"
            self.uses[topic] = f"{role}; frame {frame}, points {'with' if timed else 'without'} times"
        return tuple(lidars)

    def _default_lidars(self) -> list[str]:
        """One topic of each frame, the best one; that with most points first."""
        best: dict[str, tuple[tuple[bool, int], str]] = {}
        worlds = {parent for parent, _ in self.found.frames.moving} | set(WORLD_FRAMES)
        for topic in self.found.topics("lidar"):
            sweep, frame = self.found.first[topic], self.found.frame(topic)
            samples = self.found.samples.get(topic)
            if isinstance(sweep, InvalidCloud):
                self.uses[topic] = f"not used: {sweep}"
            elif frame in worlds and not self.found.bag.topics[topic].type.startswith("livox"):
                self.uses[topic] = f"not used: in the frame {frame}, not a lidar's (--lidar uses it)"
            elif samples and sweep.rgb is not None and samples[0].height > 1:
                self.uses[topic] = "not used: points of a depth camera (--lidar uses it)"
            else:
                rank = (sweep.time is not None, len(sweep) * self.found.bag.topics[topic].count)
                old = best.get(frame)
                if old is not None:
                    loser, winner = (old[1], topic) if rank > old[0] else (topic, old[1])
                    self.uses[loser] = f"not used: of the same lidar as {winner} (--lidar uses it)"
                if old is None or rank > old[0]:
                    best[frame] = rank, topic
        order = sorted(best.values(), key=lambda one: -one[0][1])
        names = [topic for _, topic in order]
        if not names:
            return []
        first, *others = names
        usable = [first]
        for topic in others:
            if self.found.frames.connected(self.found.frame(first), self.found.frame(topic)):
                usable.append(topic)
            else:
                missing = f"no static transform to {self.found.frame(first)!r} from {self.found.frame(topic)!r}"
                self.uses[topic] = f"not used: {missing} (--transform adds it)"
                self.warnings.append(f"{topic} is left out: {missing}; give it with --transform")
        return usable

    def cameras(self, scanner: str) -> tuple[PhotoSource, ...]:
        given = self.params.camera
        if given == (NONE,):
            return ()
        topics = [self._known(name, "--camera", "image", "compressed") for name in given] or self._default_cameras()
        sources: list[PhotoSource] = []
        for topic in topics:
            frame = self.found.frame(topic)
            key = _id(topic)
            while key in {source.id for source in sources}:
                key += "_2"
            camera = self._camera(topic)
            T = self.found.frames.between(frame, scanner)
            sources.append(PhotoSource(topic, key, frame, camera, T))
            self.uses[topic] = f"photos; frame {frame}, {camera.model} {camera.width}x{camera.height}"
            info = self._info(topic)
            if info is not None and self.intrinsics is None:
                self.uses[info] = f"calibration of {topic}"
        return tuple(sources)

    def _default_cameras(self) -> list[str]:
        """One topic of each camera: with most images, with colours, not rectified, not compressed."""
        best: dict[str, tuple[tuple[Any, ...], str]] = {}
        for topic in self.found.topics("image", "compressed"):
            first = self.found.first[topic]
            encoding = str(getattr(first, "encoding", "")) or str(getattr(first, "format", ""))
            if encoding in images.DEPTH_ENCODINGS or "compressedDepth" in (encoding, topic.rpartition("/")[2]):
                self.uses[topic] = "not used: depth images"
                continue
            info = self._info(topic)
            if info is None and self.intrinsics is None:
                self.uses[topic] = "not used: no CameraInfo (--intrinsics gives its camera)"
                continue
            compressed = self.found.kind(topic) == "compressed"
            rank = (self.found.bag.topics[topic].count, images.colours(encoding), "rect" not in topic, not compressed)
            key = info or topic
            old = best.get(key)
            if old is not None:
                loser, winner = (old[1], topic) if rank > old[0] else (topic, old[1])
                self.uses[loser] = f"not used: of the same camera as {winner} (--camera uses it)"
            if old is None or rank > old[0]:
                best[key] = rank, topic
        return sorted(topic for _, topic in best.values())

    def _info(self, topic: str) -> str | None:
        """Topic of the CameraInfo of an image topic: beside it, else the only one in its frame."""
        base = _base(topic)
        beside = f"{base.rpartition('/')[0]}/camera_info"
        infos = self.found.topics("info")
        if beside in infos:
            return beside
        own = [name for name in infos if self.found.frame(name) == self.found.frame(topic)]
        return own[0] if len(own) == 1 else None

    def _camera(self, topic: str) -> Camera:
        width, height = self._size(topic)
        if self.intrinsics is not None:
            return read_camera(self.intrinsics, width, height)
        info = self._info(topic)
        remedy = "Give the camera with --intrinsics (a TOML file with [[cameras]] as in a tile), or --camera none"
        if info is None:
            infos = ", ".join(self.found.topics("info")) or "none"
            raise InputError(self.path, f"has no CameraInfo of {topic} (it has {infos})", remedy)
        try:
            camera = camera_of(self.found.first[info], rectified="rect" in _base(topic).rpartition("/")[2])
        except InvalidCamera as error:
            raise InputError(self.path, f"the message of {info} {error}", remedy) from None
        if (camera.width, camera.height) == (width, height):
            return camera
        cause = f"the images of {topic} are {width}x{height}, those of {info} {camera.width}x{camera.height}"
        if abs(width * camera.height - height * camera.width) > max(width, height):
            raise InputError(self.path, cause, remedy)
        self.warnings.append(f"{cause}: the calibration is scaled")
        return camera.resized(width, height)

    def _size(self, topic: str) -> tuple[int, int]:
        """Width and height of a topic's images, by the first one."""
        import cv2

        first = self.found.first[topic]
        if self.found.kind(topic) == "image":
            if not (first.width and first.height and len(first.data)):
                raise self._no_image(topic, "has no data")
            return int(first.width), int(first.height)
        try:
            _, content = images.compressed_file(first)
        except images.InvalidImage as error:
            raise self._no_image(topic, str(error)) from None
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise self._no_image(topic, "is a damaged image")
        return int(pixels.shape[1]), int(pixels.shape[0])

    def _no_image(self, topic: str, cause: str) -> InputError:
        return InputError(self.path, f"the first image of {topic} {cause}", "Name other topics with --camera, or none")

    def poses(self, scanner: str) -> PoseSource:
        """Source of the scanner's poses.

        Raises:
            InputError: the given one isn't in the bag, or no transform connects it with the scanner.
        """
        wanted, frames = self.params.poses, self.found.frames
        if wanted in (AUTO, TF):
            given = self.params.world_frame if wanted == TF or self.params.world_frame else None
            world = frames.world_frame(scanner, given)
            if world is not None:
                for topic in self.found.topics("tf"):
                    if not contents.is_static(topic):
                        self.uses[topic] = f"poses of {scanner} in {world}"
                return PoseSource("tf", world=world)
            if wanted == TF:
                cause = f"has no moving transform above the frame {scanner!r}; {frames.listed()}"
                raise InputError(self.path, cause, "Use other --poses, or add a link with --transform")
        if wanted in (GNSS, AUTO):
            odometry = self._odometry(scanner) if wanted == AUTO else None
            source = odometry or self._gnss(scanner, required=wanted == GNSS)
            if source is not None:
                self.uses[source.topic] = "poses" + (", orientation by " + source.imu if source.imu else "")
                if source.imu:
                    self.uses[source.imu] = "orientation of the poses"
                return source
        elif wanted != SWEEPS:
            topic = self._known(wanted, "--poses", "odometry", "pose")
            child = self.child(topic) if self.found.kind(topic) == "odometry" else self._body(topic, scanner)
            frames.between(child, scanner)
            self.uses[topic] = f"poses of {child}"
            return PoseSource("odometry", topic, child)
        return PoseSource("sweeps")

    def child(self, topic: str) -> str:
        """Frame whose pose an odometry gives."""
        return odometry_child(self.found.first[topic])

    def _body(self, topic: str, scanner: str) -> str:
        """Frame whose pose a topic without child frames gives."""
        if self.params.pose_frame is not None:
            return plain(self.params.pose_frame)
        known = [name for name in BODY_FRAMES if self.found.frames.connected(name, scanner)]
        child = known[0] if known else scanner
        self.warnings.append(f"the poses of {topic} are taken to be those of {child!r} (--pose-frame)")
        return child

    def _odometry(self, scanner: str) -> PoseSource | None:
        """The connected odometry whose frame comes first in `WORLD_FRAMES`, with most messages."""

        def rank(topic: str) -> tuple[int, int]:
            frame = self.found.frame(topic)
            place = WORLD_FRAMES.index(frame) if frame in WORLD_FRAMES else len(WORLD_FRAMES)
            return place, -self.found.bag.topics[topic].count

        frames = self.found.frames
        own = [topic for topic in self.found.topics("odometry") if frames.connected(self.child(topic), scanner)]
        for topic in self.found.topics("odometry"):
            if topic not in own:
                self.uses[topic] = f"not used: no static transform from {self.child(topic)!r} to {scanner!r}"
        if not own:
            return None
        best = min(own, key=rank)
        return PoseSource("odometry", best, self.child(best))

    def _gnss(self, scanner: str, required: bool) -> PoseSource | None:
        """Satellite positions with an IMU's orientation; None if they are too rare or inexact for it."""
        fixes, imus, frames = self.found.topics("fix"), self.found.topics("imu"), self.found.frames
        oriented = [topic for topic in imus if has_orientation(self.found.first[topic])]
        usable = [topic for topic in oriented if frames.connected(self.found.frame(topic), scanner)]
        if required:
            for kind, names in (("NavSatFix", fixes), ("Imu with an orientation", oriented)):
                if not names:
                    cause = f"has no topic of {kind}; its topics: {self._listed()}"
                    raise InputError(self.path, cause, "Use other --poses")
            if not usable:
                frames.between(self.found.frame(oriented[0]), scanner)
        if not fixes or not usable:
            return None
        fix = self._best_fix()
        samples = self.found.samples.get(fix, [])
        sigmas = [fix_sigma(sample) for sample in samples]
        known = [sigma for sigma in sigmas if sigma is not None]
        exact = not known or float(np.median(known)) <= MAX_FIX_SIGMA_M
        if not required and not (contents.rate(samples) >= MIN_FIX_RATE_HZ and exact):
            return None
        imu = max(usable, key=lambda topic: self.found.bag.topics[topic].count)
        receiver, body = self.found.frame(fix), self.found.frame(imu)
        if receiver != body and not frames.connected(body, receiver):
            self.warnings.append(
                f"no static transform from {body!r} to {receiver!r}: the antenna is taken to be at the IMU"
            )
        return PoseSource("gnss", fix, imu=imu, frames=(receiver, body))

    def _best_fix(self) -> str:
        return max(self.found.topics("fix"), key=lambda topic: self.found.bag.topics[topic].count)

    def gps(self, poses: PoseSource) -> str:
        """Topic of fixes to fuse with lidar odometry; "" for none."""
        wanted = self.params.gps
        if wanted == NONE or poses.kind == "gnss":
            return ""
        if wanted != AUTO:
            topic = self._known(wanted, "--gps", "fix")
        elif poses.kind == "sweeps" and self.found.topics("fix"):
            topic = self._best_fix()
        else:
            return ""
        self.uses[topic] = "GPS positions, fused with lidar odometry; georeference"
        return topic

    def _known(self, topic: str, option: str, *kinds: contents.Kind) -> str:
        if topic in self.found.topics(*kinds):
            return topic
        there = self.found.bag.topics.get(topic)
        cause = f"{topic!r} is of the type {there.type}" if there else f"{topic!r} is not in the bag"
        suitable = ", ".join(self.found.topics(*kinds)) or "none"
        raise SettingError(option, f"{cause} {self.path}", f"Choose one of: {suitable}; {LIST_TOPICS}")

    def _listed(self) -> str:
        return ", ".join(f"{one.name} ({one.type})" for one in list(self.found.bag.topics.values())[:20])


def plan_import(found: Contents, params: BagParams, intrinsics: Path | None = None, urdf: Path | None = None) -> Plan:
    """Decide what topics are used for.

    Args:
        found: contents of the bag.
        params: the user's choice.
        intrinsics: TOML file with the cameras (`pipeline.io.calibration.read_camera`), instead of CameraInfo.
        urdf: description of the robot, whose fixed joints are added to the static transforms.

    Raises:
        DataError: no sweeps. SettingError: a chosen topic isn't in the bag.
        InputError: a transform or calibration is missing; names what there is.
    """
    return _Planner(found, params, intrinsics, urdf).plan()


def described(found: Contents, params: BagParams, urdf: Path | None = None) -> tuple[dict[str, str], ScanError | None]:
    """What each topic would be used for, and the error that would stop an import, or None."""
    planner = _Planner(found, params, None, urdf)
    try:
        return planner.plan().uses, None
    except ScanError as error:
        return planner.all_uses(), error


def resolved(params: BagParams, plan: Plan) -> BagParams:
    """The parameters with the choice that a plan made, so that it stays the same."""
    cameras = tuple(source.topic for source in plan.cameras) or (NONE,)
    changed = {
        "lidar": tuple(lidar.topic for lidar in plan.lidars), "camera": cameras, "poses": plan.poses.setting,
        "gps": plan.gps or NONE, "world_frame": plan.poses.world or None,
    }  # fmt: skip
    return params.model_copy(update=changed)


def odometry_child(message: Any) -> str:
    """Frame whose pose an Odometry message gives; base_link if it doesn't say."""
    return str(message.child_frame_id).lstrip("/") or "base_link"


def has_orientation(imu: Any) -> bool:
    """Whether an Imu message has an orientation (REP 145: a covariance of -1 means it has none)."""
    q = imu.orientation
    length = float(np.linalg.norm([q.x, q.y, q.z, q.w]))
    return float(imu.orientation_covariance[0]) != -1 and abs(length - 1) < 0.1


def fix_sigma(fix: Any) -> float | None:
    """Horizontal standard deviation of a NavSatFix in metres, or None if it is unknown."""
    if int(fix.position_covariance_type) == 0:
        return None
    variance = (float(fix.position_covariance[0]) + float(fix.position_covariance[4])) / 2
    return float(np.sqrt(max(0.0, variance)))


def _unused(found: Contents, topic: str) -> str:
    """Text about a topic that isn't used."""
    if found.kind(topic) == "tf" and contents.is_static(topic):
        return "transforms between frames"
    if _is_packets(found, topic):
        return "not used: raw packets of a lidar, whose driver makes PointCloud2 of them"
    if found.bag.topics[topic].type.endswith(VIDEOS):
        return "not used: compressed video (republish it as CompressedImage)"
    reasons = {"info": ": its images aren't", "": ": of no kind that the import reads", "pose": " (--poses uses it)"}
    return f"not used{reasons.get(found.kind(topic), '')}"


def _is_packets(found: Contents, topic: str) -> bool:
    """Whether a topic has the raw packets of a lidar."""
    return found.bag.topics[topic].type.rpartition("/")[2] in LIDAR_PACKETS


def _base(topic: str) -> str:
    """Topic of the images without the suffix of its transport."""
    return topic.removesuffix("/compressed")


def _id(topic: str) -> str:
    """Name of a camera after its topic: /front/image_raw/compressed becomes "front"."""
    parts = [part for part in _base(topic).split("/") if part]
    while len(parts) > 1 and parts[-1] in NAMES_OF_IMAGES:
        parts.pop()
    return "_".join(parts) or "camera"
