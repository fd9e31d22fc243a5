"""Fleet management: page and API of the gateway's fleet (D3.2, section 4.3).

Lists vehicles, stations, pairs and link quality; joins, hands over, takes back and releases vehicles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import Body, FastAPI, Query
from fastapi.responses import FileResponse

from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.server import Gateway
from scan2sim.services.teleoperation.identity import Identity, Role
from scan2sim.services.teleoperation.settings import GATEWAY_PORT, GatewayParams, parse_address

AUDIT_AUTHOR = "fleet management"
"""Author of changes from the page, in the audit trail."""

Station = Annotated[str, Body(embed=True, min_length=1, max_length=60)]


def application(served: ServerParams, fleet: Fleet, gateway: Gateway) -> FastAPI:
    """The fleet page and its API.

    Raises:
        InputError: the token can't be read.
    """
    app = factory.application("Fleet", served, alive={"gateway": gateway.alive}, public=("/",))

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "fleet.html")

    @app.get("/api/fleet")
    def fleet_state() -> dict[str, Any]:
        """All vehicles and stations, with their status."""
        return fleet.snapshot()

    @app.get("/api/speeds")
    def speeds() -> dict[str, dict[str, float | None]]:
        """Speed of each vehicle that reports one, m/s, and how long ago it reported, milliseconds."""
        return fleet.speeds()

    @app.get("/api/audit/verification")
    def audit_verification() -> dict[str, Any]:
        """Number of entries of the audit trail, hash of the newest, and what is wrong with the chain."""
        return asdict(fleet.audit.verification)

    @app.get("/api/audit")
    def audit(count: Annotated[int, Query(ge=1, le=500)] = 50) -> list[dict[str, Any]]:
        """The latest entries of the audit trail, newest first."""
        return list(fleet.audit.newest)[::-1][:count]

    @app.post("/api/vehicles/{vehicle}/join")
    def join(vehicle: str, station: Station) -> dict[str, int]:
        """Let a station drive the vehicle."""
        return {"pair": fleet.join(vehicle, station, AUDIT_AUTHOR).number}

    @app.post("/api/vehicles/{vehicle}/hand-over")
    def hand_over(vehicle: str, station: Station) -> dict[str, int]:
        """Let another station drive the vehicle."""
        return {"pair": fleet.hand_over(vehicle, station, AUDIT_AUTHOR).number}

    @app.post("/api/vehicles/{vehicle}/take-back")
    def take_back(vehicle: str) -> dict[str, int]:
        """Give the vehicle back to the station that drove it before the handover."""
        return {"pair": fleet.take_back(vehicle, AUDIT_AUTHOR).number}

    @app.post("/api/vehicles/{vehicle}/release")
    def release(vehicle: str) -> dict[str, str]:
        """End the vehicle's pair; the vehicle stops."""
        fleet.release(vehicle, AUDIT_AUTHOR)
        return {"vehicle": vehicle}

    return app


def serve(params: GatewayParams, notify: Callable[[str], None]) -> None:
    """Run the gateway and its page until Ctrl-C; `notify` is called with progress messages.

    Raises:
        ScanError: the certificate or stored state can't be read, or the gateway can't listen.
    """
    identity = Identity.read(params.certificates, Role.GATEWAY)
    fleet = Fleet(params.state)
    trail = fleet.audit.verification
    notify(f"the audit trail has {trail.entries} entries, SHA-256 of the newest: {trail.head}")
    if trail.damage:
        notify(f"THE AUDIT TRAIL WAS CHANGED: {trail.damage}")
    address = parse_address("--listening", params.listening, GATEWAY_PORT)
    gateway = Gateway(identity, address.host, address.port, fleet, notify)
    notify(f"the gateway accepts vehicles and stations on {address.host}:{gateway.port}")
    try:
        factory.run(application(params, fleet, gateway), params, lambda url: notify(f"the fleet page is {url}"))
    finally:
        gateway.close()
