"""Web page and API for services in OSM (D3.2, section 2.3): service list, uploads, actions and their states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Body, FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.http import factory
from scan2sim.services.orchestration.catalogue import Catalogue
from scan2sim.services.orchestration.description import LABEL_PATTERN
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.settings import PageParams

MAX_UPLOAD_BYTES = 8 * 2**20


def application(params: PageParams, catalogue: Catalogue) -> FastAPI:
    """The page and the API that it calls.

    Raises:
        InputError: the token file can't be read.
    """
    app = factory.application("Services in OSM", params, alive={}, public=("/",), max_body_bytes=MAX_UPLOAD_BYTES)

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "orchestration.html")

    @app.get("/api/services")
    def services() -> dict[str, Any]:
        """List all services with their states."""
        return {"osm": params.northbound_url(), "services": [one.as_json() for one in catalogue.services()]}

    @app.put("/api/packages")
    async def upload(request: Request) -> dict[str, str]:
        """Upload a package to the folder; the request body is the .tar.gz file."""
        data = await request.body()
        return {"id": await run_in_threadpool(catalogue.add, data)}

    @app.post("/api/services/{service}/onboard", status_code=202)
    def onboard(service: str) -> dict[str, str]:
        """Onboard the service's packages into OSM."""
        catalogue.onboard(service)
        return {"id": service}

    @app.post("/api/services/{service}/instantiate", status_code=202)
    def instantiate(service: str, name: Annotated[str, Body(embed=True, pattern=LABEL_PATTERN)]) -> dict[str, str]:
        """Start an instance of the service under the given name."""
        catalogue.instantiate(service, name)
        return {"id": service}

    @app.post("/api/services/{service}/delete", status_code=202)
    def delete(service: str) -> dict[str, str]:
        """Remove the service's instances and packages from OSM; the packages stay in the folder."""
        catalogue.delete(service)
        return {"id": service}

    return app


def serve(params: PageParams, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C.

    Raises:
        ScanError: the port can't be opened, or OSM rejected the login.
    """
    if bool(params.vim) == bool(params.cluster):
        raise SettingError("--vim", "give either --vim or --cluster", "It sets where services are instantiated")

    def site(osm: Osm) -> str:
        return osm.cluster(params.cluster) if params.cluster else osm.vim(params.vim)

    with Osm(params) as osm:
        site(osm)  # report an unknown site or a wrong password before the page is served
        catalogue = Catalogue(osm, params.packages, site)
        try:
            factory.run(application(params, catalogue), params, listening)
        finally:
            catalogue.close()
