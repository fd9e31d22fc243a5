"""Settings of the gateway, station, vehicle, demo and measurement; command-line options are made from them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.qos.requirements import Environment
from scan2sim.services.teleoperation.control.safety import COMMAND_MAX_AGE_MS
from scan2sim.services.teleoperation.gateway_protocol import Address

GATEWAY_PORT, STATION_PORT = 7443, 7444
"""Default ports: TCP port of the gateway, UDP port of a station."""
ADAPTER_PORT = 7447
"""Default UDP port of an adapter."""

ImageSide = Annotated[int, Field(ge=16, le=4096)]
CertificateFolder = Annotated[
    Path,
    Field(description="Folder with this party's certificate: DIR/ROLE-NAME, written by `teleop certificates DIR`."),
]
GatewayAddress = Annotated[str, Field(description="HOST[:PORT] of the gateway; default port 7443.")]


def parse_address(option: str, text: str, default_port: int) -> Address:
    """Parse "HOST", "HOST:PORT" or "[HOST]:PORT".

    Args:
        option: command-line option that the text was given to, for the error.
        default_port: used where the text names no port.

    Raises:
        SettingError: the text has none of these forms, or the port is not in 1 to 65535.
    """
    found = re.fullmatch(r"(?:\[([0-9a-fA-F:.%]+)\]|([^:\[\]\s]+))(?::(\d{1,5}))?", text)
    number = default_port if found is None or found[3] is None else int(found[3])
    if found is None or not 0 < number < 65536:
        remedy = "Give a host name or an IP address, with or without a port, as 192.0.2.1:7443"
        raise SettingError(option, f"{text:.60} is not HOST or HOST:PORT", remedy)
    return Address(host=found[1] or found[2], port=number)


class PageParams(ServerParams):
    """Settings of a page for named drivers; `ServerParams` has those of every page."""

    PROTECTION: ClassVar[str] = f"--drivers FILE, {ServerParams.PROTECTION}"

    drivers: Annotated[
        File | None,
        Field(
            description="File of named drivers with their roles and tokens, written by `teleop drivers`; replaces "
            "--token. Default: anybody who has the page can do everything."
        ),
    ] = None

    oidc: Annotated[
        File | None,
        Field(
            description="TOML file of an OpenID provider at which drivers sign in, if --drivers has their logins "
            "(docs/teleoperation.md)."
        ),
    ] = None

    def has_protection(self) -> bool:
        """Whether a token, a certificate, or named drivers are given."""
        return self.drivers is not None or super().has_protection()

    def is_open(self) -> bool:
        """See `ServerParams`."""
        return self.drivers is None and super().is_open()


class GatewayParams(PageParams):
    """Settings of the gateway; `PageParams` has those of its web page."""

    certificates: CertificateFolder
    listening: Annotated[
        str, Field(description="HOST:PORT (TCP) on which the gateway accepts vehicles and stations.")
    ] = f"0.0.0.0:{GATEWAY_PORT}"
    state: Annotated[Path, Field(description="Folder for the fleet's pairs and the audit trail.")] = Path(
        "teleop-state"
    )


MapWorld = Annotated[
    File | None,
    Field(
        description="Folder of a finished world whose roads the driver page shows as a map, for a vehicle that reports "
        "its position in this world. Default: no map."
    ),
]


class StationParams(PageParams):
    """Settings of a station; `PageParams` has those of its web page."""

    certificates: CertificateFolder
    gateway: GatewayAddress
    listening: Annotated[
        tuple[str, ...],
        Field(description="HOST:PORT (UDP) on which the station accepts vehicles; repeat for several addresses."),
    ] = (f"0.0.0.0:{STATION_PORT}",)
    world: MapWorld = None
    record: Annotated[
        File | None,
        Field(description="Folder to record drives in, as MCAP. Default: drives are not recorded."),
    ] = None
    record_limit: Annotated[
        float, Field(ge=0.01, le=10_000, description="Maximum size of all recorded drives, GB; the oldest are deleted.")
    ] = 20.0
    reached: Annotated[
        tuple[str, ...],
        Field(
            description="HOST:PORT that vehicles connect to, where it differs from the listening address: behind a "
            "router that forwards a port. Default: the listening address."
        ),
    ] = ()


class ReplayParams(ServerParams):
    """Settings of the replay of a recorded drive; `ServerParams` has those of its page."""

    recording: Annotated[File, Field(description="Folder of `teleop station --record`, or one drive in it.")]
    speed: Annotated[float, Field(ge=0.1, le=20, description="Speed of the replay; 1: as recorded.")] = 1.0
    world: MapWorld = None


class ExportParams(Params):
    """Settings of the export of recorded drives."""

    recording: Annotated[File, Field(description="Folder of `teleop station --record`, or one drive in it.")]
    out: Annotated[Path, Field(description="Folder of the bag to write; must not exist.")]
    rate: Annotated[float, Field(ge=0.1, le=60, description="Maximum number of images of each camera, per second.")] = (
        10.0
    )


class OnboardParams(Params):
    """Settings of an onboard unit's connection to its vehicle adapter."""

    adapter: Annotated[str, Field(description="HOST:PORT (UDP) of the vehicle adapter (`teleop adapter`).")] = (
        f"127.0.0.1:{ADAPTER_PORT}"
    )
    key: Annotated[
        File | None,
        Field(
            description="File with the key shared with the vehicle adapter. Default: adapter.key in the folder of the "
            "vehicle's certificate."
        ),
    ] = None
    limit: Annotated[
        float,
        Field(
            ge=20, le=5000, description="Maximum age of a command, milliseconds; without a newer one the vehicle stops."
        ),
    ] = COMMAND_MAX_AGE_MS

    def address(self) -> tuple[str, int]:
        """Host and port of the adapter.

        Raises:
            SettingError: the setting is not HOST:PORT.
        """
        host, colon, port = self.adapter.rpartition(":")
        if not colon or not port.isdecimal() or not 0 < int(port) < 65536:
            raise SettingError("adapter", f"{self.adapter!r} is not HOST:PORT", "Write it as 127.0.0.1:7447")
        return host.strip("[]"), int(port)


