"""Settings of the world camera, for code and command line."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.services.monitoring.settings.monitor import MonitorParams, NodeName
from scan2sim.services.transport.names import TopicName, qualified
from scan2sim.services.world_camera.pose_source import Axes

PosePart = Annotated[float, Field(ge=-1e6, le=1e6)]
Pose = tuple[PosePart, PosePart, PosePart, PosePart, PosePart, PosePart]
"""x, y, z in metres; roll, pitch, yaw in degrees about the fixed axes x, y, z."""
FrameName = Annotated[str, Field(max_length=256)]
OUTPUTS = ("image_raw", "image_raw/compressed", "depth", "classes", "instances", "instance_table", "camera_info")
"""Topics below `topic`."""


class WorldCameraParams(MonitorParams):
    """Settings of a camera in a finished world as a ROS 2 node.

    Raises:
        SettingError: settings contradict each other.
    """

    world: Annotated[File, Field(description="Output folder of `scan2sim run` or `survey`.")]
    topic: Annotated[
        TopicName,
        Field(
            description="Prefix of the published topics: TOPIC/image_raw, TOPIC/image_raw/compressed, TOPIC/depth, "
            "TOPIC/classes, TOPIC/instances, TOPIC/instance_table, TOPIC/camera_info."
        ),
    ] = "world_camera"
    name: NodeName = "world_camera"
    camera_info: Annotated[
        TopicName | None,
        Field(
            description="Topic of the CameraInfo with size, intrinsics and frame; default: --width, --height, --field."
        ),
    ] = None
    rectified: Annotated[
        bool, Field(description="Show the rectified image of the CameraInfo (its P, without distortion).")
    ] = False
    width: Annotated[int, Field(ge=16, le=8192, description="Width in pixels, without --camera-info.")] = 640
    height: Annotated[int, Field(ge=16, le=8192, description="Height in pixels, without --camera-info.")] = 480
    field: Annotated[
        float, Field(ge=1, le=170, description="Horizontal field of view in degrees, without --camera-info.")
    ] = 80.0
    frame: Annotated[
        FrameName,
        Field(
            description="Frame of the camera in /tf, and in the headers of the images; default: that of the "
            "CameraInfo; with --odometry alone the name of the node."
        ),
    ] = ""
    fixed_frame: Annotated[
        FrameName, Field(min_length=1, description="Frame in /tf that doesn't move in the world: world, map or odom.")
    ] = "world"
    tf: Annotated[TopicName, Field(description="Topic of the transforms; static ones are on TOPIC_static.")] = "/tf"
    odometry: Annotated[
        TopicName | None,
        Field(description="Topic of nav_msgs/Odometry with the pose of the robot, instead of /tf; see --mount."),
    ] = None
    origin: Annotated[
        Pose | None,
        Field(
            description="Pose of the fixed frame, or of the odometry's origin, in the world: X Y Z in metres, ROLL "
            "PITCH YAW in degrees. Default: where the robot starts, for odometry and the frame odom; the robot's "
            "map, for the frame map; otherwise that of the world."
        ),
    ] = None
    mount: Annotated[
        Pose,
        Field(
            description="Pose of the camera on the robot (--odometry; x ahead, y left, z up), or in its frame in /tf "
            "(along the axes of this frame): X Y Z in metres, ROLL PITCH YAW in degrees."
        ),
    ] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    axes: Annotated[
        Axes,
        Field(
            description="Axes of the camera's frame: optical (x right, y down, z ahead) or body (x ahead, y left, z "
            "up). Default auto: optical in /tf if the name of the frame ends in optical, optical_frame or "
            "optical_link."
        ),
    ] = "auto"
    rate: Annotated[
        float,
        Field(ge=0.01, le=1000, description="Images per second at most, without --image, which sets their times."),
    ] = 10.0
    quality: Annotated[int, Field(ge=5, le=100, description="JPEG quality of the compressed images, 5 to 100.")] = 80
    readout: Annotated[
        float, Field(ge=0, le=1, description="Rolling shutter: seconds from the first row to the last; 0: global.")
    ] = 0.0
    exposure: Annotated[
        float, Field(ge=-10, le=10, description="Exposure in EV (stops) relative to the world's: 1 doubles the light.")
    ] = 0.0
    image: Annotated[
        TopicName | None,
        Field(
            description="Topic of the simulator's image of the same camera, shown where it is nearer than the world; "
            "needs --depth-image. The published images have their time stamps."
        ),
    ] = None
    depth_image: Annotated[
        TopicName | None, Field(description="Topic of the simulator's depth image of the same camera.")
    ] = None
    tolerance: Annotated[
        float,
        Field(
            ge=0,
            le=100,
            description="Metres by which the simulator's depth must be nearer than the world's; 0 if its camera "
            "doesn't see the world.",
        ),
    ] = 0.1
    farthest: Annotated[
        float, Field(ge=1, le=100_000, description="Distance in metres beyond which tiles of a survey aren't drawn.")
    ] = 300.0

    @model_validator(mode="after")
    def _are_consistent(self) -> Self:
        if (self.image is None) != (self.depth_image is None):
            raise SettingError("--image", "needs --depth-image, and the other way round", "Give both topics, or none")
        if self.odometry is None and not (self.frame or self.camera_info):
            remedy = "Give --frame, --camera-info, or --odometry and --mount"
            raise SettingError("--frame", "the frame of the camera isn't known", remedy)
        outputs = {qualified(f"{self.topic}/{name}") for name in OUTPUTS}
        for option in ("camera_info", "image", "depth_image"):
            topic = getattr(self, option)
            if topic is not None and qualified(topic) in outputs:
                cause = f"{topic} is published by this camera"
                raise SettingError(f"--{option.replace('_', '-')}", cause, "Give another --topic")
        return self
