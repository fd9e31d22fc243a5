"""`scan2sim teleop`: vehicles driven from afar (services/teleoperation)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console
from scan2sim.pipeline import extras
from scan2sim.pipeline.errors import SettingError

app = App("Vehicles driven from afar, by several links at once.")


@app.callback()
def _teleoperation() -> None:
    extras.need("teleop", "OpenSSL", "pylibsrtp", "websockets")


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
    from scan2sim.services.teleoperation.authority import certify

    if not (gateway or vehicle or station):
        raise SettingError("teleop certificates", "nobody is named", "Give --gateway, --vehicle or --station")
    table = Table("party", "folder", "", "valid until (UTC)")
    for one in certify(folder, gateway or [], vehicle or [], station or [], days, renew):
        state = "made" if one.made else "kept"
        table.add_row(escape(one.party), escape(str(one.folder)), state, f"{one.expires:%Y-%m-%d %H:%M}")
    console.print(table)
