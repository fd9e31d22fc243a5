"""The page and the API of services in OSM (D3.2, section 2.3): a list, uploads, buttons, and how things stand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Body, FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.http import factory
from scan2sim.services.orchestration.catalogue import Catalogue
from scan2sim.services.orchestration.description import LABEL
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.settings import PageParams

LARGEST = 8 * 2**20
"""Bytes of an upload."""


def application(params: PageParams, catalogue: Catalogue) -> FastAPI:
    """The page, and what it asks for.

    Raises:
        InputError: the token can't be read.
    """
    app = factory.application("Services in OSM", params, alive={}, public=("/",), largest=LARGEST)

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(factory.PAGES / "orchestration.html")

    @app.get("/api/services")
    def services() -> dict[str, Any]:
        """All, and how they stand."""
        return {"osm": params.northbound(), "services": [one.facts() for one in catalogue.services()]}

    @app.put("/api/packages")
    async def upload(request: Request) -> dict[str, str]:
        """Put a package (.tar.gz) beside the others: the body is the file."""
        data = await request.body()
        return {"id": await run_in_threadpool(catalogue.add, data)}

    @app.post("/api/services/{service}/onboard", status_code=202)
    def onboard(service: str) -> dict[str, str]:
        """Bring its packages into OSM."""
        catalogue.onboard(service)
        return {"id": service}

    @app.post("/api/services/{service}/instantiate", status_code=202)
    def instantiate(service: str, name: Annotated[str, Body(embed=True, pattern=LABEL)]) -> dict[str, str]:
        """Start an instance of it, by a name."""
        catalogue.instantiate(service, name)
        return {"id": service}

    @app.post("/api/services/{service}/delete", status_code=202)
    def delete(service: str) -> dict[str, str]:
        """Remove its instances and its packages from OSM; they stay in the folder."""
        catalogue.delete(service)
        return {"id": service}

    return app


def serve(params: PageParams, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C.

    Raises:
        ScanError: it can't listen, or OSM refuses the user.
    """
    if bool(params.vim) == bool(params.cluster):
        raise SettingError("--vim", "or --cluster says where services are instantiated", "Give one of them")

    def site(osm: Osm) -> str:
        return osm.cluster(params.cluster) if params.cluster else osm.vim(params.vim)

    with Osm(params) as osm:
        site(osm)  # refuses a site that isn't there, and a wrong password, before anything is shown
        catalogue = Catalogue(osm, params.packages, site)
        try:
            factory.run(application(params, catalogue), params, listening)
        finally:
            catalogue.close()
