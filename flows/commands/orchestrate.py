"""`scan2sim orchestrate`: services through Open Source MANO's northbound interface (services/orchestration)."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console, progress
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.ros_spin import ends, spin
from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import ScanError, SettingError
from scan2sim.services.orchestration import description, placement
from scan2sim.services.orchestration.settings import (
    ActParams,
    ApplyParams,
    Connection,
    PageParams,
    ResizeParams,
    ScaledParams,
    StartParams,
)
from scan2sim.services.qos.requirements import Environment

if TYPE_CHECKING:
    from scan2sim.services.orchestration.apply import Applied, Change
    from scan2sim.services.orchestration.lifecycle import Patience
    from scan2sim.services.orchestration.osm import Osm

app = App("Services on edge and cloud through Open Source MANO: what is to run, and where.")

Vim = Annotated[str, typer.Option("--vim", help="VIM account that it runs on, by name or id.")]
Cluster = Annotated[str, typer.Option("--cluster", help="Kubernetes cluster that it runs on, by name or id.")]
Instance = Annotated[str, typer.Argument(metavar="INSTANCE", help="Its name in OSM, or its id.")]
Services = Annotated[Path, typer.Argument(metavar="SERVICES", help="TOML file of what is to run (services.toml).")]


@app.callback()
def _orchestration() -> None:
    optional_deps.need("orchestration", "httpx", "yaml", "jsonschema")


@app.command("package")
def orchestrate_package(
    service: Annotated[
        str, typer.Argument(help=f"A description's TOML file, or one of: {', '.join(description.names())}.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the packages.")],
    environment: Annotated[
        Environment, typer.Option(help="Where it will run, which says what it needs.")
    ] = Environment.EDGE,
    machine: Annotated[bool, typer.Option("--machine", help="As a virtual machine, not as a container.")] = False,
    prefix: Annotated[str, typer.Option(help="Of the packages' ids.")] = "scan2sim",
    repository: Annotated[
        str | None, typer.Option(help="Helm repository of OSM that has the chart; default: it comes along.")
    ] = None,
) -> None:
    """Write a service's packages, of its function and its network service, as OSM takes them."""
    from scan2sim.services.orchestration.package import build

    made = build(description.read(service), environment, "machine" if machine else "container", prefix, repository)
    out.mkdir(parents=True, exist_ok=True)
    for one in (made.function, made.service):
        _say(str(one.save(out)))


@app.command("list")
@options(Connection)
def orchestrate_list(params: Connection) -> None:
    """List packages and instances in OSM."""
    from scan2sim.services.orchestration.osm import FUNCTIONS, SERVICES

    with _osm(params) as osm:
        packages = Table("package", "kind", "state", title="Packages", title_justify="left")
        for kind, collection in (("function", FUNCTIONS), ("network service", SERVICES)):
            for one in osm.packages(collection):
                state = str((one.get("_admin") or {}).get("onboardingState", ""))
                packages.add_row(escape(str(one.get("id") or one["_id"])), kind, state.lower())
        instances = Table("instance", "network service", "state", "made by", title="Instances", title_justify="left")
        for one in osm.instances():
            state = str(one.get("nsState", "")).lower().replace("_", " ")
            facts = (one.get("name", ""), one.get("nsd-ref", ""), state, one.get("description") or "")
            instances.add_row(*(escape(str(each)) for each in facts))
    console.print(packages)
    console.print(instances)


@app.command("onboard")
@options(Connection)
def orchestrate_onboard(
    params: Connection,
    files: Annotated[list[Path], typer.Argument(metavar="PACKAGE...", help="Packages (.tar.gz), in any order.")],
) -> None:
    """Bring packages into OSM; those that it has stay."""
    from scan2sim.services.orchestration import operations, package

    packages = [package.read(path) for path in files]
    with _osm(params) as osm:
        for name in operations.onboard(osm, packages):
            _say(f"{name} is in OSM")


