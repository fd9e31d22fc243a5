"""Fleet management: page and API of the gateway's fleet (D3.2, section 4.3).

Lists vehicles, stations, pairs and link quality; joins, hands over, takes back and releases vehicles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import Body, FastAPI, Query, Request
from fastapi.responses import FileResponse

from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.access.drivers import Access, AccessError, Driver, DriverRole
from scan2sim.services.teleoperation.access.sign_in import access, protected
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.server import Gateway
from scan2sim.services.teleoperation.identity import Identity, Role
from scan2sim.services.teleoperation.settings import GATEWAY_PORT, GatewayParams, parse_address

AUDIT_AUTHOR = "fleet management"
"""Author of changes from the page, in the audit trail; a named operator precedes it."""

Station = Annotated[str, Body(embed=True, min_length=1, max_length=60)]


def application(served: ServerParams, fleet: Fleet, gateway: Gateway, drivers: Access | None = None) -> FastAPI:
    """The fleet page and its API.

    Args:
        served: server settings.
        fleet: shown and changed.
        gateway: checked by the liveness probe.
        drivers: named drivers, who each have a token: all watch, operators change; None: anybody with the server's
            token does both.

    Raises:
        InputError: the token can't be read.
    """
    app = protected("Fleet", served, {"gateway": gateway.alive}, drivers)

    def viewer(request: Request) -> Driver | None:
        return None if drivers is None else drivers.identify(factory.sent_token(request.scope) or "")

    def author(request: Request) -> str:
        """Who requests a change, for the audit trail; raises an AccessError if that isn't an operator."""
        if drivers is None:
            return AUDIT_AUTHOR
        if (operator := viewer(request)) is None:  # revoked since the request was accepted
            raise AccessError("the token", "isn't valid any more", "Ask for a new one")
        operator.require(DriverRole.OPERATOR)
        return f"{operator.name} at {AUDIT_AUTHOR}"

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "fleet.html")

    @app.get("/api/fleet")
    def fleet_state(request: Request) -> dict[str, Any]:
        """All vehicles and stations, with their status, and the name and role of the page's user, if they have one."""
        user = viewer(request)
        you = None if user is None else {"name": user.name, "role": user.role}
        return fleet.snapshot() | {"you": you}

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
    def join(vehicle: str, station: Station, request: Request) -> dict[str, int]:
        """Let a station drive the vehicle."""
        return {"pair": fleet.join(vehicle, station, author(request)).number}

    @app.post("/api/vehicles/{vehicle}/hand-over")
    def hand_over(vehicle: str, station: Station, request: Request) -> dict[str, int]:
        """Let another station drive the vehicle."""
        return {"pair": fleet.hand_over(vehicle, station, author(request)).number}

    @app.post("/api/vehicles/{vehicle}/take-back")
    def take_back(vehicle: str, request: Request) -> dict[str, int]:
        """Give the vehicle back to the station that drove it before the handover."""
        return {"pair": fleet.take_back(vehicle, author(request)).number}

    @app.post("/api/vehicles/{vehicle}/release")
    def release(vehicle: str, request: Request) -> dict[str, str]:
        """End the vehicle's pair; the vehicle stops."""
        fleet.release(vehicle, author(request))
        return {"vehicle": vehicle}

    return app


def serve(params: GatewayParams, notify: Callable[[str], None]) -> None:
    """Run the gateway and its page until Ctrl-C; `notify` is called with progress messages.

    Raises:
        ScanError: the certificate or stored state can't be read, or the gateway can't listen.
    """
    drivers = access(params)
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
        app = application(params, fleet, gateway, drivers)
        factory.run(app, params, lambda url: notify(f"the fleet page is {url}"))
    finally:
        gateway.close()
