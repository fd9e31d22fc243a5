"""Settings of all toolboxes, for code and command line."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.parameters import Device, File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.monitoring.settings.monitor import MonitorParams, NodeName, Topic

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


Batch = Annotated[int, Field(ge=1, le=256, description="Maximum batch size: images per run of the model.")]
Waiting = Annotated[
    int, Field(ge=1, le=10_000, description="Queue length per source in images; the oldest are dropped beyond it.")
]
Deadline = Annotated[
    float,
    Field(
        ge=0.01,
        le=3600,
        description="Seconds from an image's arrival to its result; images that would be later are skipped.",
    ),
]
"""Types of settings whose defaults differ between toolboxes."""


class ToolboxParams(Params):
    """Settings of every toolbox."""

    weights: Annotated[
        File | None, Field(description="Local weights file of the model; default: the included weights.")
    ] = None
    sha256: Annotated[
        str | None, Field(pattern=r"^[0-9a-f]{64}$", description="Expected SHA-256 of the weights file.")
    ] = None
    device: Annotated[
        Device, Field(description="Device of the model: auto, cpu, cuda, or cuda:1 for the second GPU.")
    ] = "auto"
    threads: Annotated[int, Field(ge=0, le=1024, description="CPU threads of the model; 0: one per core.")] = 0
    batch: Batch = 1
    linger: Annotated[
        float, Field(ge=0, le=10, description="Seconds to wait for further images of a batch after the first.")
    ] = 0.02
    waiting: Waiting = 2
    deadline: Deadline = 2.0
    hangs: Annotated[
        float, Field(ge=0.1, le=3600, description="Seconds without a response after which the model is restarted.")
    ] = 60.0


class NodeParams(MonitorParams):
    """Settings of a toolbox as a ROS 2 node."""

    images: Annotated[list[Topic], Field(min_length=1, description="Topic of images; may be repeated.")]
    results: Annotated[str, Field(description="Topic of the results, JSON in std_msgs/String.")] = "results"
    compressed: Annotated[bool, Field(description=f"Subscribe to images of type {COMPRESSED} instead of {IMAGE}.")] = (
        False
    )
    events_topic: Annotated[str, Field(description="ROS 2 and Kafka topic of events.")] = "bus_events"


class CameraParams(MonitorParams):
    """Settings of a camera as a ROS 2 node."""

    images: Annotated[
        str,
        Field(
            min_length=1,
            max_length=2000,
            description="Folder of images, image or video; or a camera: rtsp://..., http://... or a device number.",
        ),
    ]
    topic: Topic
    name: NodeName = "camera"
    rate: Annotated[
        float | None,
        Field(ge=0.01, le=1000, description="Images per second; default: that of the video, 10 for others."),
    ] = None
    loop: Annotated[bool, Field(description="Restart at the end of a folder or video.")] = False
    compressed: Annotated[bool, Field(description=f"Publish {COMPRESSED} (JPEG) instead of {IMAGE}.")] = False
    quality: Annotated[int, Field(ge=5, le=100, description="JPEG quality, 5 to 100.")] = 80
    subscribers: Annotated[int, Field(ge=0, le=1000, description="Start when there are this many subscribers.")] = 0


class ServeParams(ServerParams):
    """Settings of a toolbox as an HTTP service."""

    grpc_port: Annotated[
        int | None,
        Field(ge=0, le=65535, description="Port for gRPC, in addition to HTTP; 0: any free port."),
    ] = None
    camera: Annotated[
        list[Annotated[str, Field(min_length=1, max_length=2000)]] | None,
        Field(
            max_length=64,
            description="Camera that the toolbox reads itself: rtsp://..., http://... or a device number; may be"
            " repeated.",
        ),
    ] = None
