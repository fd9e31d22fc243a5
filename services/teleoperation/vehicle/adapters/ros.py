"""Vehicles of ROS 2: a `Twist`, `TwistStamped` or `AckermannDriveStamped` on a topic, their odometry from another.

The throttle is the share of the greatest speed that is asked for, the brake takes from it: what moves such vehicles
keeps a speed that it is told, and limits how fast it changes.
"""

from __future__ import annotations

import math
import time
from typing import Annotated, Any, Literal

from pydantic import Field

from scan2sim.pipeline.core import step
from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState
from scan2sim.services.teleoperation.vehicle.adapters import Unreachable, Vehicle
from scan2sim.services.transport import QoS, load
from scan2sim.services.transport.names import TopicName, qualified

TYPES = {
    "twist": "geometry_msgs/msg/Twist",
    "twist_stamped": "geometry_msgs/msg/TwistStamped",
    "ackermann": "ackermann_msgs/msg/AckermannDriveStamped",
}
ODOMETRY = "nav_msgs/msg/Odometry"
NEWEST = QoS(depth=1)
LISTENED = QoS(reliability="BEST_EFFORT", depth=1)
"""From publishers of either reliability."""
QUIET = 1.0
"""Seconds without odometry until that is told."""


class Params(step.Params):
    """Of a vehicle of ROS 2."""

    topic: Annotated[TopicName, Field(description="Where it is told what to do.")] = "cmd_vel"
    message: Annotated[Literal["twist", "twist_stamped", "ackermann"], Field(description="What it is told by.")] = (
        "twist"
    )
    odometry: Annotated[str, Field(description='Topic of its odometry; "": there is none.')] = "odom"
    speed: Annotated[float, Field(gt=0, le=60, description="Metres a second at full throttle.")] = 1.0
    angle: Annotated[float, Field(gt=0, le=1.5, description="Radians of the front wheels at full steering.")] = 0.6
    wheelbase: Annotated[
        float, Field(gt=0, le=20, description="Metres between axles, which make of the angle a turn in a twist.")
    ] = 0.5


def connect(params: Params) -> Vehicle:
    """See `translators.Translator`."""
    return RosVehicle(params)


class RosVehicle:
    """See `translators.Vehicle`.

    Raises:
        SettingError: the type of its messages isn't known here.
        UnavailableError: there is no transport.
    """

    def __init__(self, params: Params) -> None:
        self._params, self._ros = params, load()
        self._ros.init()
        self._node = self._ros.Node("teleoperation")
        self._topic = qualified(params.topic)
        self._type = TYPES[params.message]
        self._out = self._node.create_publisher(self._ros.message_type(self._type), self._topic, NEWEST)
        self._state, self._heard, self._gear = VehicleState(), time.monotonic(), Gear.NEUTRAL
        if params.odometry:
            odometry = self._ros.message_type(ODOMETRY)
            self._node.create_subscription(odometry, qualified(params.odometry), self._hear, LISTENED)

    def obey(self, controls: Controls) -> None:
        """Publish what is asked for, and take odometry."""
        self._out.publish(self._message(controls))
        self._gear = controls.gear
        self._ros.spin_once(self._node, 0.0)
        if self._out.get_subscription_count() == 0:
            raise Unreachable(f"nobody listens on {self._topic}")

    def state(self) -> VehicleState:
        """As its odometry says."""
        faults: tuple[str, ...] = ()
        if self._params.odometry and time.monotonic() - self._heard > QUIET:
            faults = (f"no odometry on {qualified(self._params.odometry)}",)
        return VehicleState(self._state.speed, self._state.position, self._state.heading, self._gear, faults)

    def close(self) -> None:
        """Leave ROS 2."""
        self._node.destroy_node()
        self._ros.shutdown()

    def _message(self, controls: Controls) -> Any:
        speed = controls.gear * controls.throttle * (1 - controls.brake) * self._params.speed
        angle = controls.steering * self._params.angle
        message = self._ros.message(self._type)
        if self._params.message == "ackermann":
            message.drive.speed, message.drive.steering_angle = speed, angle
        else:
            twist = message if self._params.message == "twist" else message.twist
            twist.linear.x, twist.angular.z = speed, speed * math.tan(angle) / self._params.wheelbase
        if self._params.message != "twist":
            now = time.time_ns()
            message.header.frame_id = "base_link"
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
        return message

    def _hear(self, message: Any) -> None:
        place, q = message.pose.pose.position, message.pose.pose.orientation
        heading = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        self._state = VehicleState(float(message.twist.twist.linear.x), (float(place.x), float(place.y)), heading)
        self._heard = time.monotonic()
