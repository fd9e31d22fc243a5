"""`services.toml`: the services to run and their sites, and how they are represented in OSM."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.io import toml
from scan2sim.services.orchestration import description
from scan2sim.services.orchestration.description import Label
from scan2sim.services.orchestration.instance import DesiredInstance
from scan2sim.services.orchestration.package import Packages, build
from scan2sim.services.orchestration.sol006 import FunctionKind
from scan2sim.services.qos.requirements import Environment

MAX_SERVICES = 1000
"""Maximum number of services in a deployment."""


class ServiceEntry(Params):
    """A service to run.

    Attributes:
        name: name of its instance.
        service: name of a built-in service, or path of a description file.
        environment: where it runs; selects its requirements.
        kind: container or machine.
        vim: VIM account, by name or id.
        cluster: Kubernetes cluster, by name or id, in place of `vim`.
        replicas: number of replicas.
        namespace: Kubernetes namespace; empty: the project's.
        repository: Helm repository in OSM that has its chart; None: the chart is included in its package.
        ssh_keys: files of public SSH keys that may log in to machines.
        values: Helm values of its chart, or parameters of its machine.
    """

    name: Label
    service: str = Field(min_length=1, max_length=4096)
    environment: Environment = Environment.EDGE
    kind: FunctionKind = "container"
    vim: str = Field("", max_length=200)
    cluster: str = Field("", max_length=200)
    replicas: int = Field(1, ge=1, le=1000)
    namespace: str = Field("", max_length=63, pattern=r"^([a-z0-9]([-a-z0-9]*[a-z0-9])?)?$")
    repository: str | None = Field(None, pattern=r"^[\w-]{1,100}$")
    ssh_keys: tuple[Path, ...] = ()
    values: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_site(self) -> ServiceEntry:
        if bool(self.vim) == bool(self.cluster):
            raise ValueError(f"{self.name}: give `vim` or `cluster`")
        if self.cluster and self.kind == "machine":
            raise ValueError(f"{self.name}: a machine needs `vim`")
        return self


class Deployment(Params):
    """All services of a deployment; instances of this deployment that aren't listed are removed.

    Attributes:
        deployment: its name, the owner tag of everything that it creates in OSM.
        services: services to run.
    """

    deployment: Label
    services: tuple[ServiceEntry, ...] = Field((), alias="service", max_length=MAX_SERVICES)

    @model_validator(mode="after")
    def _names_differ(self) -> Deployment:
        names = [one.name for one in self.services]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"duplicate service name: {twice}")
        return self


def read(path: Path) -> Deployment:
    """Read a `services.toml`.

    Raises:
        InputError: the file is missing or invalid.
    """
    absent = ("file not found", "See docs/orchestration.md for an example")
    return toml.read(path, Deployment, absent=absent, fields="docs/orchestration.md lists the fields")


def packages(entry: ServiceEntry, deployment: str, folder: Path) -> Packages:
    """Packages of a service; relative paths of description files start at `folder`, the deployment file's folder.

    Raises:
        ScanError: see `description.read` and `package.build`.
    """
    which = entry.service if entry.service in description.names() else folder / entry.service
    service = description.read(which)
    return build(service, entry.environment, entry.kind, deployment, entry.repository)


def desired_instance(
    entry: ServiceEntry, deployment: str, built: Packages, folder: Path, vim: Callable[[ServiceEntry], str]
) -> DesiredInstance:
    """Desired instance of a service; `vim` returns the id of its VIM account.

    Raises:
        InputError: a key can't be read.
    """
    function = built.function.descriptor
    name = function.kdus[0] if entry.kind == "container" else function.body["vnfd"]["vdu"][0]["id"]
    return DesiredInstance(
        name=entry.name,
        deployment=deployment,
        service=name,
        kind=entry.kind,
        nsd=built.service.descriptor.id,
        vim=vim(entry),
        replicas=entry.replicas,
        keys=tuple(read_key(folder / key) for key in entry.ssh_keys),
        values=entry.values,
        namespace=entry.namespace,
    )


def read_key(path: Path) -> str:
    """Read a public SSH key.

    Raises:
        InputError: the file isn't a public SSH key.
    """
    try:
        text = path.read_text("utf-8").strip()
    except (OSError, UnicodeError) as error:
        raise InputError(path, f"can't be read ({error})", "Give a public SSH key") from None
    if "PRIVATE KEY" in text:
        raise InputError(path, "is a private key, which must stay secret", "Give the public key, .pub")
    if not text.startswith(("ssh-", "ecdsa-", "sk-")) or "\n" in text:
        raise InputError(path, "not a public SSH key", "Give a .pub file with a single line")
    return text