@app.command("instantiate")
@options(StartParams)
def orchestrate_instantiate(
    params: StartParams,
    name: Annotated[str, typer.Argument(help="Of the instance.")],
    nsd: Annotated[str, typer.Argument(metavar="NSD", help="Id of its network service's descriptor.")],
    vim: Vim = "",
    cluster: Cluster = "",
    ssh_key: Annotated[
        list[Path] | None, typer.Option(help="Public SSH key of who may log in; may be given again.")
    ] = None,
    value: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Given to its chart or machine.")
    ] = None,
    namespace: Annotated[str, typer.Option(help="Of Kubernetes; default: the project's.")] = "",
) -> None:
    """Have an instance of a network service run."""
    from scan2sim.services.orchestration import operations
    from scan2sim.services.orchestration.deployment import read_key

    if bool(vim) == bool(cluster):
        raise SettingError("--vim", "or --cluster says where it runs", "Give one of them")
    keys, values = tuple(read_key(path) for path in ssh_key or ()), _values(value or [])
    with _acting(params, name) as (osm, patience, say):
        site = osm.cluster(cluster) if cluster else osm.vim(vim)
        operations.instantiate(
            osm, name, nsd, site, replicas=params.replicas, keys=keys, values=values, namespace=namespace,
            patience=patience, say=say,
        )  # fmt: skip
    _say(f"{name} {'runs' if params.wait else 'is being started'}")


@app.command("scale")
@options(ResizeParams, name="INSTANCE")
def orchestrate_scale(params: ResizeParams) -> None:
    """Have so many of an instance's function."""
    from scan2sim.services.orchestration import operations

    with _acting(params, params.name) as (osm, patience, say):
        operations.resize(osm, params.name, params.replicas, patience, say)
    _say(f"{params.name}: {params.replicas}")


@app.command("heal")
@options(ActParams)
def orchestrate_heal(params: ActParams, name: Instance) -> None:
    """Have an instance made whole: machines anew, charts applied again."""
    from scan2sim.services.orchestration import operations

    with _acting(params, name) as (osm, patience, say):
        operations.heal(osm, name, patience, say)
    _say(f"{name} {'is whole' if params.wait else 'is being healed'}")


@app.command("terminate")
@options(ActParams)
def orchestrate_terminate(params: ActParams, name: Instance) -> None:
    """End an instance, and keep its record."""
    from scan2sim.services.orchestration import operations

    with _acting(params, name) as (osm, patience, say):
        operations.terminate(osm, name, patience, say)
    _say(f"{name} is ended")


@app.command("delete")
@options(ApplyParams)
def orchestrate_delete(
    params: ApplyParams,
    what: Annotated[
        list[str],
        typer.Argument(metavar="WHAT...", help="A services.toml, of which all goes; packages' files; or names in OSM."),
    ],
) -> None:
    """Remove what a services.toml made, or a service by its packages, or instances and packages by name or id."""
    from scan2sim.services.orchestration import operations, package
    from scan2sim.services.orchestration.lifecycle import Patience, find

    files = [Path(one) for one in what if one.endswith((".gz", ".tgz", ".toml"))]
    if len(files) not in (0, len(what)):
        raise SettingError("WHAT", "names files and things in OSM together", "Give one or the other")
    if any(path.suffix == ".toml" for path in files):
        for path in files:
            _apply(params, path, nothing=True)
        return
    with _osm(params) as osm, progress("delete") as report:
        patience = Patience(params.timeout)
        if files:
            operations.delete(osm, [package.read(path) for path in files], patience, lambda text: report(0.5, text))
        instances = [name for name in what if not files and find(osm, name)]
        for name in instances:
            operations.delete_instance(osm, name, patience, lambda text: report(0.5, text))
        if rest := [name for name in what if not files and name not in instances]:
            operations.delete_packages(osm, rest)
    for name in what:
        _say(f"{name} is removed")


@app.command("plan")
@options(Connection)
def orchestrate_plan(params: Connection, services: Services) -> None:
    """Say what `apply` would do, and why."""
    from scan2sim.services.orchestration import apply, deployment

    asked = deployment.read(services)
    with _osm(params) as osm:
        changes = apply.plan(apply.target(osm, asked, services.parent))
    console.print(_changes(changes)) if changes else _say("nothing: all is as the file says")


