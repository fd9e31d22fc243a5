"""A robot with a camera for tests: publishes poses, CameraInfo and a simulator's images, and saves what it sees.

Arguments: FOLDER tf|odometry. It drives along x and ends when it has received an image of each output; FOLDER then
contains an .npz of each: `time` in seconds, `frame`, and `data`, or fields of the CameraInfo; of the table of instances
its `text`.
"""

from __future__ import annotations

import math
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.types import Camera
from scan2sim.services import transport
from scan2sim.services.transport import QoS

CAMERA = Camera("opencv", 80, 60, 60.0, 60.0, 39.5, 29.5, (-0.1, 0.02, 0.0, 0.0, 0.0))
SPEED = 0.2
"""Metres per second along x, in simulated time, which begins with 100 s."""
BEGIN_S, STEP_S = 100.0, 0.05
START = (-4.0, -4.0, 0.0)
"""Where it is when time begins, in the world."""
MOUNT = (0.2, 0.0, 2.0, 0.0, 15.0, 45.0)
"""Pose of its camera: x, y, z in metres; roll, pitch, yaw in degrees."""
OBJECT_M, OBJECT_RGB = 1.5, (250, 20, 30)
"""Distance and colour of what the simulator shows in the left half of its image."""
HEADER, TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
IMAGE, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
STRING = "std_msgs/msg/String"
TF, ODOMETRY = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"
OUTPUTS = {
    "image_raw": IMAGE,
    "image_raw/compressed": COMPRESSED,
    "depth": IMAGE,
    "classes": IMAGE,
    "instances": IMAGE,
    "instance_table": STRING,
    "camera_info": INFO,
}
OPTICAL = look_at((0, 0, 2), (4, 4, 0.5))[:3, :3]
"""Rotation of the camera's optical axes to the robot's, in the mode tf."""


def position(seconds: float) -> np.ndarray:
    """Position of the robot in the world."""
    return np.add(START, (SPEED * (seconds - BEGIN_S), 0.0, 0.0))


class Robot:
    """Publishers and subscriptions of the robot."""

    def __init__(self, folder: Path, mode: str) -> None:
        self.folder, self.mode, self.received = folder, mode, set[str]()
        self.ros: Any = transport.load()
        self.ros.init()
        self.node = self.ros.Node("robot")
        self.tf, self.tf_static = self.publisher(TF, "/tf"), self.publisher(TF, "/tf_static", "TRANSIENT_LOCAL")
        self.odom, self.info = self.publisher(ODOMETRY, "/odom"), self.publisher(INFO, "/front/camera_info")
        self.image, self.depth = self.publisher(IMAGE, "/front/image"), self.publisher(IMAGE, "/front/depth_image")
        for name, kind in OUTPUTS.items():
            topic, save = f"/world_camera/{name}", partial(self.save, name)
            qos = QoS(depth=5, durability="TRANSIENT_LOCAL" if kind == STRING else "VOLATILE")
            self.node.create_subscription(self.ros.message_type(kind), topic, save, qos)

    def publisher(self, kind: str, topic: str, durability: Any = "VOLATILE") -> Any:
        return self.node.create_publisher(self.ros.message_type(kind), topic, QoS(depth=50, durability=durability))

    def drive(self) -> None:
        """Publish until every output has arrived."""
        self.tf_static.publish(
            self.transforms(
                0.0, ("world", "odom", (0, 0, 0), np.eye(3)), ("base", "eye_optical_frame", (0, 0, 2), OPTICAL)
            )
        )
        now = BEGIN_S
        while self.received != set(OUTPUTS):
            now += STEP_S
            self.publish(now)
            end = time.monotonic() + STEP_S
            while (left := end - time.monotonic()) > 0:
                self.ros.spin_once(self.node, left)
        self.node.destroy_node()
        self.ros.shutdown()

    def publish(self, now: float) -> None:
        """Publish the messages of a step: invalid ones before the valid ones."""
        self.info.publish(self.camera_info(now, np.ones(12)))
        self.info.publish(self.camera_info(now, np.array(CAMERA.distortion)))
        if self.mode == "tf":
            broken = self.transforms(now, ("odom", "base", (0, 0, 0), np.eye(3)))
            broken.transforms[0].transform.rotation.w = math.nan
            self.tf.publish(broken)
            self.tf.publish(self.transforms(now, ("odom", "base", position(now), np.eye(3))))
            return
        message = self.ros.message(ODOMETRY, header=self.header(now, "odom"), child_frame_id="base")
        place = message.pose.pose.position
        place.x, place.y, place.z = (position(now) - START).tolist()
        self.odom.publish(message)  # the first with a quaternion that is zero
        message.pose.pose.orientation.w = 1.0
        self.odom.publish(message)
        left = np.arange(CAMERA.width) < CAMERA.width / 2
        depth = np.tile(np.where(left, OBJECT_M, np.inf).astype(np.float32), (CAMERA.height, 1))
        colour = np.tile(np.array(OBJECT_RGB, np.uint8), (CAMERA.height, CAMERA.width, 1))
        self.image.publish(self.picture(now, "rgb8", colour))
        self.depth.publish(self.picture(now, "32FC1", depth))

    def header(self, now: float, frame: str) -> Any:
        seconds, rest = divmod(round(now * 1e9), 10**9)
        return self.ros.message(HEADER, stamp=self.ros.message(TIME, sec=seconds, nanosec=rest), frame_id=frame)

    def transforms(self, now: float, *links: tuple[str, str, Any, Any]) -> Any:
        made = []
        for parent, child, place, rotation in links:
            one = self.ros.message(
                "geometry_msgs/msg/TransformStamped", header=self.header(now, parent), child_frame_id=child
            )
            x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
            one.transform.translation.x, one.transform.translation.y, one.transform.translation.z = map(float, place)
            one.transform.rotation.x, one.transform.rotation.y = x, y
            one.transform.rotation.z, one.transform.rotation.w = z, w
            made.append(one)
        return self.ros.message(TF, transforms=made)

    def camera_info(self, now: float, d: np.ndarray) -> Any:
        c = CAMERA
        k = np.array([c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1])
        size = {"width": c.width, "height": c.height, "distortion_model": "plumb_bob"}
        p = np.insert(k, [3, 6, 9], 0.0)
        header = self.header(now, "eye_optical_frame")
        return self.ros.message(INFO, header=header, **size, d=d, k=k, r=np.eye(3).ravel(), p=p)

    def picture(self, now: float, encoding: str, pixels: np.ndarray) -> Any:
        size = {"width": CAMERA.width, "height": CAMERA.height, "step": pixels.nbytes // CAMERA.height}
        data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
        return self.ros.message(IMAGE, header=self.header(now, "eye"), encoding=encoding, **size, data=data)

    def save(self, name: str, message: Any) -> None:
        """Save the latest message of an output."""
        self.received.add(name)
        if name == "instance_table":
            np.savez(self.folder / f"{name}.npz", text=message.data)
            return
        stamp = message.header.stamp
        fields = {"time": stamp.sec + 1e-9 * stamp.nanosec, "frame": message.header.frame_id}
        if name == "camera_info":
            fields |= {"d": message.d, "k": message.k, "p": message.p}
        else:
            fields |= {"data": np.frombuffer(bytes(message.data), np.uint8)}
        np.savez(self.folder / f"{name.replace('/', '_')}.npz", **fields)


if __name__ == "__main__":
    Robot(Path(sys.argv[1]), sys.argv[2]).drive()
