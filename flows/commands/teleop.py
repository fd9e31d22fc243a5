"""`scan2sim teleop`: vehicles driven from afar (services/teleoperation)."""

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
from scan2sim.flows.commands.ros_spin import ends
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
from scan2sim.services.teleoperation.vehicle.adapter import TranslateParams, Translating

app = App("Vehicles driven from afar, by several links at once.")
NEEDED = ("OpenSSL", "pylibsrtp", "websockets")
"""Packages that each of these commands needs."""
WINDOW = "Show the driver's page in a window of its own, without a browser's bars."


@app.command("certificates")
def teleop_certificates(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the authority and of all parties.")],
    gateway: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST", help="Name or address that the gateway is reached by; may be given again."),
    ] = None,
    vehicle: Annotated[list[str] | None, typer.Option(metavar="NAME", help="A vehicle; may be given again.")] = None,
    station: Annotated[list[str] | None, typer.Option(metavar="NAME", help="A station; may be given again.")] = None,
    days: Annotated[float, typer.Option(help="That new certificates are valid.")] = 365,
    renew: Annotated[bool, typer.Option("--renew", help="Make those named anew, though they still hold.")] = False,
) -> None:
    """Make certificates of a gateway, vehicles and stations, and the authority that signs them, or renew them."""
    _need()
    from scan2sim.services.teleoperation.gateway.pki import certify

    if not (gateway or vehicle or station):
        raise SettingError("teleop certificates", "nobody is named", "Give --gateway, --vehicle or --station")
    table = Table("party", "folder", "", "valid until (UTC)")
    for one in certify(folder, gateway or [], vehicle or [], station or [], days, renew):
        state = "made" if one.made else "kept"
        table.add_row(escape(one.party), escape(str(one.folder)), state, f"{one.expires:%Y-%m-%d %H:%M}")
    console.print(table)


@app.command("translate")
@options(TranslateParams)
def teleop_translate(
    params: TranslateParams,
    name: Annotated[str, typer.Argument(metavar="TRANSLATOR", help=f"The vehicle's: {', '.join(adapters.names())}.")],
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="PARAM=VALUE", help="One of its settings; may be given again.")
    ] = None,
) -> None:
    """Run a vehicle's translator: a car unit's orders in, the vehicle's own commands out."""
    found = adapters.find(name)
    settings = found.Params.of(name, assigned(set_ or (), "channel=can0"), remedy="docs/teleoperation.md lists them")
    ended = threading.Event()
    with ends(ended):
        translating = Translating(found.connect(settings), params)
        _say(f"{name}: listens on {translating.address[0]}:{translating.address[1]}; Ctrl-C ends it")
        translating.run(ended, lambda news: _say(f"the vehicle {news}"))


@app.command("gateway")
@options(GatewayParams, certificates="CERTIFICATES")
def teleop_gateway(params: GatewayParams) -> None:
    """Be the gateway that vehicles and stations meet at, and serve the fleet's page."""
    _need("fastapi", "uvicorn")
    from scan2sim.services.teleoperation.gateway.web import serve

    serve(params, _say)


@app.command("station")
@options(StationParams, certificates="CERTIFICATES", gateway="GATEWAY")
def teleop_station(
    params: StationParams,
    window: Annotated[bool, typer.Option("--window", help=WINDOW)] = False,
) -> None:
    """Be a station: show what its vehicle's cameras see, and send what its driver asks for."""
    _need("fastapi", "uvicorn")
    from scan2sim.services.teleoperation.station.web import serve

    serve(params, _say, window)


@app.command("vehicle")
@options(VehicleParams, certificates="CERTIFICATES", gateway="GATEWAY")
def teleop_vehicle(params: VehicleParams) -> None:
    """Be a vehicle's car unit: send what its cameras see, and have its translator do what the driver asks for."""
    _need("av")
    from scan2sim.services.teleoperation.vehicle.app import serve

    ended = threading.Event()
    with ends(ended):
        serve(params, ended, _say)


@app.command("demo")
@options(DemoParams, world="WORLD")
def teleop_demo(
    params: DemoParams,
    browse: Annotated[bool, typer.Option("--browse/--no-browse", help="Open the driver's page.")] = True,
    window: Annotated[bool, typer.Option("--window", help=WINDOW)] = False,
) -> None:
    """Drive a simulated car through a finished world: gateway, vehicle and station on this machine."""
    _need("av", "fastapi", "uvicorn")
    from scan2sim.services.teleoperation.sim.demo import demo
    from scan2sim.services.teleoperation.station import app_window

    if window:
        app_window.browser()
    ended = threading.Event()
    with ends(ended), demo(params, _say) as made, ExitStack() as stack:
        if window:
            stack.enter_context(app_window.window(made.page))
        elif browse:
            webbrowser.open(made.page)
        while not ended.wait(1.0):
            if (why := made.ended()) is not None:
                raise StepError("teleop demo", why, "Start it again; `--help` says what can be changed")


@app.command("measure")
@options(MeasureParams)
def teleop_measure(params: MeasureParams) -> None:
    """Drive by a script over a network like the environment's, and hold what is measured against D3.2's table 6."""
    _need("av", "psutil")
    from scan2sim.flows.commands import qos_table
    from scan2sim.services.qos import requirements
    from scan2sim.services.qos.compare import passed, rows
    from scan2sim.services.qos.requirements import MACHINE, NETWORK
    from scan2sim.services.teleoperation.qos.measure import measure, percentile

    service = requirements.read("teleoperation")
    required = service.of(params.environment)
    with progress(f"teleoperation {params.environment}") as report:
        measured = measure(params, required, report)
    found = rows(required, measured)
    console.print(qos_table.table(f"{service.title}, {params.environment} ({service.source})", found))
    times = measured.glass_to_glass
    _say(
        f"{len(times)} pictures were shown, half of them within {percentile(times, 50):.0f} ms of their taking, "
        f"95 % within {percentile(times, 95):.0f} ms; {measured.lost_frames:.2%} were lost"
    )
    _say(f"the longest time without a command was {measured.command_gap:.0f} ms")
    if off := measured.aside:
        mean, most = sum(off) / len(off), percentile(off, 95)
        runs = measured.vehicle["runs"]
        _say(f"driven {runs} times along the street, {mean:.2f} m off the way on average, 95 % within {most:.2f} m")
    for name, metrics in (("service", NETWORK), ("machine", MACHINE)):
        _say(f"{name}: {'passed' if passed(found, metrics) else 'FAILED'}")


def _need(*packages: str) -> None:
    optional_deps.need("teleop", *NEEDED, *packages, extra="teleop")


def _say(text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)
