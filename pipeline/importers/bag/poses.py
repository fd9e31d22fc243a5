"""Poses of the scanner from a bag's messages: transforms, an odometry, or satellite positions with an IMU."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.poses import interpolate
from scan2sim.pipeline.core.types import F64, Trajectory
from scan2sim.pipeline.importers.bag.contents import Contents, add_transforms, is_static
from scan2sim.pipeline.importers.bag.plan import Plan
from scan2sim.pipeline.importers.bag.pose_messages import fix_sigma, has_orientation, valid_fix
from scan2sim.pipeline.importers.bag.reader import Bag, Message
from scan2sim.pipeline.importers.bag.transforms import (
    BODY_FRAMES,
    Frames,
    Series,
    earth_centred,
    in_gap,
    pose_matrix,
    without_turns,
)
from scan2sim.pipeline.io.geodata import crs as crs_io

MIN_POSE_INTERVAL_S = 0.0099
"""Poses of an IMU are thinned to a hundred per second."""
HEADING_STEP_M, MIN_HEADING_STEPS, MAX_HEADING_ERROR_DEG = 2.0, 3, 30.0
"""Length and least number of the pieces of a path by which headings are checked, and the reported difference."""
GPS_HEADER = "time,latitude,longitude,altitude,accuracy"


@dataclass
class PoseMessages:
    """Gathers messages with poses and fixes; an object of one import.

    Attributes:
        bag: the open bag.
        plan: what is imported.
        frames: static transforms, and those that are gathered.
        log_times: take the times at which messages were recorded.
        links: links of /tf that are needed: those above the scanner.
        warnings: of `trajectory`.
    """

    bag: Bag
    plan: Plan
    frames: Frames
    log_times: bool
    links: frozenset[tuple[str, str]]
    warnings: list[str] = field(default_factory=list)
    _odometry: Series = field(default_factory=Series)
    _fixes: list[tuple[float, ...]] = field(default_factory=list)
    _imu: list[tuple[float, ...]] = field(default_factory=list)

    @staticmethod
    def of(found: Contents, plan: Plan, log_times: bool) -> PoseMessages:
        """An object with the static transforms of a bag, without poses."""
        above = frozenset(found.frames.ancestors(plan.lidars[0].frame, plan.poses.world or None))
        return PoseMessages(found.bag, plan, Frames(found.bag.path, dict(found.frames.static)), log_times, above)

    @property
    def topics(self) -> set[str]:
        """Topics of the messages that are needed."""
        own = {self.plan.gps, self.plan.poses.topic, self.plan.poses.imu} - {""}
        tf = [name for name, topic in self.bag.topics.items() if topic.type.endswith(("TFMessage", "tfMessage"))]
        return own | ({name for name in tf if not is_static(name)} if self.plan.poses.kind == "tf" else set())

    def add(self, message: Message) -> None:
        """Gather a message of one of `topics`.

        Raises:
            InputError: it can't be decoded, or a pose is invalid.
        """
        poses = self.plan.poses
        if message.topic == self.plan.gps or (poses.kind == "gnss" and message.topic == poses.topic):
            self._add_fix(message)
        elif message.topic == poses.imu:
            time = self._time(message)
            if self._imu and abs(time - self._imu[-1][0]) < MIN_POSE_INTERVAL_S:
                return
            imu = self.bag.decode(message)
            if has_orientation(imu):
                q = imu.orientation
                self._imu.append((time, q.x, q.y, q.z, q.w))
        elif message.topic == poses.topic:
            odometry = self.bag.decode(message)
            pose = getattr(odometry.pose, "pose", odometry.pose)  # PoseStamped has no covariance around it
            try:
                self._odometry.add(self._time(message), pose_matrix(pose))
            except ValueError:
                raise self.bag.bad(message, "has an invalid pose (NaN or no rotation)") from None
        else:
            add_transforms(self.frames, self.bag, message, self.log_times, self.links)

    def _time(self, message: Message) -> float:
        return 1e-9 * (message.log_ns if self.log_times else self.bag.header(message).stamp_ns)

    def _add_fix(self, message: Message) -> None:
        fix = self.bag.decode(message)
        if valid_fix(fix):
            position, sigma = (float(fix.latitude), float(fix.longitude), float(fix.altitude)), fix_sigma(fix)
            self._fixes.append((self._time(message), *position, np.nan if sigma is None else sigma))

    def fixes(self) -> F64:
        """Fixes (N, 5): seconds, latitude, longitude (degrees), altitude, sigma (metres; NaN if unknown).

        Raises:
            DataError: there are none.
        """
        if not self._fixes:
            topic = self.plan.gps or self.plan.poses.topic
            raise DataError(self.bag.path, f"{topic} has no valid fix", "Use other --poses, or --gps none")
        rows = np.array(self._fixes)
        _, first = np.unique(rows[:, 0], return_index=True)
        return rows[first]

    def gps_csv(self) -> str:
        """Fixes as the text of a GPS track (`pipeline.io.gps.csv`). Raises DataError as `fixes`."""
        rows = (
            f"{t:.6f},{lat:.10f},{lon:.10f},{alt:.4f},{'' if np.isnan(sigma) else f'{sigma:.4f}'}\n"
            for t, lat, lon, alt, sigma in self.fixes()
        )
        return f"{GPS_HEADER}\n{''.join(rows)}"

    def trajectory(self) -> Trajectory:
        """Poses of the scanner in the world.

        Raises:
            DataError: there are less than two. InputError: a transform is missing.
        """
        scanner, kind = self.plan.lidars[0].frame, self.plan.poses.kind
        if kind == "tf":
            times, T = self.frames.poses_of(scanner, self.plan.poses.world)
        elif kind == "odometry":
            times, T = self._odometry.sorted()
            if without_turns(T):
                cause = (
                    f"has positions without orientations in {self.plan.poses.topic}: they never change while it moves"
                )
                raise InputError(self.bag.path, cause, "Use other --poses (sweeps needs none)")
            if len(times):
                T = T @ self.frames.between(self.plan.poses.child, scanner)
        else:
            times, T = self._satellite_poses(scanner)
        if len(times) < 2:
            remedy = "Use other --poses (sweeps needs none), or check the recording"
            raise DataError(self.bag.path, f"has {len(times)} poses of the frame {scanner!r}", remedy)
        if earth_centred(T):
            source = self.plan.poses.topic or f"the frame {self.plan.poses.world!r}"
            cause = f"has poses in an earth-centred frame (ECEF), whose z axis isn't up, in {source}"
            raise InputError(
                self.bag.path, cause, "Use another --poses or --world-frame: a local frame (ENU, map, odom)"
            )
        return Trajectory(times, T[:, :3, 3], T[:, :3, :3])

    def _satellite_poses(self, scanner: str) -> tuple[F64, F64]:
        """Poses in UTM: positions of the antenna, orientation of the IMU (east, north, up), lever arm by transforms."""
        from pyproj import Proj, Transformer
        from scipy.spatial.transform import Rotation

        fixes = self.fixes()
        if len(self._imu) < 2:
            raise DataError(self.bag.path, f"{self.plan.poses.imu} has no orientations", "Use other --poses")
        rows = np.array(self._imu)
        _, first = np.unique(rows[:, 0], return_index=True)
        rows = rows[first]
        crs = crs_io.utm(fixes[0, 1], fixes[0, 2])
        east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(fixes[:, 2], fixes[:, 1])
        antenna = np.column_stack([east, north, fixes[:, 3]])
        times = rows[(rows[:, 0] >= fixes[0, 0]) & (rows[:, 0] <= fixes[-1, 0]), 0]
        if len(times) < len(fixes):  # the IMU is slower
            times = fixes[(fixes[:, 0] >= rows[0, 0]) & (fixes[:, 0] <= rows[-1, 0]), 0]
        if not len(times):
            return times, np.zeros((0, 4, 4))
        times = self._without_gaps(times, fixes[:, 0], rows[:, 0])
        if not len(times):
            return times, np.zeros((0, 4, 4))
        turns = np.tile(np.eye(4), (len(rows), 1, 1))
        turns[:, :3, :3] = Rotation.from_quat(rows[:, 1:]).as_matrix()
        # true north to grid north
        convergence = np.radians(Proj(crs).get_factors(fixes[0, 2], fixes[0, 1]).meridian_convergence)
        T = interpolate(turns, rows[:, 0], times)
        T[:, :3, :3] = Rotation.from_euler("z", convergence).as_matrix() @ T[:, :3, :3]
        T[:, :3, 3] = np.column_stack([np.interp(times, fixes[:, 0], antenna[:, k]) for k in range(3)])
        receiver, imu = self.plan.poses.frames
        if imu != receiver and self.frames.connected(imu, receiver):
            lever = self.frames.between(imu, receiver)[:3, 3]
            T[:, :3, 3] -= T[:, :3, :3] @ lever
        self._warn_heading(T, imu)
        return times, T @ self.frames.between(imu, scanner)

    def _without_gaps(self, times: F64, *sources: F64) -> F64:
        """Times (N,) that aren't in a gap of one of the ascending times of messages."""
        keep = np.logical_and.reduce([~in_gap(at, times) for at in sources])
        if not keep.all():
            self.warnings.append(
                f"{100 * (1 - keep.mean()):.0f} % of the drive have no valid fixes or orientations: they are left out "
                "(--poses sweeps bridges gaps with lidar odometry)"
            )
        return times[keep]

    def _warn_heading(self, T_world_imu: F64, imu: str) -> None:
        """Warn if the vehicle doesn't move along its x axis: the IMU's orientation is of another convention."""
        body = next((name for name in BODY_FRAMES if self.frames.connected(imu, name)), None)
        error = None if body is None else heading_error(T_world_imu @ self.frames.between(imu, body))
        if error is not None and error > MAX_HEADING_ERROR_DEG:
            topic = self.plan.poses.imu
            self.warnings.append(
                f"the orientation of {topic} is {error:.0f} degrees off the direction of travel: it must be "
                "in east, north, up (REP 103), not in north, east, down, to magnetic north, or relative to its start; "
                "compare with --poses sweeps"
            )


