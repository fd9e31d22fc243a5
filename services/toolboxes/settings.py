"""What all toolboxes are told, on the command line as in code."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.parameters import Device, File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.http.settings import Served
from scan2sim.services.monitoring.settings.monitor import NodeName, Topic, Watched

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


Batch = Annotated[int, Field(ge=1, le=256, description="Images that the model is given at once, at most.")]
Waiting = Annotated[
    int, Field(ge=1, le=10_000, description="Images of one source that wait; then its oldest are dropped.")
]
Deadline = Annotated[
    float, Field(ge=0.01, le=3600, description="Seconds from an image's coming to its result; later ones are none.")
]
"""Settings whose defaults differ by toolbox."""


class ToolboxParams(Params):
    """Of every toolbox."""

    weights: Annotated[
        File | None, Field(description="The model's file on this disk; default: the one that comes along.")
    ] = None
    sha256: Annotated[
        str | None, Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256 that the model's file must have.")
    ] = None
    device: Annotated[Device, Field(description="auto, cpu, cuda, or cuda:1 for the second GPU.")] = "auto"
    threads: Annotated[int, Field(ge=0, le=1024, description="Threads of the model; 0: one a core.")] = 0
    batch: Batch = 1
    linger: Annotated[
        float, Field(ge=0, le=10, description="Seconds to wait for a batch to fill, once there is an image.")
    ] = 0.02
    waiting: Waiting = 2
    deadline: Deadline = 2.0
    hangs: Annotated[
        float, Field(ge=0.1, le=3600, description="Seconds without an answer after which the model is restarted.")
    ] = 60.0


class NodeParams(Watched):
    """Of a toolbox as a node."""

    images: Annotated[list[Topic], Field(min_length=1, description="Topics of images; several may be named.")]
    results: Annotated[str, Field(description="Topic for results, std_msgs/String with JSON.")] = "results"
    compressed: Annotated[bool, Field(description=f"Images are {COMPRESSED}, not {IMAGE}.")] = False
    events_topic: Annotated[str, Field(description="Topic of ROS 2 and of Kafka with events.")] = "bus_events"


class CameraParams(Watched):
    """Of a camera as a node."""

    images: Annotated[
        str,
        Field(min_length=1, max_length=2000, description="Folder, picture or video; or rtsp://..., a device's number."),
    ]
    topic: Topic
    name: NodeName = "camera"
    rate: Annotated[
        float | None, Field(ge=0.01, le=1000, description="Images a second; default: the video's, 10 of others.")
    ] = None
    loop: Annotated[bool, Field(description="Begin anew at the end of a folder or video.")] = False
    compressed: Annotated[bool, Field(description=f"Send {COMPRESSED} (JPEG), not {IMAGE}.")] = False
    quality: Annotated[int, Field(ge=5, le=100, description="Quality of the JPEGs.")] = 80
    subscribers: Annotated[int, Field(ge=0, le=1000, description="Subscriptions to wait for before it begins.")] = 0


class ServeParams(Served):
    """Of a toolbox that is served by HTTP."""

    camera: Annotated[
        list[Annotated[str, Field(min_length=1, max_length=2000)]] | None,
        Field(max_length=64, description="Camera that it reads by itself: rtsp://..., http://..., a device's number."),
    ] = None