@app.command("apply")
@options(ApplyParams)
def orchestrate_apply(params: ApplyParams, services: Services) -> None:
    """Bring what runs to what the file says: make, change and remove, nothing twice."""
    _apply(params, services)


@app.command("place")
def orchestrate_place(
    service: Annotated[str, typer.Argument(help="Toolbox that is to run.")],
    measured: Annotated[
        list[Path], typer.Argument(metavar="MEASURED...", help="What `scan2sim qos measure --out` wrote, of each site.")
    ],
) -> None:
    """Say which sites meet a toolbox's needs, and why the others don't."""
    table = Table("site", "", "why not", title=f"{service}: where it may run", title_justify="left")
    found = placement.place(service, [placement.read(path) for path in measured])
    for one in found:
        table.add_row(one.environment, "[green]fits" if one.fits else "[red]no", escape("\n".join(one.why)))
    console.print(table)
    nearest = next((one for one in found if one.fits), None)
    _say(f"nearest to the robot: {nearest.environment}" if nearest else "none of them will do")


@app.command("page")
@options(PageParams)
def orchestrate_page(params: PageParams) -> None:
    """Show services as a page in the browser: upload packages, onboard, instantiate, delete."""
    optional_deps.need("the page", "fastapi", "uvicorn", "prometheus_client")
    from scan2sim.services.orchestration.page import serve

    serve(params, _say)


@app.command("pool")
@options(ScaledParams, kafka_bootstrap_servers="--kafka", log_file="--log")
def orchestrate_pool(params: ScaledParams) -> None:
    """Scale an instance as the event bus asks for workers."""
    optional_deps.need("the event bus", "psutil")

    def made() -> Any:
        from scan2sim.services.monitoring.autoscale.actuators.osm import OsmReplicas
        from scan2sim.services.monitoring.autoscale.pool_node import PoolNode

        return PoolNode(params, params.queue or params.instance, OsmReplicas(params, params.instance))

    spin(made)


def _apply(params: ApplyParams, path: Path, *, nothing: bool = False) -> None:
    from scan2sim.services.orchestration import apply, deployment

    asked = deployment.read(path)
    if nothing:
        asked = deployment.Deployment(deployment=asked.deployment)
    stop, pace = threading.Event(), apply.Pace()
    with _osm(params, pace) as osm, progress(asked.deployment) as report, ends(stop):
        applied = apply.apply(osm, apply.target(osm, asked, path.parent), params, report, stop, pace)
    _tell(applied)
    if stop.is_set():
        raise KeyboardInterrupt
    if (error := apply.failure(applied)) is not None:
        raise error


@contextmanager
def _osm(params: Connection, pace: Any = None) -> Iterator[Osm]:
    from scan2sim.services.orchestration.osm import Osm

    with Osm(params, asked=pace) as osm:
        yield osm


@contextmanager
def _acting(params: ActParams, name: str) -> Iterator[tuple[Osm, Patience, Any]]:
    from scan2sim.services.orchestration.lifecycle import Patience

    with _osm(params) as osm, progress(name) as report:
        yield osm, Patience(params.timeout, params.wait), lambda text: report(0.5, text)


def _values(given: list[str]) -> dict[str, str]:
    pairs = [one.partition("=") for one in given]
    if wrong := next((one for one, sign, _ in pairs if not sign or not one), None):
        raise SettingError("--value", f"{wrong!r} is no NAME=VALUE", "Write it as NAME=VALUE")
    return {name: value for name, _, value in pairs}


def _tell(applied: Applied) -> None:
    if not applied.done and not applied.failed:
        _say("nothing was to be done: all is as the file says")
        return
    table = Table("name", "", "")
    for change in applied.done:
        table.add_row(escape(change.name), f"[green]{change.what}", "")
    for name, error in applied.failed.items():
        table.add_row(escape(name), "[red]failed", escape(_said(error, name)))
    console.print(table)


def _said(error: ScanError, name: str) -> str:
    where = "" if error.where == name else f"{error.where}: "
    return f"{where}{error.cause}. {error.remedy}"


def _changes(changes: list[Change]) -> Table:
    table = Table("name", "would be", "because it")
    for one in changes:
        table.add_row(escape(one.name), one.what, one.why)
    return table


def _say(text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)