class VehicleParams(OnboardParams):
    """Settings of a vehicle; `OnboardParams` has those of the connection to its vehicle adapter."""

    certificates: CertificateFolder
    gateway: GatewayAddress
    link: Annotated[
        tuple[str, ...],
        Field(
            description="Network link to the station as NAME=ADDRESS or NAME=INTERFACE of this machine; repeat for "
            "several links. Default: one link over the system's default route."
        ),
    ] = ()
    camera: Annotated[
        tuple[str, ...],
        Field(
            description="Camera as NAME=KIND:WHERE, such as front=device:/dev/video0; repeat for several cameras. "
            "KIND is device, replay, pattern, world (its splats, if it has any) or surfaces (of a world); after the "
            "folder of a world, @DEGREES turns the camera left."
        ),
    ] = ()
    share: Annotated[
        bool,
        Field(
            description="Send each video packet over one link in turn: more bandwidth, no redundancy. "
            "Default: each packet goes over all links."
        ),
    ] = False
    size: Annotated[
        tuple[ImageSide, ImageSide], Field(description="Requested width and height of camera frames, pixels.")
    ] = (
        640,
        480,
    )
    rate: Annotated[float, Field(ge=1, le=60, description="Maximum frame rate of each camera, frames/s.")] = 30.0
    bitrate: Annotated[
        float,
        Field(ge=0.2, le=100, description="Maximum bit rate of each camera, Mbit/s; the rate adapts to the links."),
    ] = 2.5


class DemoParams(Params):
    """Settings of the demo: gateway, station and simulated vehicle on one machine."""

    world: Annotated[File, Field(description="Folder of a finished world, written by `run --out` or `survey --out`.")]
    port: Annotated[
        int, Field(ge=1024, le=65534, description="Port of the driver page; the fleet page uses port + 1.")
    ] = 8080
    cameras: Annotated[
        int | None,
        Field(
            ge=1,
            le=4,
            description="Number of cameras: front, left, right, rear, in this order. Default: 4; 1 in a world with "
            "splats, which take longer to render.",
        ),
    ] = None
    surfaces: Annotated[
        bool, Field(description="Show textured surfaces although the world has splats: more frames/s.")
    ] = False
    rate: Annotated[
        float,
        Field(ge=1, le=30, description="Maximum frame rate of each camera, frames/s; limited by rendering speed."),
    ] = 15.0


class MeasureParams(Params):
    """Settings of a quality of service measurement."""

    environment: Annotated[
        Environment, Field(description="Where the station runs, which selects the network: robot, edge or cloud.")
    ] = Environment.EDGE
    seconds: Annotated[float, Field(ge=1, le=86_400, description="Duration of the measurement, seconds.")] = 30.0
    warm: Annotated[
        float,
        Field(ge=0, le=600, description="Seconds driven before the measurement, while the video bit rate adapts."),
    ] = 10.0
    cameras: Annotated[
        int, Field(ge=1, le=16, description="Number of cameras of the vehicle, each 640x480 at 30 frames/s.")
    ] = 4
    bitrate: Annotated[
        float | None,
        Field(
            ge=0.2, le=100, description="Maximum bit rate of each camera, Mbit/s. Default: from the required data rate."
        ),
    ] = None
    network: Annotated[
        File | None,
        Field(description="TOML file that describes the network. Default: the environment's assumed network."),
    ] = None
    world: Annotated[
        File | None,
        Field(description="Folder of a finished world to drive in. Default: driving in bends on a plain."),
    ] = None
