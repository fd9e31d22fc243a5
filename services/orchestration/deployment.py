"""`services.toml`: which services are to run where, and what is made of it for OSM."""

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
from scan2sim.services.orchestration.instance import Wanted
from scan2sim.services.orchestration.package import Packages, build
from scan2sim.services.orchestration.sol006 import Kind
from scan2sim.services.qos.requirements import Environment

MOST = 1000
"""Services of a deployment."""


class Entry(Params):
    """A service that is to run.

    Attributes:
        name: of its instance.
        service: one that comes along, or a description's file.
        environment: where it runs, which says what it needs there.
        kind: what it runs as.
        vim: VIM account, by name or id; cluster: of Kubernetes, in its place.
        replicas: how many.
        namespace: of Kubernetes; "": the project's.
        repository: of OSM that has its chart; None: the chart comes with its package.
        ssh_keys: files of public keys, of who may log in to machines.
        values: of its chart, or given to its machine.
    """

    name: Label
    service: str = Field(min_length=1, max_length=4096)
    environment: Environment = Environment.EDGE
    kind: Kind = "container"
    vim: str = Field("", max_length=200)
    cluster: str = Field("", max_length=200)
    replicas: int = Field(1, ge=1, le=1000)
    namespace: str = Field("", max_length=63, pattern=r"^([a-z0-9]([-a-z0-9]*[a-z0-9])?)?$")
    repository: str | None = Field(None, pattern=r"^[\w-]{1,100}$")
    ssh_keys: tuple[Path, ...] = ()
    values: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_site(self) -> Entry:
        if bool(self.vim) == bool(self.cluster):
            raise ValueError(f"{self.name}: give `vim` or `cluster`")
        if self.cluster and self.kind == "machine":
            raise ValueError(f"{self.name}: a machine needs `vim`")
        return self


class Deployment(Params):
    """All that is to run, and nothing else of this name.

    Attributes:
        deployment: its name, which all that it makes in OSM is marked by.
        services: that are to run.
    """

    deployment: Label
    services: tuple[Entry, ...] = Field((), alias="service", max_length=MOST)

    @model_validator(mode="after")
    def _names_differ(self) -> Deployment:
        names = [one.name for one in self.services]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two services are called {twice}")
        return self


def read(path: Path) -> Deployment:
    """A file's.

    Raises:
        InputError: it is missing, or says something that can't be.
    """
    absent = ("is missing", "docs/orchestration.md shows one")
    return toml.read(path, Deployment, absent=absent, fields="docs/orchestration.md lists the fields")


def packages(entry: Entry, deployment: str, folder: Path) -> Packages:
    """Of a service; a description's file is looked for in `folder`, where the deployment's is.

    Raises:
        ScanError: as `description.read` and `package.build`.
    """
    which = entry.service if entry.service in description.names() else folder / entry.service
    service = description.read(which)
    return build(service, entry.environment, entry.kind, deployment, entry.repository)


def wanted(entry: Entry, deployment: str, made: Packages, folder: Path, vim: Callable[[Entry], str]) -> Wanted:
    """What is to be in OSM; `vim` says which VIM account's id.

    Raises:
        InputError: a key can't be read.
    """
    function = made.function.descriptor
    name = function.kdus[0] if entry.kind == "container" else function.body["vnfd"]["vdu"][0]["id"]
    return Wanted(
        name=entry.name,
        deployment=deployment,
        service=name,
        kind=entry.kind,
        nsd=made.service.descriptor.id,
        vim=vim(entry),
        replicas=entry.replicas,
        keys=tuple(read_key(folder / key) for key in entry.ssh_keys),
        values=entry.values,
        namespace=entry.namespace,
    )


def read_key(path: Path) -> str:
    """A public SSH key.

    Raises:
        InputError: it is none.
    """
    try:
        text = path.read_text("utf-8").strip()
    except (OSError, UnicodeError) as error:
        raise InputError(path, f"can't be read ({error})", "Give a public SSH key") from None
    if "PRIVATE KEY" in text:
        raise InputError(path, "is a private key, which nobody else may have", "Give the public one, .pub")
    if not text.startswith(("ssh-", "ecdsa-", "sk-")) or "\n" in text:
        raise InputError(path, "is no public SSH key", "Give a file of one line, .pub")
    return text
