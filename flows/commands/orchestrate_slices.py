"""`scan2sim orchestrate slice`: network slices and their templates in OSM."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from scan2sim.flows.commands.app import App, Json
from scan2sim.flows.commands.display import console, messages_on_stderr, print_json, print_line
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.orchestrate_osm import operation, osm_client
from scan2sim.flows.commands.orchestrate_sites import REQUIREMENT
from scan2sim.services.orchestration.settings import Connection, OperationParams

if TYPE_CHECKING:
    from scan2sim.services.orchestration.records import TemplateRecord

NameOrId = Annotated[str, typer.Argument(metavar="NAME", help="Name or id in OSM.")]

app = App("Network slices: services that are instantiated together, from a template.", requirement=REQUIREMENT)


@app.command("templates")
@options(Connection)
def templates(params: Connection, as_json: Json = False) -> None:
    """List network slice templates (NST) and their network services."""
    with messages_on_stderr(as_json), osm_client(params) as osm:
        found = osm.templates()
    if as_json:
        print_json([{"name": one.name, "id": one.id, "network services": _services(one)} for one in found])
        return
    table = Table("name", "id", "network services")
    for one in found:
        table.add_row(*map(escape, (one.name, one.id, ", ".join(_services(one)))))
    console.print(table)


def _services(template: TemplateRecord) -> list[str]:
    return [subnet.service for subnet in template.subnets]


@app.command("add-template")
@options(Connection)
def add_template(
    params: Connection,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Template: a YAML file, or a .tar.gz package.")],
) -> None:
    """Onboard a network slice template (NST); its network services must be in OSM."""
    from scan2sim.services.orchestration import slices

    with osm_client(params) as osm:
        name = slices.add_template(osm, file)
    print_line(f"{name} is in OSM")


@app.command("remove-template")
@options(Connection)
def remove_template(params: Connection, name: NameOrId) -> None:
    """Remove a template from OSM, which refuses it while a slice uses it."""
    from scan2sim.services.orchestration import slices

    with osm_client(params) as osm:
        slices.remove_template(osm, name)
    print_line(f"{name} is removed")


@app.command("list")
@options(Connection)
def list_(params: Connection, as_json: Json = False) -> None:
    """List network slices (NSI) with their templates and states."""
    with messages_on_stderr(as_json), osm_client(params) as osm:
        found = osm.slices()
    if as_json:
        print_json([{"name": o.name, "template": o.template, "state": o.state, "detail": o.detail} for o in found])
        return
    table = Table("name", "template", "state")
    for one in found:
        reason = f": {one.detail[:200]}" if one.status == "failed" and one.detail else ""
        table.add_row(*map(escape, (one.name, one.template, one.state + reason)))
    console.print(table)


@app.command("create")
@options(OperationParams)
def create(
    params: OperationParams,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the new slice.")],
    template: Annotated[str, typer.Argument(metavar="TEMPLATE", help="Name or id of its template in OSM.")],
    vim: Annotated[str | None, typer.Option(help="Name or id of the VIM account for its services.")] = None,
    cluster: Annotated[str | None, typer.Option(help="Kubernetes cluster whose VIM account is used instead.")] = None,
) -> None:
    """Create a network slice from a template and instantiate its services."""
    from scan2sim.pipeline.core.errors import SettingError
    from scan2sim.services.orchestration import slices

    with operation(params, name) as (osm, wait_policy, notify):
        if cluster and not vim:
            site = osm.cluster(cluster)
        elif vim and not cluster:
            site = osm.vim(vim)
        else:
            raise SettingError("--vim", "give either --vim or --cluster", "It sets where services are instantiated")
        new = slices.create(osm, name, template, site, wait_policy, notify)
    state = ("is running" if params.wait else "is being instantiated") if new else "is already in OSM, and unchanged"
    print_line(f"{name} {state}")


@app.command("remove")
@options(OperationParams)
def remove(params: OperationParams, name: NameOrId) -> None:
    """Terminate a network slice with its services, and remove it; waits until it is gone."""
    from scan2sim.services.orchestration import slices

    with operation(params, name) as (osm, wait_policy, notify):
        slices.remove(osm, name, wait_policy, notify)
    print_line(f"{name} is removed")
