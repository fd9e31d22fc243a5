"""ROS 2 vehicles: publishes `Twist`, `TwistStamped` or `AckermannDriveStamped`, and subscribes to odometry.

The commanded speed is throttle times the maximum speed, reduced by the brake: controllers of such vehicles track a
commanded speed and limit its rate of change.
"""

from __future__ import annotations

import math
import time
from typing import Annotated, Any, Literal

from pydantic import Field

from scan2sim.pipeline.core import step
from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState
from scan2sim.services.teleoperation.vehicle.adapters import Vehicle, VehicleUnreachable
from scan2sim.services.transport import QoS, load
from scan2sim.services.transport.names import TopicName, qualified

MESSAGE_TYPES = {
    "twist": "geometry_msgs/msg/Twist",
    "twist_stamped": "geometry_msgs/msg/TwistStamped",
    "ackermann": "ackermann_msgs/msg/AckermannDriveStamped",
}
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
COMMAND_QOS = QoS(depth=1)
ODOMETRY_QOS = QoS(reliability="BEST_EFFORT", depth=1)
"""Best effort, to match publishers of either reliability."""
ODOMETRY_TIMEOUT_S = 1.0
"""Silence of odometry after which it is reported as a fault."""


class Params(step.Params):
    """Settings of a ROS 2 vehicle."""

    topic: Annotated[TopicName, Field(description="Topic on which commands are published.")] = "cmd_vel"
    message: Annotated[
        Literal["twist", "twist_stamped", "ackermann"], Field(description="Message type of the commands.")
    ] = "twist"
    odometry: Annotated[str, Field(description='Topic of the vehicle\'s odometry; "": none.')] = "odom"
    speed: Annotated[float, Field(gt=0, le=60, description="Speed at full throttle, m/s.")] = 1.0
    angle: Annotated[float, Field(gt=0, le=1.5, description="Angle of the front wheels at full steering, radians.")] = (
        0.6
    )
    wheelbase: Annotated[
        float, Field(gt=0, le=20, description="Distance between the axles, metres; converts steering to a yaw rate.")
    ] = 0.5


def connect(params: Params) -> Vehicle:
    """See `adapters.VehicleAdapter`."""
    return RosVehicle(params)


class RosVehicle:
    """See `adapters.Vehicle`.

    Raises:
        SettingError: the transport doesn't know the message type.
        UnavailableError: there is no transport.
    """

    def __init__(self, params: Params) -> None:
        self._params, self._ros = params, load()
        self._ros.init()
        self._node = self._ros.Node("teleoperation")
        self._topic = qualified(params.topic)
        self._type = MESSAGE_TYPES[params.message]
        self._publisher = self._node.create_publisher(self._ros.message_type(self._type), self._topic, COMMAND_QOS)
        self._state, self._last_odometry, self._gear = VehicleState(), time.monotonic(), Gear.NEUTRAL
        if params.odometry:
            odometry = self._ros.message_type(ODOMETRY_TYPE)
            self._node.create_subscription(odometry, qualified(params.odometry), self._receive_odometry, ODOMETRY_QOS)

    def obey(self, controls: Controls) -> None:
        """Publish the controls, and process odometry."""
        self._publisher.publish(self._message(controls))
        self._gear = controls.gear
        self._ros.spin_once(self._node, 0.0)
        if self._publisher.get_subscription_count() == 0:
            raise VehicleUnreachable(f"nothing subscribes to {self._topic}")

    def state(self) -> VehicleState:
        """State from the last odometry."""
        faults: tuple[str, ...] = ()
        if self._params.odometry and time.monotonic() - self._last_odometry > ODOMETRY_TIMEOUT_S:
            faults = (f"no odometry on {qualified(self._params.odometry)}",)
        return VehicleState(self._state.speed, self._state.position, self._state.heading, self._gear, faults)

    def close(self) -> None:
        """Shut down ROS 2."""
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

    def _receive_odometry(self, message: Any) -> None:
        position, q = message.pose.pose.position, message.pose.pose.orientation
        heading = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        self._state = VehicleState(float(message.twist.twist.linear.x), (float(position.x), float(position.y)), heading)
        self._last_odometry = time.monotonic()
