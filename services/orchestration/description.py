"""Description of a service: container image, port and requirements. Packages are built from it.

Built-in descriptions are TOML files in `services/`; your own is given by its path.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.io import toml
from scan2sim.services.qos import requirements
from scan2sim.services.qos.requirements import Environment, Requirements

FOLDER = Path(__file__).parent / "services"
LABEL_PATTERN = r"^[a-z]([-a-z0-9]{0,39}[a-z0-9])?$"
"""A valid Kubernetes name, short enough for the suffixes that OSM appends."""
Label = Annotated[str, Field(pattern=LABEL_PATTERN, json_schema_extra={"range": "a-z, 0-9 and -, up to 41 characters"})]


class Description(Params):
    """Description of a service.

    Attributes:
        name: name used in its packages.
        title: title for people.
        image: container image, as a registry names it.
        command: replaces the image's entry point.
        arguments: arguments of the command.
        port: port that it serves on; None if it only connects to others.
        ready: HTTP path of the readiness check on that port.
        token: path of the token file in the container; the Helm chart generates the token as a Secret.
        requirements: name of the built-in requirements to use, see `scan2sim qos show`.
        needs: the requirements themselves, in place of built-in ones.
        machine: name of the virtual machine image at the VIM.
        storage: disk of that machine in GB.
        replicas: maximum number of replicas.
        host_network: share the host's network, which ROS 2 nodes need for discovery by multicast.
        variables: environment variables of the container with their defaults.
    """

    name: Label
    title: str = Field(min_length=1, max_length=200)
    image: str = Field(pattern=r"^[\w./:@-]{1,200}$")
    command: tuple[str, ...] = ()
    arguments: tuple[str, ...] = ()
    port: int | None = Field(None, ge=1, le=65535)
    ready: str | None = Field(None, pattern=r"^/[\w./-]{0,200}$")
    token: str | None = Field(None, pattern=r"^/[\w.-]+(/[\w.-]+)+$", max_length=200)
    requirements: str | None = None
    needs: Requirements | None = None
    machine: str = Field(pattern=r"^[\w.-]{1,100}$")
    storage: int = Field(20, ge=1, le=100_000)
    replicas: int = Field(10, ge=1, le=1000)
    host_network: bool = False
    variables: dict[str, str] = Field(default_factory=dict)

    def requirements_in(self, environment: Environment) -> Requirements:
        """Requirements in the environment where it runs.

        Raises:
            SettingError: the service isn't meant for this environment.
        """
        if self.needs is not None or self.requirements is None:
            return self.needs or Requirements()
        return requirements.read(self.requirements).of(environment)


def names() -> list[str]:
    """Names of the built-in services."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def read(which: str | Path) -> Description:
    """Read a built-in description or a file.

    Raises:
        InputError: the file can't be read or is invalid.
    """
    path = FOLDER / f"{which}.toml" if str(which) in names() else Path(which)
    absent = ("neither a file nor a built-in service", f"Give a file, or one of: {', '.join(names())}")
    return toml.read(path, Description, absent=absent, fields="docs/orchestration.md lists the fields")