def heading_error(T: F64) -> float | None:
    """Median angle (degrees, 0 to 90) between x axis and motion, forward or backward, of poses (N, 4, 4) of a vehicle.

    None if it moves too little.
    """
    kept = [0]
    for i in range(len(T)):
        if np.linalg.norm(T[i, :2, 3] - T[kept[-1], :2, 3]) >= HEADING_STEP_M:
            kept.append(i)
    if len(kept) <= MIN_HEADING_STEPS:
        return None
    move = np.diff(T[kept, :2, 3], axis=0)
    axis = T[kept[:-1], :2, 0] + T[kept[1:], :2, 0]
    cross = np.abs(axis[:, 0] * move[:, 1] - axis[:, 1] * move[:, 0])
    return float(np.median(np.degrees(np.arctan2(cross, np.abs((axis * move).sum(axis=1))))))


def crs_of(found: Contents, plan: Plan) -> str | None:
    """CRS of the positions that satellites give: UTM; None if a plan uses none.

    Raises:
        InputError: no message of the topic has a valid position.
    """
    topic = plan.gps or (plan.poses.topic if plan.poses.kind == "gnss" else "")
    if not topic:
        return None
    for message in found.bag.messages([topic]):
        fix = found.bag.decode(message)
        if valid_fix(fix):
            return crs_io.utm(float(fix.latitude), float(fix.longitude))
    raise InputError(found.bag.path, f"{topic} has no valid fix", "Use --gps none, or other --poses")
