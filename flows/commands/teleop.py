"""`scan2sim teleop`: teleoperation of vehicles (services/teleoperation)."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from scan2sim.flows.commands import qos_table
from scan2sim.flows.commands.app import App, Json
from scan2sim.flows.commands.browser import open_page
from scan2sim.flows.commands.display import console, print_json, print_line, progress
from scan2sim.flows.commands.options import assigned, options
from scan2sim.flows.commands.ros_spin import stop_on_signal
from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import DataError, SettingError
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.teleoperation.access.drivers import DriverRole
from scan2sim.services.teleoperation.settings import (
    DemoParams,
    ExportParams,
    GatewayParams,
    MeasureParams,
    ReplayParams,
    StationParams,
    VehicleParams,
)
from scan2sim.services.teleoperation.vehicle import adapters
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer

if TYPE_CHECKING:
    from scan2sim.texturing.world_camera import WorldCamera

app = App("Drive vehicles remotely, over several network links at once.")
PACKAGES = ("OpenSSL", "pylibsrtp", "websockets")
"""Packages that all of these commands need, except `adapter`."""
WINDOW_HELP = "Show the driver page in a window of its own, without the controls of a browser."


@app.command("certificates")
def teleop_certificates(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", help="Folder for the certificates: of the certificate authority (CA), and one per party."
        ),
    ],
    gateway: Annotated[
        list[str] | None,
        typer.Option(
            metavar="HOST", help="Create the gateway's certificate, for this host name or address; repeatable."
        ),
    ] = None,
    vehicle: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Create a certificate for a vehicle of this name; repeatable."),
    ] = None,
    station: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Create a certificate for a driver station of this name; repeatable."),
    ] = None,
    days: Annotated[float, typer.Option(help="Days for which new certificates are valid.")] = 365,
    renew: Annotated[
        bool, typer.Option("--renew", help="Renew the named certificates even if they are still valid.")
    ] = False,
) -> None:
    """Create or renew the certificates of a gateway, vehicles and stations, and of the CA that signs them."""
    _require()
    from scan2sim.services.teleoperation.gateway.pki import certify

    if not (gateway or vehicle or station):
        raise SettingError("teleop certificates", "no party is named", "Give --gateway, --vehicle or --station")
    table = Table("party", "folder", "", "valid until (UTC)")
    for one in certify(folder, gateway or [], vehicle or [], station or [], days, renew):
        state = "created" if one.created else "unchanged"
        table.add_row(escape(one.party), escape(str(one.folder)), state, f"{one.expires:%Y-%m-%d %H:%M}")
    console.print(table)


@app.command("adapter")
@options(AdapterParams)
def teleop_adapter(
    params: AdapterParams,
    name: Annotated[
        str,
        typer.Argument(
            metavar="ADAPTER", help=f"Adapter for the interface of the vehicle: {', '.join(adapters.names())}."
        ),
    ],
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="PARAM=VALUE",
            help="Setting of the adapter, such as channel=can0; repeatable (docs/teleoperation.md, "
            "docs/teleoperation-ros.md).",
        ),
    ] = None,
) -> None:
    """Run a vehicle adapter: converts the commands of `teleop vehicle` to those of the vehicle (CAN, ROS 2, ...)."""
    adapter = adapters.find(name)
    settings = adapter.Params.of(name, assigned(set_ or (), "channel=can0"), remedy="docs/teleoperation.md lists them")
    stop = threading.Event()
    with stop_on_signal(stop):
        server = AdapterServer(adapter.connect(settings), params)
        print_line(f"{name}: listens on {server.address[0]}:{server.address[1]}; Ctrl-C stops it")
        server.run(stop, lambda news: print_line(f"the vehicle {news}"))


@app.command("gateway")
@options(GatewayParams, certificates="CERTIFICATES")
def teleop_gateway(params: GatewayParams) -> None:
    """Run the gateway that connects vehicles and stations, and serve the fleet page."""
    _require("fastapi", "uvicorn")
    from scan2sim.services.teleoperation.gateway.web import serve

    serve(params, print_line)


@app.command("station")
@options(StationParams, certificates="CERTIFICATES", gateway="GATEWAY")
def teleop_station(
    params: StationParams,
    window: Annotated[bool, typer.Option("--window", help=WINDOW_HELP)] = False,
) -> None:
    """Run a driver station: serve the driver page with the vehicle's video, and send the driver's commands."""
    _require("fastapi", "uvicorn")
    from scan2sim.services.teleoperation.station.web import serve

    serve(params, print_line, window)


@app.command("drivers")
def teleop_drivers(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="File of a station's drivers (`teleop station --drivers`).")
    ],
    add: Annotated[
        str, typer.Option(metavar="NAME", help="Add a driver, or give one a new token; the token is printed once.")
    ] = "",
    role: Annotated[DriverRole, typer.Option(help="Role of the added driver.")] = DriverRole.DRIVER,
    login: Annotated[
        str | None,
        typer.Option(
            metavar="CLAIM",
            help="The added driver has no token, but signs in at the OpenID provider of --oidc, as this: an e-mail "
            "address, or what the setting `claim` of the provider's file says.",
        ),
    ] = None,
    days: Annotated[float | None, typer.Option(help="Days until token or login expires. Default: never.")] = None,
    revoke: Annotated[str, typer.Option(metavar="NAME", help="Remove a driver, who loses control at once.")] = "",
) -> None:
    """List, add and remove the named drivers of a station."""
    from scan2sim.services.teleoperation.access import drivers

    if login is not None and not add:
        raise SettingError("--login", "is for a driver who is added", "Give --add NAME, too")
    if revoke:
        drivers.revoke(file, revoke)
    if add:
        expires = None if days is None else datetime.now(UTC) + timedelta(days=days)
        token = drivers.add(file, add, role, expires, login)
        print_line(f"token of {add}: {token}" if token else f"{add} signs in as {login}")
    table = Table("driver", "role", "credential", "expires (UTC)")
    for one in drivers.read(file):
        expiry = "never" if one.expires is None else f"{one.expires:%Y-%m-%d %H:%M}"
        table.add_row(escape(one.name), one.role, escape(one.login or "token"), expiry)
    console.print(table)


@app.command("replay")
@options(ReplayParams, recording="RECORDING")
def teleop_replay(params: ReplayParams) -> None:
    """Replay a recorded drive (`teleop station --record`) on the driver page."""
    _require("fastapi", "uvicorn", "rosbags")
    from scan2sim.services.teleoperation.station.replay import serve

    serve(params, print_line)


@app.command("export")
@options(ExportParams, recording="RECORDING", out="OUT")
def teleop_export(params: ExportParams) -> None:
    """Export recorded drives as an MCAP bag with JPEG images, for Foxglove, RViz and others."""
    _require("av", "rosbags")
    from scan2sim.services.teleoperation.station.export import export

    print_line(f"{export(params)} images in {params.out}")


@app.command("audit")
def teleop_audit(
    trail: Annotated[
        Path, typer.Argument(metavar="STATE", help="Folder of the gateway's --state, or its audit.jsonl.")
    ],
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the result and all entries as JSON, also if it finds a change.")
    ] = False,
) -> None:
    """Verify the audit trail: whether an entry was changed, removed or inserted."""
    from scan2sim.services.teleoperation.gateway.audit import read, verify

    path = trail / "audit.jsonl" if trail.is_dir() else trail
    found = verify(path)
    if as_json:
        print_json(asdict(found) | {"trail": read(path)})
    if found.damage:
        raise DataError(path, found.damage, "Compare it with a backup")
    if not as_json:
        print_line(f"{found.entries} entries, none was changed; SHA-256 of the newest: {found.head}")


@app.command("vehicle")
@options(VehicleParams, certificates="CERTIFICATES", gateway="GATEWAY")
def teleop_vehicle(params: VehicleParams) -> None:
    """Run the onboard unit of a vehicle: send its video, and pass the driver's commands to the vehicle adapter."""
    _require("av")
    from scan2sim.services.teleoperation.vehicle.app import serve

    stop = threading.Event()
    with stop_on_signal(stop):
        serve(params, stop, print_line, _open_world)


