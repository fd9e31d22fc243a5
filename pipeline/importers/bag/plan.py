"""What each topic of a bag is used for: lidars, cameras with their calibration, and the source of poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import DataError, InputError, ScanError, SettingError
from scan2sim.pipeline.core.parameters import Seconds
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.importers.bag import contents, images
from scan2sim.pipeline.importers.bag.camera_topics import CameraTopics, base, rectified
from scan2sim.pipeline.importers.bag.cameras import has_only_projection, looks_rectified
from scan2sim.pipeline.importers.bag.clocks import check_clocks
from scan2sim.pipeline.importers.bag.contents import Contents
from scan2sim.pipeline.importers.bag.lidar_topics import LidarTopics
from scan2sim.pipeline.importers.bag.point_cloud2 import InvalidCloud
from scan2sim.pipeline.importers.bag.pose_messages import (
    fix_sigma,
    odometry_child,
    odometry_poses,
    valid_fix,
    without_orientation,
)
from scan2sim.pipeline.importers.bag.reader import plain
from scan2sim.pipeline.importers.bag.transforms import BODY_FRAMES, WORLD_FRAMES, earth_centred, without_turns
from scan2sim.pipeline.io import urdf as urdf_io
from scan2sim.pipeline.io.calibration import read_camera
from scan2sim.pipeline.io.camera_info import InvalidCamera, camera_of

AUTO, NONE, TF, GNSS, SWEEPS = "auto", "none", "tf", "gnss", "sweeps"
MIN_FIX_RATE_HZ, MAX_FIX_SIGMA_M = 4.0, 0.5
"""GPS with an IMU places sweeps alone if it is at least that frequent and exact; otherwise it is fused with them."""
NAMES_OF_IMAGES = ("image", "image_raw", "image_rect", "image_color", "image_rect_color", "image_mono", "raw")
MIN_UNUSED_BITS = 2
"""Highest bits of 16-bit images that aren't used, from which a warning says so."""
URDF_TOLERANCE = 0.005
"""Difference between a link of a URDF and that of the bag that is worth a warning: metres, and rotation elements."""
LIST_TOPICS = "`scan2sim inspect` lists its topics"
LIDAR_PACKETS = (
    "VelodyneScan", "VelodynePacket", "PacketMsg", "PandarScan", "PandarPacket", "UdpFrame", "UdpPacket",
    "NebulaPackets", "RslidarPacket", "RslidarScan", "LslidarPacket", "LslidarScan",
)  # fmt: skip
"""Types, without their package, of a lidar's raw packets, which only its driver can decode."""
COMPRESSED_POINTS = "CompressedPointCloud2"
"""End of the types of compressed points (Draco, Cloudini, zstd), of `point_cloud_transport`."""
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
        transform: static transforms, "PARENT CHILD x y z qx qy qz qw"; they replace the bag's.
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
        (),
        description="Static transform missing in the bag, or instead of its own: 'PARENT CHILD x y z qx qy qz qw'; "
        "repeatable.",
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
    def photos(self) -> CameraTopics:
        """Topics of cameras."""
        return CameraTopics(self.found, self.uses)

    @property
    def path(self) -> Path:
        return self.found.bag.path

    def plan(self) -> Plan:
        self._add_urdf()
        self.warnings += self.found.frames.add_given(self.params.transform)
        lidars = self.lidars()
        scanner = lidars[0].frame
        poses = self.poses(scanner)
        gps = self.gps(poses)
        cameras = self.cameras(scanner)
        if self.params.stamps == "header":
            self._check_clocks(lidars, cameras, poses, gps)
        return Plan(lidars, cameras, poses, gps, self.all_uses(), tuple(self.warnings))

    def _check_clocks(
        self, lidars: tuple[Lidar, ...], cameras: tuple[PhotoSource, ...], poses: PoseSource, gps: str
    ) -> None:
        others = [one.topic for one in lidars[1:]] + [one.topic for one in cameras]
        others += filter(None, (poses.topic, poses.imu, gps))
        frames = self.found.frames
        above = frames.ancestors(lidars[0].frame, poses.world) if poses.kind == "tf" else []
        check_clocks(self.found, lidars[0].topic, others, [link for link in above if link in frames.moving])

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
            packed = [one.name for one in self.found.bag.topics.values() if one.type.endswith(COMPRESSED_POINTS)]
            if packed:
                remedy = f"{', '.join(packed)} has compressed points: republish them as PointCloud2 and record them"
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
        return LidarTopics(self.found, self.uses, self.warnings).chosen()

    def cameras(self, scanner: str) -> tuple[PhotoSource, ...]:
        given = self.params.camera
        if given == (NONE,):
            return ()
        topics = [self._known(name, "--camera", "image", "compressed") for name in given]
        topics = topics or self.photos.chosen(calibrated=self.intrinsics is not None)
        sources: list[PhotoSource] = []
        for topic in topics:
            frame = self.found.frame(topic)
            key = _id(topic)
            while key in {source.id for source in sources}:
                key += "_2"
            camera = self._camera(topic)
            T = self.found.frames.between(frame, scanner)
            if self.intrinsics is not None and (same := [one.topic for one in sources if one.camera == camera]):
                self.warnings.append(f"{same[0]} and {topic} have the same camera in {self.intrinsics.name}")
            sources.append(PhotoSource(topic, key, frame, camera, T))
            self.uses[topic] = f"photos; frame {frame}, {camera.model} {camera.width}x{camera.height}"
            unused = 0 if self.found.kind(topic) == "compressed" else images.unused_bits(self.found.first[topic])
            if unused >= MIN_UNUSED_BITS:
                self.warnings.append(
                    f"the first image of {topic} uses {16 - unused} of 16 bits: its photos are dark (have the driver "
                    "publish 8 bits, or 16 bits that are shifted)"
                )
            info = self.photos.info(topic)
            if info is not None and self.intrinsics is None:
                self.uses[info] = f"calibration of {topic}"
        return tuple(sources)

    def _camera(self, topic: str) -> Camera:
        width, height = self.photos.size(topic)
        if self.intrinsics is not None:
            names = (_id(topic), topic, base(topic))
            return read_camera(self.intrinsics, width, height, names=names, rectified=rectified(topic))
        info = self.photos.info(topic)
        remedy = (
            "Give the camera with --intrinsics (a TOML file with [[cameras]] as in a tile, or the calibration of "
            "another program), or choose topics with --camera (none: no photos)"
        )
        if info is None:
            infos = ", ".join(self.found.topics("info")) or "none"
            raise InputError(self.path, f"has no CameraInfo of {topic} (it has {infos})", remedy)
        try:
            first = self.found.first[info]
            camera = camera_of(first, rectified=rectified(topic) or has_only_projection(first))
        except InvalidCamera as error:
            raise InputError(self.path, f"the message of {info} {error}", remedy) from None
        if not rectified(topic) and looks_rectified(self.found.first[info]):
            self.warnings.append(
                f"the images of {topic} seem to be rectified (K of {info} is off their middle, P isn't), but are taken "
                "as raw: if they are rectified, give the camera of P with --intrinsics"
            )
        if (camera.width, camera.height) == (width, height):
            return camera
        cause = f"the images of {topic} are {width}x{height}, those of {info} {camera.width}x{camera.height}"
        if abs(width * camera.height - height * camera.width) > max(width, height):
            raise InputError(self.path, cause, remedy)
        self.warnings.append(f"{cause}: the calibration is scaled")
        return camera.resized(width, height)

    def poses(self, scanner: str) -> PoseSource:
        """Source of the scanner's poses.

        Raises:
            InputError: the given one isn't in the bag, or no transform connects it with the scanner.
        """
        wanted, frames = self.params.poses, self.found.frames
        if wanted in (AUTO, TF):
            given = self.params.world_frame if wanted == TF or self.params.world_frame else None
            world = frames.world_frame(scanner, given)
            if world is not None and wanted == AUTO and earth_centred(frames.poses_of(scanner, world)[1]):
                self.warnings.append(f"/tf isn't used: its frame {world!r} is earth-centred, its z axis isn't up")
                moving = [one for one in self.found.topics("tf") if not contents.is_static(one)]
                self.uses.update(dict.fromkeys(moving, "not used: poses in an earth-centred frame"))
                world = None
            if world is not None:
                self._warn_parents(scanner, world)
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

    def _warn_parents(self, scanner: str, world: str) -> None:
        """Warn of frames above the scanner that have several parents, as with two odometries at once."""
        frames = self.found.frames
        for parent, child in frames.ancestors(scanner, world):
            others = [name for name in frames.parents(child) if name != parent and (name, child) in frames.moving]
            if others:
                listed = ", ".join(map(repr, others))
                self.warnings.append(
                    f"{child!r} has several parents in /tf: {parent!r} is used, not {listed} (--world-frame)"
                )

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
        own = []
        for topic in self.found.topics("odometry"):
            T = odometry_poses(self.found.samples.get(topic, []))
            if not frames.connected(self.child(topic), scanner):
                self.uses[topic] = f"not used: no static transform from {self.child(topic)!r} to {scanner!r}"
            elif earth_centred(T):
                self.uses[topic] = "not used: poses in an earth-centred frame, whose z axis isn't up"
            elif without_turns(T):
                self.uses[topic] = "not used: positions without orientations"
            else:
                own.append(topic)
        if not own:
            return None
        best = min(own, key=rank)
        return PoseSource("odometry", best, self.child(best))

    def _gnss(self, scanner: str, required: bool) -> PoseSource | None:
        """Satellite positions with an IMU's orientation; None if they are too rare or inexact for it."""
        fixes, imus, frames = self.found.topics("fix"), self.found.topics("imu"), self.found.frames
        samples = self.found.samples
        oriented = [name for name in imus if not without_orientation(samples.get(name) or [self.found.first[name]])]
        self.uses.update({name: "not used: has no orientations" for name in imus if name not in oriented})
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
        sigma = self._sigma(fix)
        exact = sigma is None or sigma <= MAX_FIX_SIGMA_M
        if not required and not (contents.rate(self.found.samples.get(fix, [])) >= MIN_FIX_RATE_HZ and exact):
            return None
        if sigma is None:
            self.warnings.append(
                f"{fix} has no covariances: its fixes are taken to be exact to {MAX_FIX_SIGMA_M:g} m, as with RTK; "
                "if they aren't, use --poses sweeps, which fuses them with lidar odometry"
            )
        imu = max(usable, key=lambda topic: self.found.bag.topics[topic].count)
        receiver, body = self.found.frame(fix), self.found.frame(imu)
        if receiver != body and not frames.connected(body, receiver):
            self.warnings.append(
                f"no static transform from {body!r} to {receiver!r}: the antenna is taken to be at the IMU"
            )
        return PoseSource("gnss", fix, imu=imu, frames=(receiver, body))

    def _best_fix(self) -> str:
        """The receiver with valid fixes, if possible exact ones, and with most of them."""

        def rank(topic: str) -> tuple[bool, bool, int]:
            sigma = self._sigma(topic)
            valid = any(valid_fix(fix) for fix in self.found.samples.get(topic, []))
            return valid, sigma is not None and sigma <= MAX_FIX_SIGMA_M, self.found.bag.topics[topic].count

        return max(self.found.topics("fix"), key=rank)

    def _sigma(self, topic: str) -> float | None:
        """Median standard deviation of the first seconds' valid fixes, metres; None if it is unknown."""
        fixes = [fix for fix in self.found.samples.get(topic, []) if valid_fix(fix)]
        known = [sigma for fix in fixes if (sigma := fix_sigma(fix)) is not None]
        return float(np.median(known)) if known else None

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
        intrinsics: file with the cameras (`pipeline.io.calibration.read_camera`), instead of CameraInfo.
        urdf: description of the robot, whose fixed joints are added to the static transforms.

    Raises:
        DataError: no sweeps. SettingError: a chosen topic isn't in the bag.
        InputError: a transform or calibration is missing; names what there is.
    """
    return _Planner(found, params, intrinsics, urdf).plan()


class Description(NamedTuple):
    """What each topic would be used for, warnings, and the error that would stop an import, or None."""

    uses: dict[str, str]
    warnings: tuple[str, ...]
    error: ScanError | None


def described(found: Contents, params: BagParams, urdf: Path | None = None) -> Description:
    """What an import would do."""
    planner = _Planner(found, params, None, urdf)
    try:
        plan = planner.plan()
    except ScanError as error:
        return Description(planner.all_uses(), tuple(planner.warnings), error)
    return Description(plan.uses, plan.warnings, None)


def resolved(params: BagParams, plan: Plan) -> BagParams:
    """The parameters with the choice that a plan made, so that it stays the same."""
    cameras = tuple(source.topic for source in plan.cameras) or (NONE,)
    changed = {
        "lidar": tuple(lidar.topic for lidar in plan.lidars), "camera": cameras, "poses": plan.poses.setting,
        "gps": plan.gps or NONE, "world_frame": plan.poses.world or None,
    }  # fmt: skip
    return params.model_copy(update=changed)


def _unused(found: Contents, topic: str) -> str:
    """Text about a topic that isn't used."""
    if found.kind(topic) == "tf" and contents.is_static(topic):
        return "transforms between frames"
    if _is_packets(found, topic):
        return "not used: raw packets of a lidar, whose driver makes PointCloud2 of them"
    if found.bag.topics[topic].type.endswith(COMPRESSED_POINTS):
        return "not used: compressed points (republish them as PointCloud2 with point_cloud_transport)"
    if found.bag.topics[topic].type.endswith(VIDEOS):
        return "not used: compressed video (republish it as CompressedImage)"
    reasons = {"info": ": its images aren't", "": ": of no kind that the import reads", "pose": " (--poses uses it)"}
    return f"not used{reasons.get(found.kind(topic), '')}"


def _is_packets(found: Contents, topic: str) -> bool:
    """Whether a topic has the raw packets of a lidar."""
    return found.bag.topics[topic].type.rpartition("/")[2] in LIDAR_PACKETS


def _id(topic: str) -> str:
    """Name of a camera after its topic: /front/image_raw/compressed becomes "front"."""
    parts = [part for part in base(topic).split("/") if part]
    while len(parts) > 1 and parts[-1] in NAMES_OF_IMAGES:
        parts.pop()
    return "_".join(parts) or "camera"
