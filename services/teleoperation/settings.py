"""What gateway, vehicle and station are told, on the command line as in code."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.http.settings import Served
from scan2sim.services.qos.requirements import Environment
from scan2sim.services.teleoperation.gateway.protocol import Address
from scan2sim.services.teleoperation.vehicle.onboard_unit import CarParams

GATEWAY, STATION = 7443, 7444
"""Ports that are listened on, unless another is named."""

Side = Annotated[int, Field(ge=16, le=4096)]
Folder = Annotated[Path, Field(description="Folder of its certificate: DIR/ROLE-NAME of `teleop certificates DIR`.")]
Named = Annotated[str, Field(description="HOST:PORT of the gateway.")]


def address(where: str, text: str, port: int) -> Address:
    """Of "HOST", "HOST:PORT" or "[HOST]:PORT".

    Args:
        where: the option that says so.
        port: where none is said.

    Raises:
        SettingError: it is none of these.
    """
    found = re.fullmatch(r"(?:\[([0-9a-fA-F:.%]+)\]|([^:\[\]\s]+))(?::(\d{1,5}))?", text)
    number = port if found is None or found[3] is None else int(found[3])
    if found is None or not 0 < number < 65536:
        raise SettingError(where, f"{text:.60} is no HOST:PORT", "Give a name or an address, as 192.0.2.1:7443")
    return Address(host=found[1] or found[2], port=number)


class GatewayParams(Served):
    """Of a gateway; `Served` is its page's."""

    certificates: Folder
    listening: Annotated[str, Field(description="HOST:PORT where vehicles and stations connect.")] = (
        f"0.0.0.0:{GATEWAY}"
    )
    state: Annotated[Path, Field(description="Folder that pairs and the audit trail are kept in.")] = Path(
        "teleop-state"
    )


class StationParams(Served):
    """Of a station; `Served` is its page's."""

    certificates: Folder
    gateway: Named
    listening: Annotated[
        tuple[str, ...], Field(description="HOST:PORT where vehicles dial; given again for another link.")
    ] = (f"0.0.0.0:{STATION}",)
    reached: Annotated[
        tuple[str, ...],
        Field(description="HOST:PORT that vehicles are to dial; default: where it listens. Needed behind a router."),
    ] = ()


class VehicleParams(CarParams):
    """Of a vehicle; `CarParams` is its way to its translator."""

    certificates: Folder
    gateway: Named
    link: Annotated[
        tuple[str, ...],
        Field(description="NAME=ADDRESS or NAME=INTERFACE of this machine's; given again for each. Default: one."),
    ] = ()
    camera: Annotated[
        tuple[str, ...],
        Field(
            description="NAME=KIND:WHERE, as front=device:/dev/video0; given again for each. Kinds: device, replay, "
            "pattern, world; @DEGREES to the left after a world's folder."
        ),
    ] = ()
    share: Annotated[
        bool, Field(description="Video takes the links in turn, for more bandwidth; default: each takes all of it.")
    ] = False
    size: Annotated[
        tuple[Side, Side], Field(description="Width and height of pictures that a camera is asked for.")
    ] = (
        640,
        480,
    )
    rate: Annotated[float, Field(ge=1, le=60, description="Pictures a second, at most.")] = 30.0
    bitrate: Annotated[
        float, Field(ge=0.2, le=100, description="Mbit/s of a camera's video, at most; it follows the links.")
    ] = 2.5


class DemoParams(Params):
    """Of the demonstration."""

    world: Annotated[File, Field(description="Folder of a finished world: that of `run --out` or `survey --out`.")]
    port: Annotated[int, Field(ge=1024, le=65534, description="Of the driver's page; the fleet's is the next.")] = 8080
    cameras: Annotated[int, Field(ge=1, le=4, description="Of the car: front, left, right, rear.")] = 4
    rate: Annotated[float, Field(ge=1, le=30, description="Pictures a second, as far as the machine renders them.")] = (
        15.0
    )


class MeasureParams(Params):
    """Of a measurement."""

    environment: Annotated[Environment, Field(description="Where the station is: robot, edge or cloud.")] = (
        Environment.EDGE
    )
    seconds: Annotated[float, Field(ge=1, le=86_400, description="Seconds that it is measured for.")] = 30.0
    warm: Annotated[
        float, Field(ge=0, le=600, description="Seconds driven before that: video grows to what the links carry.")
    ] = 10.0
    cameras: Annotated[int, Field(ge=1, le=16, description="Of the vehicle, 640x480 at 30 pictures a second.")] = 4
    bitrate: Annotated[
        float | None,
        Field(ge=0.2, le=100, description="Mbit/s of a camera's video, at most; default: as its requirements ask."),
    ] = None
    network: Annotated[
        File | None, Field(description="TOML of a network, in place of what the environment's is assumed to be.")
    ] = None
    world: Annotated[
        File | None,
        Field(description="Folder of a finished world, along whose street is driven; default: bends on a plain."),
    ] = None
