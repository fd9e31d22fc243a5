"""ROS 2 vehicles: publishes `Twist`, `TwistStamped` or `AckermannDriveStamped`; measures speed by odometry or wheels.

The commanded speed is throttle times the maximum speed, reduced by the brake: controllers of such vehicles track a
commanded speed and limit its rate of change.

Nodes may be between this adapter and the vehicle, such as Nav2's velocity smoother and collision monitor. `output` is
the topic behind them: the adapter sees there what they pass on, and publishes the stop itself if they don't.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from scan2sim.pipeline.core import step
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.teleoperation.control.controls import Controls, Gear, VehicleState
from scan2sim.services.teleoperation.vehicle.adapters import STATE_MAX_AGE_S, Vehicle, VehicleUnreachable
from scan2sim.services.transport import QoS, load
from scan2sim.services.transport.names import TopicName, qualified

MESSAGE_TYPES = {
    "twist": "geometry_msgs/msg/Twist",
    "twist_stamped": "geometry_msgs/msg/TwistStamped",
    "ackermann": "ackermann_msgs/msg/AckermannDriveStamped",
}
ODOMETRY_TYPE, JOINT_STATE_TYPE = "nav_msgs/msg/Odometry", "sensor_msgs/msg/JointState"
COMMAND_QOS = QoS(depth=1)
MEASUREMENT_QOS = QoS(reliability="BEST_EFFORT", depth=1)
"""Best effort, to match publishers of either reliability."""
MEASUREMENT_TIMEOUT_S = 1.0
"""Silence of odometry or joint states after which it is reported as a fault."""
OUTPUT_TIMEOUT_S = 0.3
"""Silence on `output`, while a speed is commanded, after which the vehicle counts as unreachable."""
STANDSTILL = 1e-3
"""Commanded speed (m/s) and yaw rate (rad/s) up to which a command is a standstill."""


class Params(step.Params):
    """Settings of a ROS 2 vehicle.

    Raises:
        SettingError: `output` is the topic on which commands are published.
    """

    topic: Annotated[TopicName, Field(description="Topic on which commands are published.")] = "cmd_vel"
    message: Annotated[
        Literal["twist", "twist_stamped", "ackermann"], Field(description="Message type of the commands.")
    ] = "twist"
    output: Annotated[
        str,
        Field(
            description="Topic on which the vehicle gets its commands, if other nodes are in between (Nav2's velocity "
            'smoother, collision monitor), with the same message type; "": none are.'
        ),
    ] = ""
    stop_within: Annotated[
        float,
        Field(ge=0.05, le=10, description="Time in which nodes in between may reduce the speed to 0, seconds."),
    ] = 1.0
    odometry: Annotated[str, Field(description='Topic of the vehicle\'s odometry; "": none.')] = "odom"
    joint_states: Annotated[
        str, Field(description='Topic of joint states, from which speed is measured instead; "": none.')
    ] = ""
    wheels: Annotated[
        tuple[str, ...], Field(min_length=1, max_length=16, description="Wheel joints whose velocities are averaged.")
    ] = ("left_wheel_joint", "right_wheel_joint")
    wheel_radius: Annotated[float, Field(gt=0, le=5, description="Radius of these wheels, metres.")] = 0.165
    speed: Annotated[float, Field(gt=0, le=60, description="Speed at full throttle, m/s.")] = 1.0
    angle: Annotated[float, Field(gt=0, le=1.5, description="Angle of the front wheels at full steering, radians.")] = (
        0.6
    )
    wheelbase: Annotated[
        float, Field(gt=0, le=20, description="Distance between the axles, metres; converts steering to a yaw rate.")
    ] = 0.5

    @model_validator(mode="after")
    def _has_two_topics(self) -> Self:
        if self.output and qualified(self.output) == qualified(self.topic):
            remedy = "Give the topic behind the nodes in between, or leave it empty if there are none"
            raise SettingError("output", f"{self.output} is the topic of the commands as well", remedy)
        return self


def connect(params: Params) -> Vehicle:
    """See `adapters.VehicleAdapter`."""
    return RosVehicle(params)


class RosVehicle:
    """See `adapters.Vehicle`.

    Raises:
        SettingError: the transport doesn't know the message type.
        UnavailableError: there is no transport.
    """

    def __init__(self, params: Params, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._params, self._ros, self._clock = params, load(), clock
        self._ros.init()
        self._node = self._ros.Node("teleoperation")
        self._topic = qualified(params.topic)
        self._type = MESSAGE_TYPES[params.message]
        self._publisher = self._publisher_of(params.topic)
        self._pose = VehicleState()
        self._speed, self._speed_measured, self._gear = 0.0, clock(), Gear.NEUTRAL
        self._speed_known, self._subscriptions = False, 0
        self._output = Output(params, self._publisher_of(params.output), clock=clock) if params.output else None
        if params.odometry:
            self._subscribe(ODOMETRY_TYPE, params.odometry, self._receive_odometry)
        if params.joint_states:
            self._subscribe(JOINT_STATE_TYPE, params.joint_states, self._receive_joint_states)
        if self._output:
            self._subscribe(self._type, params.output, self._output.receive)

    def obey(self, controls: Controls) -> None:
        """Publish the controls, and process what the vehicle publishes."""
        message = self._message(controls)
        self._publisher.publish(message)
        self._gear = controls.gear
        for _ in range(self._subscriptions):  # rclpy processes one message at a time
            self._ros.spin_once(self._node, 0.0)
        if self._output:
            self._output.enforce(message, self._clock())
        if self._publisher.get_subscription_count() == 0:
            raise VehicleUnreachable(f"nothing subscribes to {self._topic}")

    def state(self) -> VehicleState:
        """Measured speed, and the last pose from odometry."""
        topic = self._params.joint_states or self._params.odometry
        now = self._clock()
        age = now - self._speed_measured
        kind = "joint states" if self._params.joint_states else "odometry"
        faults = [f"no {kind} on {qualified(topic)}"] if topic and age > MEASUREMENT_TIMEOUT_S else []
        if self._output and self._output.holds(now):
            faults.append(
                f"a node before {qualified(self._params.output)} holds the vehicle, such as a collision monitor"
            )
        speed = self._speed if self._speed_known and age <= STATE_MAX_AGE_S else None
        return VehicleState(speed, self._pose.position, self._pose.heading, self._gear, tuple(faults))

    def close(self) -> None:
        """Shut down ROS 2."""
        self._node.destroy_node()
        self._ros.shutdown()

    def _publisher_of(self, topic: str) -> Any:
        return self._node.create_publisher(self._ros.message_type(self._type), qualified(topic), COMMAND_QOS)

    def _subscribe(self, type_name: str, topic: str, receive: Any) -> None:
        self._subscriptions += 1
        self._node.create_subscription(self._ros.message_type(type_name), qualified(topic), receive, MEASUREMENT_QOS)

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
        self._pose = VehicleState(None, (float(position.x), float(position.y)), heading)
        if not self._params.joint_states:
            self._measure(float(message.twist.twist.linear.x))

    def _receive_joint_states(self, message: Any) -> None:
        """Speed from the wheels that a message has: publishers may send joints in several messages."""
        velocities = dict(zip(message.name, message.velocity, strict=False))
        turning = [float(velocities[name]) for name in self._params.wheels if name in velocities]
        if turning:
            self._measure(self._params.wheel_radius * sum(turning) / len(turning))

    def _measure(self, speed: float) -> None:
        self._speed_known = math.isfinite(speed)
        self._speed, self._speed_measured = speed, self._clock()


class Output:
    """Commands that reach the vehicle behind other nodes; publishes the stop there if these nodes don't.

    Silence during a standstill is normal: Nav2's collision monitor ceases to publish zeros after `stop_pub_timeout`.
    """

    def __init__(self, params: Params, publisher: Any, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._params, self._publisher, self._clock = params, publisher, clock
        self._moves, self._since = False, clock()  # what is commanded, and since when
        self._passed, self._received = False, -math.inf  # whether the last command there is a motion, and its arrival
        self._overrides = False

    def receive(self, message: Any) -> None:
        """Process a command behind the other nodes, or one of `enforce`."""
        self._passed, self._received = self._is_motion(message), self._clock()

    def enforce(self, command: Any, now: float) -> None:
        """Compare what is commanded, at time `now`, with what arrives; publish a stop that doesn't.

        Raises:
            VehicleUnreachable: a motion is commanded, and nothing arrives.
        """
        moves = self._is_motion(command)
        if moves != self._moves:
            self._moves, self._since = moves, now
        if moves:
            self._overrides = False
            if now - max(self._received, self._since) > OUTPUT_TIMEOUT_S:
                cause = f"nothing is published on {qualified(self._params.output)}: check the nodes before it"
                raise VehicleUnreachable(cause)
            return
        silent, late = now - self._received > OUTPUT_TIMEOUT_S, now - self._since > self._params.stop_within
        self._overrides = self._overrides or (self._passed and (silent or late))
        if self._overrides:
            self._publisher.publish(command)

    def holds(self, now: float) -> bool:
        """Whether a motion is commanded for some time, and what arrives is a standstill."""
        return self._moves and now - self._since > OUTPUT_TIMEOUT_S and not self._passed

    def _is_motion(self, message: Any) -> bool:
        if self._params.message == "ackermann":
            return abs(message.drive.speed) > STANDSTILL
        twist = message if self._params.message == "twist" else message.twist
        return bool(abs(twist.linear.x) > STANDSTILL or abs(twist.angular.z) > STANDSTILL)