def _open_world(folder: Path) -> WorldCamera:
    """Opens a world that cameras of a simulated vehicle render from splats."""
    from scan2sim.texturing.world_camera import WorldCamera

    return WorldCamera(read_scene(folder))


@app.command("demo")
@options(DemoParams, world="WORLD")
def teleop_demo(
    params: DemoParams,
    browse: Annotated[bool, typer.Option("--browse/--no-browse", help="Open the driver page in the browser.")] = True,
    window: Annotated[bool, typer.Option("--window", help=WINDOW_HELP)] = False,
) -> None:
    """Drive a simulated car through a finished world: gateway, vehicle and station on this machine."""
    _require("av", "fastapi", "uvicorn")
    from scan2sim.services.teleoperation.sim.demo import demo
    from scan2sim.services.teleoperation.station import app_window

    if window:
        app_window.browser()
    stop = threading.Event()
    with stop_on_signal(stop), demo(params, print_line) as running, ExitStack() as stack:
        if window:
            stack.enter_context(app_window.window(running.page))
        elif browse:
            open_page(running.page)
        while not stop.wait(0.5):
            running.supervise(print_line)


@app.command("measure")
@options(MeasureParams)
def teleop_measure(params: MeasureParams, as_json: Json = False, out: qos_table.Out = None) -> None:
    """Measure latency, loss and driving of a scripted drive over an emulated network, against 5G-ERA D3.2, table 6."""
    measure_drive(params, "teleoperation", as_json=as_json, out=out)


