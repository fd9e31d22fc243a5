"""`scan2sim orchestrate`: deployment of services through the northbound API of Open Source MANO (OSM)."""

from __future__ import annotations

import threading
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from scan2sim.flows.commands.app import App, Json
from scan2sim.flows.commands.display import console, messages_on_stderr, print_json, print_line, warn
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.orchestrate_osm import operation, osm_client, print_result, progress_lines
from scan2sim.flows.commands.orchestrate_sites import cluster as cluster_commands
from scan2sim.flows.commands.orchestrate_sites import repo as repo_commands
from scan2sim.flows.commands.orchestrate_sites import vim as vim_commands
from scan2sim.flows.commands.orchestrate_slices import app as slice_commands
from scan2sim.flows.commands.ros_spin import spin, stop_on_signal
from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import ScanError, SettingError
from scan2sim.services.monitoring.settings.osm import AutoscaleParams
from scan2sim.services.orchestration import description, placement
from scan2sim.services.orchestration.settings import (
    ApplyParams,
    Connection,
    InstantiateParams,
    OperationParams,
    PageParams,
    ScaleInstanceParams,
)
from scan2sim.services.qos.requirements import Environment

if TYPE_CHECKING:
    from scan2sim.services.orchestration.apply import ApplyResult, Change

app = App(
    "Deploy services on edge and cloud through Open Source MANO (OSM).",
    requirement=("orchestration", "httpx", "jsonschema"),
)

Vim = Annotated[str, typer.Option("--vim", help="Name or id of the VIM account to run it on; give this or --cluster.")]
Cluster = Annotated[
    str, typer.Option("--cluster", help="Name or id of the Kubernetes cluster to run it on; give this or --vim.")
]
Instance = Annotated[str, typer.Argument(metavar="INSTANCE", help="Name or id of the network service instance in OSM.")]
Services = Annotated[
    Path,
    typer.Argument(
        metavar="SERVICES", help="TOML file that lists the services to run (services.toml; docs/orchestration.md)."
    ),
]


