"""`scan2sim teleop`: teleoperation of vehicles (services/teleoperation)."""

from __future__ import annotations

import threading
import webbrowser
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console, progress
from scan2sim.flows.commands.options import assigned, options
from scan2sim.flows.commands.ros_spin import stop_on_signal
from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import SettingError, StepError
from scan2sim.services.teleoperation.settings import (
    DemoParams,
    GatewayParams,
    MeasureParams,
    StationParams,
    VehicleParams,
)
from scan2sim.services.teleoperation.vehicle import adapters
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer

app = App("Drive vehicles remotely, over several network links at once.")
PACKAGES = ("OpenSSL", "pylibsrtp", "websockets")
"""Packages that all of these commands need, except `translate`."""
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


@app.command("translate")
@options(AdapterParams)
def teleop_translate(
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
            help="Setting of the adapter, such as channel=can0; repeatable (docs/teleoperation.md).",
        ),
    ] = None,
) -> None:
    """Run a vehicle adapter: converts the commands of `teleop vehicle` to those of the vehicle (CAN, ROS 2, ...)."""
    adapter = adapters.find(name)
    settings = adapter.Params.of(name, assigned(set_ or (), "channel=can0"), remedy="docs/teleoperation.md lists them")
    stop = threading.Event()
    with stop_on_signal(stop):
        server = AdapterServer(adapter.connect(settings), params)
        _say(f"{name}: listens on {server.address[0]}:{server.address[1]}; Ctrl-C stops it")
        server.run(stop, lambda news: _say(f"the vehicle {news}"))


@app.command("gateway")
@options(GatewayParams, certificates="CERTIFICATES")
def teleop_gateway(params: GatewayParams) -> None:
    """Run the gateway that connects vehicles and stations, and serve the fleet page."""
    _require("fastapi", "uvicorn")
    from scan2sim.services.teleoperation.gateway.web import serve

    serve(params, _say)


@app.command("station")
@options(StationParams, certificates="CERTIFICATES", gateway="GATEWAY")
def teleop_station(
    params: StationParams,
    window: Annotated[bool, typer.Option("--window", help=WINDOW_HELP)] = False,
) -> None:
    """Run a driver station: serve the driver page with the vehicle's video, and send the driver's commands."""
    _require("fastapi", "uvicorn")
    from scan2sim.services.teleoperation.station.web import serve

    serve(params, _say, window)


@app.command("vehicle")
@options(VehicleParams, certificates="CERTIFICATES", gateway="GATEWAY")
def teleop_vehicle(params: VehicleParams) -> None:
    """Run the onboard unit of a vehicle: send its video, and pass the driver's commands to the vehicle adapter."""
    _require("av")
    from scan2sim.services.teleoperation.vehicle.app import serve

    stop = threading.Event()
    with stop_on_signal(stop):
        serve(params, stop, _say)


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
    with stop_on_signal(stop), demo(params, _say) as running, ExitStack() as stack:
        if window:
            stack.enter_context(app_window.window(running.page))
        elif browse:
            webbrowser.open(running.page)
        while not stop.wait(1.0):
            if (why := running.ended()) is not None:
                raise StepError("teleop demo", why, "Start it again; `--help` lists what can be changed")


@app.command("measure")
@options(MeasureParams)
def teleop_measure(params: MeasureParams) -> None:
    """Measure latency, loss and driving of a scripted drive over an emulated network, against 5G-ERA D3.2, table 6."""
    _require("av", "psutil")
    from scan2sim.flows.commands import qos_table
    from scan2sim.services.qos import requirements
    from scan2sim.services.qos.compare import compare_metrics, passed
    from scan2sim.services.qos.requirements import MACHINE_METRICS, NETWORK_METRICS
    from scan2sim.services.teleoperation.qos.measure import measure, percentile

    service = requirements.read("teleoperation")
    required = service.of(params.environment)
    with progress(f"teleoperation {params.environment}") as report:
        measured = measure(params, required, report)
    comparisons = compare_metrics(required, measured)
    console.print(qos_table.table(f"{service.title}, {params.environment} ({service.source})", comparisons))
    times = measured.glass_to_glass
    _say(
        f"{len(times)} frames were shown; glass-to-glass latency: median {percentile(times, 50):.0f} ms, "
        f"95th percentile {percentile(times, 95):.0f} ms; {measured.lost_frames:.2%} of the frames were lost"
    )
    _say(f"longest gap between commands: {measured.command_gap:.0f} ms")
    if offsets := measured.cross_track_error:
        mean, p95 = sum(offsets) / len(offsets), percentile(offsets, 95)
        runs = measured.vehicle["runs"]
        _say(
            f"driven {runs} times along the street; deviation from the path: mean {mean:.2f} m, "
            f"95th percentile {p95:.2f} m"
        )
    for name, metrics in (("service", NETWORK_METRICS), ("machine", MACHINE_METRICS)):
        _say(f"{name}: {'passed' if passed(comparisons, metrics) else 'FAILED'}")


def _require(*packages: str) -> None:
    optional_deps.require("teleop", *PACKAGES, *packages, extra="teleop")


def _say(text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)
