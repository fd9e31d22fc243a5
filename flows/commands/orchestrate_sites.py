"""`scan2sim orchestrate vim`, `cluster` and `repo`: sites of OSM are registered, listed and removed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from scan2sim.flows.commands.app import App, Json
from scan2sim.flows.commands.display import console, messages_on_stderr, print_json, print_line
from scan2sim.flows.commands.options import assigned, options
from scan2sim.flows.commands.orchestrate_osm import operation, osm_client
from scan2sim.services.credentials import redacted
from scan2sim.services.orchestration.settings import Connection, OperationParams

if TYPE_CHECKING:
    from scan2sim.services.orchestration.records import SiteRecord

REQUIREMENT = ("orchestration", "httpx", "jsonschema")
Name = Annotated[str, typer.Argument(metavar="NAME", help="Name in OSM.")]

vim = App("VIM accounts: clouds on which OSM starts virtual machines.", requirement=REQUIREMENT)
cluster = App("Kubernetes clusters on which OSM installs Helm charts.", requirement=REQUIREMENT)
repo = App("Repositories of Helm charts.", requirement=REQUIREMENT)


@vim.command("add")
@options(OperationParams)
def vim_add(
    params: OperationParams,
    name: Name,
    url: Annotated[str, typer.Argument(metavar="URL", help="Address of the VIM's API (OpenStack: of Keystone).")],
    vim_user: Annotated[str, typer.Option(help="User name at the VIM.")],
    vim_password: Annotated[Path, typer.Option(help="File with the password at the VIM.")],
    tenant: Annotated[str, typer.Option(help="Project (tenant) at the VIM.")] = "admin",
    kind: Annotated[
        str, typer.Option("--type", help="Type of the VIM: openstack, aws, azure, gcp, vmware, dummy, ...")
    ] = "openstack",
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="YAML or JSON file with settings of this type of VIM, such as security_groups, keypair, insecure or "
            "project_domain_name of OpenStack; --set overrides it.",
        ),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="One of these settings; not for credentials; repeatable."),
    ] = None,
) -> None:
    """Register a VIM account; `--type dummy` for a Kubernetes cluster without a VIM."""
    from scan2sim.services.orchestration import sites

    body = sites.vim_request(
        name, url, kind=kind, user=vim_user, password=sites.read_secret(vim_password), tenant=tenant,
        config=sites.vim_config(config, assigned(set_ or (), "insecure=true")),
    )  # fmt: skip
    _add(params, "vim", lambda _: body)


@cluster.command("add")
@options(OperationParams)
def cluster_add(
    params: OperationParams,
    name: Name,
    kubeconfig: Annotated[
        Path,
        typer.Argument(
            metavar="KUBECONFIG",
            help="File with the cluster's address and credentials: kubectl config view --raw --minify > FILE.",
        ),
    ],
    vim: Annotated[str, typer.Option("--vim", help="Name or id of the cluster's VIM account.")],
    kubernetes: Annotated[str, typer.Option(help="Kubernetes version of the cluster.")] = "1.30",
    network: Annotated[str | None, typer.Option(help="VIM network of the cluster's nodes; default: none.")] = None,
) -> None:
    """Register a Kubernetes cluster."""
    from scan2sim.services.orchestration import sites

    def body(osm: Any) -> dict[str, Any]:
        return sites.cluster_request(name, kubeconfig, vim=osm.vim(vim), version=kubernetes, network=network)

    _add(params, "cluster", body)


@repo.command("add")
@options(OperationParams)
def repo_add(
    params: OperationParams,
    name: Name,
    url: Annotated[str, typer.Argument(metavar="URL", help="Address of the repository: https:// or oci://.")],
    repo_user: Annotated[
        str | None, typer.Option(help="User name at a private repository; default: it is public.")
    ] = None,
    repo_password: Annotated[
        Path | None, typer.Option(help="File with the password or token at a private repository.")
    ] = None,
) -> None:
    """Register a repository of Helm charts."""
    from scan2sim.services.orchestration import sites

    password = None if repo_password is None else sites.read_secret(repo_password)
    body = sites.repository_request(name, url, user=repo_user, password=password)
    _add(params, "repo", lambda _: body)


def _add(params: OperationParams, which: str, body: Callable[[Any], dict[str, Any]]) -> None:
    from scan2sim.services.orchestration import sites

    with operation(params, which) as (osm, wait_policy, notify):
        made = body(osm)
        new = sites.add(osm, sites.COLLECTIONS[which], made, wait_policy, notify)
    print_line(f"{made['name']} is {'added' if new else 'already in OSM, and unchanged'}")


def _facts(one: SiteRecord) -> dict[str, str]:
    return {
        "name": one.name,
        "id": one.record,
        "kind": one.vim_type or one.type,
        "address": redacted(one.vim_url or one.url),
        "state": one.admin.operational_state.lower(),
        "detail": one.admin.detail,
    }


def _declare(group: App, which: str) -> None:
    """Declare `list` and `remove` of a group."""

    @group.command("list")
    @options(Connection)
    def list_(params: Connection, as_json: Json = False) -> None:
        """List names, addresses and states."""
        from scan2sim.services.orchestration import sites

        with messages_on_stderr(as_json), osm_client(params) as osm:
            found = osm.sites(sites.COLLECTIONS[which])
        if as_json:
            print_json([_facts(one) for one in found])
            return
        table = Table("name", "kind", "address", "state")
        for one in map(_facts, found):
            reason = f": {one['detail'][:200]}" if one["state"] == "error" and one["detail"] else ""
            table.add_row(*map(escape, (one["name"], one["kind"], one["address"], one["state"] + reason)))
        console.print(table)

    @group.command("remove")
    @options(OperationParams)
    def remove(
        params: OperationParams,
        name: Annotated[str, typer.Argument(metavar="NAME", help="Name or id in OSM.")],
    ) -> None:
        """Remove from OSM, which refuses it while an instance uses it."""
        from scan2sim.services.orchestration import sites

        with operation(params, name) as (osm, wait_policy, _):
            sites.remove(osm, sites.COLLECTIONS[which], name, wait_policy)
        print_line(f"{name} is removed")


for _group, _which in ((vim, "vim"), (cluster, "cluster"), (repo, "repo")):
    _declare(_group, _which)
