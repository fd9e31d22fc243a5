"""World camera as a ROS 2 node: poses, CameraInfo and a simulator's images in, images of the world out."""

from __future__ import annotations

import json
import logging
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from scan2sim.pipeline.camera.renderer import pinhole
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.qos.encoding import jpeg
from scan2sim.services.transport import QoS
from scan2sim.services.world_camera import simulator_images, views
from scan2sim.services.world_camera.intrinsics import Intrinsics
from scan2sim.services.world_camera.latest_worker import LatestWorker
from scan2sim.services.world_camera.pose_source import PoseSource, pose_of
from scan2sim.services.world_camera.settings import OUTPUTS, WorldCameraParams
from scan2sim.services.world_camera.simulator_images import ImagePairs, Pair

log = logging.getLogger(__name__)

HEADER, TIME, TF = "std_msgs/msg/Header", "builtin_interfaces/msg/Time", "tf2_msgs/msg/TFMessage"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, ODOMETRY, STRING = "sensor_msgs/msg/CameraInfo", "nav_msgs/msg/Odometry", "std_msgs/msg/String"
COLOUR, JPEG, DEPTH, CLASSES, INSTANCES, TABLE, INFO = OUTPUTS
TYPES = {
    COLOUR: IMAGE, JPEG: COMPRESSED, DEPTH: IMAGE, CLASSES: IMAGE, INSTANCES: IMAGE, TABLE: STRING, INFO: CAMERA_INFO,
}  # fmt: skip
POSES_QOS = QoS(reliability="BEST_EFFORT", depth=100)
"""Compatible with every publisher; /tf has many messages."""
STATIC_QOS = QoS(durability="TRANSIENT_LOCAL", depth=100)
SENSOR_QOS = QoS(reliability="BEST_EFFORT", depth=5)
IMAGES_QOS = QoS(depth=5)
"""Reliable, which is compatible with both reliable and best-effort subscriptions."""
TABLE_QOS = QoS(durability="TRANSIENT_LOCAL", depth=1)
"""Whoever subscribes later gets the last table, too."""
READOUT_POSES = 9
"""Poses during the readout of a rolling shutter."""
REPEAT_S = 1.0
"""Time after which an image is rendered again although no newer pose is known: somebody may have subscribed since."""
PENDING_PERIOD_S, PENDING_MAX, PENDING_MAX_S = 0.02, 8, 2.0
"""How often, how many, and for how long images of the simulator wait for the pose of their time."""
WARNING_PERIOD_S = 10.0
"""Time between two warnings of the same kind."""


class Request(NamedTuple):
    """An image to render.

    Attributes:
        time: its time stamp, nanoseconds.
        frame: its frame.
        poses: (K, 4, 4) `T_world_cam`, see `views.rendered`.
        camera: its intrinsics.
        info: fields of its CameraInfo.
        outputs: topics that somebody subscribes to, of `OUTPUTS`.
        pair: the simulator's images to show in front, or None.
    """

    time: int
    frame: str
    poses: F64
    camera: Camera
    info: dict[str, Any]
    outputs: frozenset[str]
    pair: Pair | None