def measure_drive(params: MeasureParams, requirements_of: str, *, as_json: bool, out: Path | None) -> None:
    """Measure a scripted drive, and report it.

    Args:
        params: settings of the measurement.
        requirements_of: name or file of the requirements.
        as_json, out: see `qos_table.report`.
    """
    _require("av", "psutil")
    from scan2sim.services.qos import requirements
    from scan2sim.services.qos.compare import compare_metrics
    from scan2sim.services.teleoperation.qos.measure import measure, percentile

    service = requirements.read(requirements_of)
    required = service.of(params.environment)
    with progress(f"teleoperation {params.environment}") as report:
        measured = measure(params, required, report)
    comparisons = compare_metrics(required, measured)
    times = measured.glass_to_glass
    lines = [
        f"{len(times)} frames were shown; glass-to-glass latency: median {percentile(times, 50):.0f} ms, "
        f"95th percentile {percentile(times, 95):.0f} ms; {measured.lost_frames:.2%} of the frames were lost",
        f"longest gap between commands: {measured.command_gap:.0f} ms",
    ]
    drive = {
        "frames": len(times),
        "glass_to_glass_p50": percentile(times, 50),
        "glass_to_glass_p95": percentile(times, 95),
        "lost_frames": measured.lost_frames,
        "command_gap": measured.command_gap,
    }
    if offsets := measured.cross_track_error:
        mean, p95 = sum(offsets) / len(offsets), percentile(offsets, 95)
        runs = measured.vehicle["runs"]
        lines.append(
            f"driven {runs} times along the street; deviation from the path: mean {mean:.2f} m, "
            f"95th percentile {p95:.2f} m"
        )
        drive |= {"deviation_mean": mean, "deviation_p95": p95}
    title = f"{service.title}, {params.environment} ({service.source})"
    qos_table.report("teleoperation", params, title, comparisons, lines, as_json=as_json, out=out, drive=drive)


def _require(*packages: str) -> None:
    optional_deps.require("teleop", *PACKAGES, *packages, extra="teleop")
