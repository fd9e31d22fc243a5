"""Fleet management: a page and an API over the gateway's fleet (D3.2, section 4.3).

Who is there, who drives whom, how good the links are; to join, hand over, take back and release.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Body, FastAPI, Query
from fastapi.responses import FileResponse

from scan2sim.services.http import factory
from scan2sim.services.http.settings import Served
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.identity import Identity, Role
from scan2sim.services.teleoperation.gateway.server import Gateway
from scan2sim.services.teleoperation.settings import GATEWAY, GatewayParams, address

BY = "fleet management"
"""Who is named in the audit trail."""

Station = Annotated[str, Body(embed=True, min_length=1, max_length=60)]


def application(served: Served, fleet: Fleet, gateway: Gateway) -> FastAPI:
    """The page, and what it asks for.

    Raises:
        InputError: the token can't be read.
    """
    app = factory.application("Fleet", served, alive={"gateway": gateway.alive}, public=("/",))

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "fleet.html")

    @app.get("/api/fleet")
    def facts() -> dict[str, Any]:
        """All vehicles and stations, and how they are."""
        return fleet.facts()

    @app.get("/api/audit")
    def audit(count: Annotated[int, Query(ge=1, le=500)] = 50) -> list[dict[str, Any]]:
        """What was done last, newest first."""
        return list(fleet.audit.newest)[::-1][:count]

    @app.post("/api/vehicles/{vehicle}/join")
    def join(vehicle: str, station: Station) -> dict[str, int]:
        """Have a station drive it."""
        return {"pair": fleet.join(vehicle, station, BY).number}

    @app.post("/api/vehicles/{vehicle}/hand-over")
    def hand_over(vehicle: str, station: Station) -> dict[str, int]:
        """Have another station drive it."""
        return {"pair": fleet.hand_over(vehicle, station, BY).number}

    @app.post("/api/vehicles/{vehicle}/take-back")
    def take_back(vehicle: str) -> dict[str, int]:
        """Give it back to the station that had it before."""
        return {"pair": fleet.take_back(vehicle, BY).number}

    @app.post("/api/vehicles/{vehicle}/release")
    def release(vehicle: str) -> dict[str, str]:
        """Have nobody drive it."""
        fleet.release(vehicle, BY)
        return {"vehicle": vehicle}

    return app


def serve(params: GatewayParams, say: Callable[[str], None]) -> None:
    """Be the gateway, and serve its page, until Ctrl-C; `say` is told what happens.

    Raises:
        ScanError: its certificate or state can't be read, or it can't listen.
    """
    identity = Identity.read(params.certificates, Role.GATEWAY)
    fleet = Fleet(params.state)
    where = address("--listening", params.listening, GATEWAY)
    gateway = Gateway(identity, where.host, where.port, fleet, say)
    say(f"vehicles and stations connect to {where.host}:{gateway.port}")
    try:
        factory.run(application(params, fleet, gateway), params, lambda url: say(f"the fleet's page is {url}"))
    finally:
        gateway.close()