@app.command("package")
def orchestrate_package(
    service: Annotated[
        str,
        typer.Argument(
            metavar="SERVICE", help=f"TOML file of a service description, or one of: {', '.join(description.names())}."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the packages.")],
    environment: Annotated[
        Environment, typer.Option(help="Where the service will run; selects its resource requirements.")
    ] = Environment.EDGE,
    machine: Annotated[
        bool,
        typer.Option(
            "--machine", help="Package the service as a virtual machine; default: as a container (Helm chart)."
        ),
    ] = False,
    prefix: Annotated[str, typer.Option(help="Prefix of the packages' ids.")] = "scan2sim",
    repository: Annotated[
        str | None,
        typer.Option(
            help="Helm repository in OSM that contains the chart; default: the chart is included in the package."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write the OSM packages of a service: its network function (VNF/KNF) and its network service (NS)."""
    from scan2sim.services.orchestration.package import build

    packages = build(description.read(service), environment, "machine" if machine else "container", prefix, repository)
    out.mkdir(parents=True, exist_ok=True)
    function, service_file = packages.function.save(out), packages.service.save(out)
    print_result(as_json, f"{function}\n{service_file}", function=str(function), service=str(service_file))


@app.command("list")
@options(Connection)
def orchestrate_list(params: Connection, as_json: Json = False) -> None:
    """List the packages and instances in OSM."""
    from scan2sim.services.orchestration.osm import FUNCTIONS, SERVICES

    kinds = (("function", FUNCTIONS), ("network service", SERVICES))
    with messages_on_stderr(as_json), osm_client(params) as osm:
        packages = [
            {"name": one.name, "kind": kind, "state": one.admin.onboarding_state.lower()}
            for kind, collection in kinds
            for one in osm.packages(collection)
        ]
        instances = [
            {
                "name": one.name,
                "network service": one.descriptor,
                "state": one.state.lower().replace("_", " "),
                "description": one.description,
            }
            for one in osm.instances()
        ]
    if as_json:
        print_json({"packages": packages, "instances": instances})
        return
    for title, names, found in (
        ("Packages", ("name", "kind", "state"), packages),
        ("Instances", ("name", "network service", "state", "description"), instances),
    ):
        table = Table(*names, title=title, title_justify="left")
        for facts in found:
            table.add_row(*(escape(facts[name]) for name in names))
        console.print(table)


@app.command("onboard")
@options(Connection)
def orchestrate_onboard(
    params: Connection,
    files: Annotated[list[Path], typer.Argument(metavar="PACKAGE...", help="Package files (.tar.gz), in any order.")],
    as_json: Json = False,
) -> None:
    """Upload packages to OSM; those that it has already stay unchanged, and a bad one doesn't stop the others."""
    from scan2sim.services.orchestration import operations, package

    packages, errors, onboarded = [], list[ScanError](), list[str]()
    for path in files:
        try:
            packages.append(package.read(path))
        except ScanError as error:
            errors.append(error)
    with messages_on_stderr(as_json), osm_client(params) as osm:
        for outcome in operations.onboard_each(osm, packages):
            if isinstance(outcome, ScanError):
                errors.append(outcome)
            else:
                onboarded.append(outcome.partition(" ")[2])
                print_line(f"{outcome} is onboarded")
        for one in errors[:-1]:
            warn(str(one))
    if as_json:
        print_json({"onboarded": onboarded, "failed": [str(one) for one in errors]})
    if errors:
        raise errors[-1]


@app.command("instantiate")
@options(InstantiateParams)
def orchestrate_instantiate(
    params: InstantiateParams,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the new instance.")],
    nsd: Annotated[
        str, typer.Argument(metavar="NSD", help="Id of the network service descriptor (NSD) to instantiate.")
    ],
    vim: Vim = "",
    cluster: Cluster = "",
    ssh_key: Annotated[
        list[Path] | None,
        typer.Option(help="File of a public SSH key that may log in to its virtual machine; repeatable."),
    ] = None,
    value: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Value passed to its Helm chart or virtual machine; repeatable."),
    ] = None,
    namespace: Annotated[
        str, typer.Option(help="Kubernetes namespace to run it in; default: that of the OSM project.")
    ] = "",
    as_json: Json = False,
) -> None:
    """Create and start an instance of a network service."""
    from scan2sim.services.orchestration import operations
    from scan2sim.services.orchestration.deployment import read_key

    if bool(vim) == bool(cluster):
        raise SettingError("--vim", "exactly one of --vim and --cluster is needed", "Give one of them")
    keys, values = tuple(read_key(path) for path in ssh_key or ()), _values(value or [])
    with operation(params, name, as_json) as (osm, wait_policy, notify):
        site = osm.cluster(cluster) if cluster else osm.vim(vim)
        operations.instantiate(
            osm, name, nsd, site, replicas=params.replicas, keys=keys, values=values, namespace=namespace,
            wait_policy=wait_policy, notify=notify,
        )  # fmt: skip
    text = f"{name} {'runs' if params.wait else 'is being started'}"
    print_result(as_json, text, instance=name, operation="instantiate", finished=params.wait)


@app.command("scale")
@options(ScaleInstanceParams, name="INSTANCE")
def orchestrate_scale(params: ScaleInstanceParams, as_json: Json = False) -> None:
    """Set the number of replicas of an instance's function."""
    from scan2sim.services.orchestration import operations

    with operation(params, params.name, as_json) as (osm, wait_policy, notify):
        operations.scale(osm, params.name, params.replicas, wait_policy, notify)
    facts = {"instance": params.name, "operation": "scale", "finished": params.wait, "replicas": params.replicas}
    print_result(as_json, f"{params.name}: {params.replicas} replicas", **facts)


@app.command("heal")
@options(OperationParams)
def orchestrate_heal(params: OperationParams, name: Instance, as_json: Json = False) -> None:
    """Heal an instance: recreate its virtual machines, apply its charts again."""
    from scan2sim.services.orchestration import operations

    with operation(params, name, as_json) as (osm, wait_policy, notify):
        operations.heal(osm, name, wait_policy, notify)
    text = f"{name} {'is healed' if params.wait else 'is being healed'}"
    print_result(as_json, text, instance=name, operation="heal", finished=params.wait)


@app.command("terminate")
@options(OperationParams)
def orchestrate_terminate(params: OperationParams, name: Instance, as_json: Json = False) -> None:
    """Stop an instance; its record stays in OSM."""
    from scan2sim.services.orchestration import operations

    with operation(params, name, as_json) as (osm, wait_policy, notify):
        operations.terminate(osm, name, wait_policy, notify)
    print_result(as_json, f"{name} is terminated", instance=name, operation="terminate", finished=True)


@app.command("delete")
@options(ApplyParams)
def orchestrate_delete(
    params: ApplyParams,
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="WHAT...",
            help="A services.toml, to delete all that it lists; package files; or names or ids in OSM.",
        ),
    ],
    as_json: Json = False,
) -> None:
    """Delete all services of a services.toml, or a service by its package files, or instances and packages by name."""
    from scan2sim.services.orchestration import operations, package
    from scan2sim.services.orchestration.lifecycle import WaitPolicy, find

    files = [Path(one) for one in what if one.endswith((".gz", ".tgz", ".toml"))]
    if len(files) not in (0, len(what)):
        raise SettingError("WHAT", "mixes files with names in OSM", "Give only files, or only names")
    if deployments := [path for path in files if path.suffix == ".toml"]:
        if len(deployments) != len(files) or (as_json and len(files) > 1):
            cause = "mixes a services.toml with packages" if len(deployments) != len(files) else "has several results"
            raise SettingError("WHAT", cause, "Give one services.toml")
        with messages_on_stderr(as_json):
            for path in deployments:
                _apply(params, path, delete=True, as_json=as_json)
        return
    with messages_on_stderr(as_json), osm_client(params) as osm, progress_lines("delete") as report:
        wait_policy = WaitPolicy(params.timeout)
        if files:
            operations.delete(osm, [package.read(path) for path in files], wait_policy, lambda text: report(0.5, text))
        instances = [name for name in what if not files and find(osm, name)]
        for name in instances:
            operations.delete_instance(osm, name, wait_policy, lambda text: report(0.5, text))
        if rest := [name for name in what if not files and name not in instances]:
            operations.delete_packages(osm, rest)
    print_result(as_json, "\n".join(f"{name} is deleted" for name in what), deleted=what)


@app.command("plan")
@options(Connection)
def orchestrate_plan(params: Connection, services: Services, as_json: Json = False) -> None:
    """List what `apply` would do, and why."""
    from scan2sim.services.orchestration import apply, deployment

    requested = deployment.read(services)
    with messages_on_stderr(as_json), osm_client(params) as osm:
        changes = apply.plan(apply.load_state(osm, requested, services.parent))
    if as_json:
        print_json([asdict(one) for one in changes])
        return
    console.print(_changes(changes)) if changes else print_line("nothing to do: all services are as described")


@app.command("apply")
@options(ApplyParams)
def orchestrate_apply(params: ApplyParams, services: Services, as_json: Json = False) -> None:
    """Create, change and delete services until those in OSM are as described in the file (idempotent)."""
    with messages_on_stderr(as_json):
        _apply(params, services, as_json=as_json)


@app.command("place")
def orchestrate_place(
    service: Annotated[
        str, typer.Argument(metavar="SERVICE", help="Toolbox to place: detect, movement, classify or segment.")
    ],
    measured: Annotated[
        list[Path],
        typer.Argument(metavar="MEASURED...", help="JSON files of `scan2sim qos measure --out`, one per site."),
    ],
    as_json: Json = False,
) -> None:
    """List the sites that meet the requirements of a toolbox, by measurements, and why others don't."""
    placements = placement.place(service, [placement.read(path) for path in measured])
    if as_json:
        print_json([asdict(one) for one in placements])
        return
    table = Table("site", "", "why not", title=f"Placement of {service}", title_justify="left")
    for one in placements:
        unknown = [f"not measured or decided: {', '.join(one.unknown)}"] if one.unknown else []
        why = escape("\n".join([*one.unmet, *unknown]))
        table.add_row(one.environment, "[green]fits" if one.fits else "[red]no", why)
    console.print(table)
    nearest = next((one for one in placements if one.fits), None)
    print_line(f"nearest to the robot: {nearest.environment}" if nearest else "no site meets the requirements")


@app.command("page")
@options(PageParams)
def orchestrate_page(params: PageParams) -> None:
    """Serve a web page for packages and instances: upload, onboard, instantiate, delete."""
    optional_deps.require("the page", "fastapi", "uvicorn", "prometheus_client")
    from scan2sim.services.orchestration.page import serve

    serve(params, print_line)


@app.command("pool")
@options(AutoscaleParams, kafka_bootstrap_servers="--kafka", log_file="--log")
def orchestrate_pool(params: AutoscaleParams) -> None:
    """Scale an instance as the autoscaler (`monitor scale`) requests workers."""
    optional_deps.require("the event bus", "psutil")

    def create() -> Any:
        from scan2sim.services.monitoring.autoscale.actuators.osm import OsmReplicas
        from scan2sim.services.monitoring.autoscale.pool_node import PoolNode

        return PoolNode(params, params.queue or params.instance, OsmReplicas(params, params.instance))

    spin(create)


def _apply(params: ApplyParams, path: Path, *, delete: bool = False, as_json: bool = False) -> None:
    from scan2sim.services.orchestration import apply, deployment

    requested = deployment.read(path)
    if delete:
        requested = deployment.Deployment(deployment=requested.deployment)
    stop, pacer = threading.Event(), apply.RequestPacer()
    with osm_client(params, pacer) as osm, progress_lines(requested.deployment) as report, stop_on_signal(stop):
        result = apply.apply(osm, apply.load_state(osm, requested, path.parent), params, report, stop, pacer)
    _print_result(result, as_json)
    if stop.is_set():
        raise KeyboardInterrupt
    if (error := apply.failure(result)) is not None:
        raise error


def _values(given: list[str]) -> dict[str, str]:
    pairs = [one.partition("=") for one in given]
    if wrong := next((one for one, sign, _ in pairs if not sign or not one), None):
        raise SettingError("--value", f"{wrong!r} has not the form NAME=VALUE", "Write for example --value size=large")
    return {name: value for name, _, value in pairs}


def _print_result(result: ApplyResult, as_json: bool) -> None:
    if as_json:
        failed = {name: _error_text(error, name) for name, error in result.failed.items()}
        print_json({"done": [asdict(one) for one in result.done], "failed": failed})
        return
    if not result.done and not result.failed:
        print_line("nothing to do: all services are as described")
        return
    table = Table("name", "", "")
    for change in result.done:
        table.add_row(escape(change.name), f"[green]{change.action}", "")
    for name, error in result.failed.items():
        table.add_row(escape(name), "[red]failed", escape(_error_text(error, name)))
    console.print(table)


def _error_text(error: ScanError, name: str) -> str:
    where = "" if error.where == name else f"{error.where}: "
    return f"{where}{error.cause}. {error.remedy}"


def _changes(changes: list[Change]) -> Table:
    table = Table("name", "action", "reason")
    for one in changes:
        table.add_row(escape(one.name), one.action, one.reason)
    return table


for _name, _group in (
    ("vim", vim_commands),
    ("cluster", cluster_commands),
    ("repo", repo_commands),
    ("slice", slice_commands),
):
    app.add_typer(_group, name=_name)