class WorldCameraNode(Monitor):
    """Renders images while somebody subscribes to them, at the time of the newest pose or of the simulator's images."""

    def __init__(self, world: views.World, params: WorldCameraParams, origin: F64) -> None:
        """Create the node.

        Args:
            world: what is seen.
            params: settings.
            origin: (4, 4) pose of the fixed frame in the world.
        """
        super().__init__(params.name, **params.monitor_settings())
        self._world, self._params = world, params
        self._warned: dict[str, float] = {}
        fixed = "" if params.odometry else params.fixed_frame
        self._poses = PoseSource(fixed, origin, pose_of(params.mount), params.axes, warn=self._warn, clock=time.time_ns)
        given = None if params.camera_info else pinhole(params.width, params.height, field=params.field)
        self._intrinsics = Intrinsics(given, rectified=params.rectified)
        self._pairs, self._pending = ImagePairs(), deque[tuple[float, Pair]](maxlen=PENDING_MAX)
        self._known_instances = -1  # number of instances in the last table
        self._rendered, self._last_s = -1, 0.0  # time stamp of the last image, and when it was requested
        self._outputs = {
            name: self.create_publisher(
                ros.message_type(kind), f"{params.topic}/{name}", TABLE_QOS if name == TABLE else IMAGES_QOS
            )
            for name, kind in TYPES.items()
        }
        self._worker = LatestWorker(self._render, f"{params.name} renderer")
        self.drops.append(lambda: {"images": self._worker.replaced})
        self._subscribe()

    def _subscribe(self) -> None:
        params = self._params
        if params.odometry:
            kind = ros.message_type(ODOMETRY)
            self.create_subscription(kind, params.odometry, self._poses.receive_odometry, POSES_QOS)
        else:
            kind = ros.message_type(TF)
            self.create_subscription(kind, params.tf, lambda m: self._poses.receive_tf(m, static=False), POSES_QOS)
            static = f"{params.tf}_static"
            self.create_subscription(kind, static, lambda m: self._poses.receive_tf(m, static=True), STATIC_QOS)
        if params.camera_info:
            self.create_subscription(ros.message_type(CAMERA_INFO), params.camera_info, self._receive_info, SENSOR_QOS)
        if params.image and params.depth_image:
            kind = ros.message_type(IMAGE)
            self.create_subscription(kind, params.image, lambda m: self._wait(self._pairs.add_colour(m)), SENSOR_QOS)
            self.create_subscription(
                kind, params.depth_image, lambda m: self._wait(self._pairs.add_depth(m)), SENSOR_QOS
            )
            self.create_timer(PENDING_PERIOD_S, self._request_pending)
        else:
            self.create_timer(1 / params.rate, self._request_newest)

    def _warn(self, kind: str, text: str) -> None:
        """Log a warning, unless one of its kind was logged a short time ago."""
        now = time.monotonic()
        if now - self._warned.get(kind, -WARNING_PERIOD_S) >= WARNING_PERIOD_S:
            self._warned[kind] = now
            log.warning("%s: %s", self.get_name(), text)

    def _receive_info(self, message: Any) -> None:
        problem = self._intrinsics.receive(message)
        if problem is not None:
            self._warn("camera_info", f"{problem}; it is ignored")

    def _wait(self, pair: Pair | None) -> None:
        """Let a pair of the simulator's images wait for the pose of its time; the oldest one is dropped for it."""
        if pair is not None:
            self._pending.append((time.monotonic(), pair))

    def _wanted(self) -> frozenset[str]:
        """Topics that somebody subscribes to, if images are among them and camera and pose are known."""
        found = frozenset(name for name, publisher in self._outputs.items() if publisher.get_subscription_count())
        if not found - {INFO, TABLE}:
            return frozenset()
        if self._intrinsics.camera is None:
            self._warn("waiting", f"waiting for a valid CameraInfo on {self._params.camera_info}")
            return frozenset()
        missing = self._poses.missing(self._frame)
        if missing is not None:
            self._warn("waiting", f"waiting for the pose of the camera: {missing}")
            return frozenset()
        return found

    @property
    def _frame(self) -> str:
        """Frame of the camera: that given, that of the CameraInfo, or the name of the node."""
        return self._params.frame.lstrip("/") or self._intrinsics.frame or self._params.name

    def _request_newest(self) -> None:
        """Render the time of the newest pose, unless that was done a short time ago."""
        outputs = self._wanted()
        if not outputs:
            return
        newest, now = self._poses.newest(self._frame), time.monotonic()
        begin = time.time_ns() if newest is None else newest - round(1e9 * self._params.readout)
        is_due = begin != self._rendered or now - self._last_s >= REPEAT_S
        if is_due and self._request(begin, outputs, None):
            self._rendered, self._last_s = begin, now

    def _request_pending(self) -> None:
        """Render the times of the simulator's images whose poses are known."""
        outputs = self._wanted()
        while self._pending:
            arrived, pair = self._pending[0]
            if outputs and self._request(pair.time, outputs, pair):
                self._pending.popleft()
            elif time.monotonic() - arrived > PENDING_MAX_S or (outputs and self._has_passed(pair.time)):
                self._pending.popleft()
                if outputs:
                    newest = self._poses.newest(self._frame) or 0
                    text = "no pose is known at the time {:.3f} of the simulator's image; the newest pose is of {:.3f}"
                    self._warn("late", text.format(pair.time * 1e-9, newest * 1e-9))
            else:
                return

    def _has_passed(self, begin: int) -> bool:
        """Whether poses of an image that begins at a time should be known already."""
        newest = self._poses.newest(self._frame)
        return newest is not None and newest >= begin + round(1e9 * self._params.readout)

    def _request(self, begin: int, outputs: frozenset[str], pair: Pair | None) -> bool:
        """Request an image whose first row is seen at a time; False if its poses aren't known."""
        camera, count = self._intrinsics.camera, READOUT_POSES if self._params.readout else 1
        times = begin + np.linspace(0, 1e9 * self._params.readout, count).round().astype(np.int64)
        poses = [pose for one in times.tolist() if (pose := self._poses.at(self._frame, one)) is not None]
        if camera is None or len(poses) < count:
            return False
        info = self._intrinsics.fields
        self._worker.put(Request(begin, self._frame, np.stack(poses), camera, info, outputs, pair))
        return True

    def _render(self, request: Request) -> None:
        """Render and publish an image; called by the worker."""
        view = views.rendered(self._world, request.camera, request.poses)
        if request.pair is not None:
            view = self._composed(view, request.pair)
        self._publish(request, view)

    def _composed(self, view: views.View, pair: Pair) -> views.View:
        """A view with the simulator's images in front, or without them if they can't be used."""
        try:
            rgb, depth = simulator_images.colour_of(pair.colour), simulator_images.depth_of(pair.depth)
        except (InputError, TypeError, ValueError) as error:
            self._warn("simulator", f"the simulator's image can't be used: {error}")
            return view
        if not rgb.shape[:2] == depth.shape == view.depth.shape:
            sizes = [f"{shape[1]} x {shape[0]}" for shape in (rgb.shape, depth.shape, view.depth.shape)]
            text = "the simulator's image has {} pixels, its depth image {}, the camera {}: they must be the same"
            self._warn("simulator", text.format(*sizes))
            return view
        return views.composed(view, rgb, depth, self._params.tolerance)

    def _publish(self, request: Request, view: views.View) -> None:
        seconds, rest = divmod(request.time, 10**9)
        header = ros.message(HEADER, stamp=ros.message(TIME, sec=seconds, nanosec=rest), frame_id=request.frame)
        rgb = views.exposed(view.rgb, self._params.exposure)
        content: dict[str, Callable[[], Any]] = {
            COLOUR: lambda: _image(header, "rgb8", rgb),
            JPEG: lambda: _jpeg(header, jpeg(rgb, self._params.quality)),
            DEPTH: lambda: _image(header, "32FC1", view.depth),
            CLASSES: lambda: _image(header, "mono8", view.code),
            INSTANCES: lambda: _image(header, "32SC1", view.instance),
            INFO: lambda: ros.message(CAMERA_INFO, header=header, **request.info),
        }
        self._publish_table()
        for name, make in content.items():
            if name in request.outputs:
                self._outputs[name].publish(make())

    def _publish_table(self) -> None:
        """Publish the table of instances if tiles were read since the last one."""
        known = self._world.instances
        if len(known) != self._known_instances:
            self._known_instances = len(known)
            text = json.dumps({"instances": [one.to_json() for one in known.values()]})
            self._outputs[TABLE].publish(ros.message(STRING, data=text))

    def destroy_node(self) -> Any:
        """Stop rendering and destroy the node."""
        self._worker.close()
        return super().destroy_node()


def _image(header: Any, encoding: str, pixels: np.ndarray[Any, Any]) -> Any:
    """`sensor_msgs/Image` of pixels (H, W) or (H, W, C)."""
    data = np.ascontiguousarray(pixels)
    height, width = data.shape[:2]
    size = {"height": height, "width": width, "step": data.nbytes // height}
    return ros.message(IMAGE, header=header, encoding=encoding, **size, data=data.reshape(-1).view(np.uint8))


def _jpeg(header: Any, content: bytes) -> Any:
    return ros.message(COMPRESSED, header=header, format="jpeg", data=np.frombuffer(content, np.uint8))
