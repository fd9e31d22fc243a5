"""What a service is, said once: its image, what it listens on, what it needs; packages are made of it.

Those that come along are in `described/`, a TOML file each; yours is given by its path.
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
LABEL = r"^[a-z]([-a-z0-9]{0,39}[a-z0-9])?$"
"""What Kubernetes takes for a name, short enough for OSM to add to it."""
Label = Annotated[str, Field(pattern=LABEL, json_schema_extra={"range": "a-z, 0-9 and -, up to 41 characters"})]


class Description(Params):
    """Of a service.

    Attributes:
        name: of its packages.
        title: for people.
        image: of its container, as a registry names it.
        command: in place of the image's entry point; arguments: behind it.
        port: that it serves on; None: it only asks others.
        ready: path on that port that says whether it can be asked.
        token: file in its container with the token that its callers need; its chart generates one, as a Secret.
        requirements: whose needs it has, as `scan2sim qos show` prints them.
        needs: its needs, where no table has them.
        machine: image of a virtual machine that runs it, as the VIM knows it.
        storage: GB of that machine's disk.
        replicas: how many there may be, at most.
        host_network: share the host's network, as nodes of ROS 2 must that find each other by multicast.
        variables: of the container's environment, with their defaults.
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

    def needed(self, environment: Environment) -> Requirements:
        """Where it runs.

        Raises:
            SettingError: it isn't meant to run there.
        """
        if self.needs is not None or self.requirements is None:
            return self.needs or Requirements()
        return requirements.read(self.requirements).of(environment)


def names() -> list[str]:
    """Of the services that come along."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def read(which: str | Path) -> Description:
    """A service that comes along, or a file's.

    Raises:
        InputError: the file can't be read, or says something else.
    """
    path = FOLDER / f"{which}.toml" if str(which) in names() else Path(which)
    absent = ("is neither a file nor a service that comes along", f"Give a file, or one of: {', '.join(names())}")
    return toml.read(path, Description, absent=absent, fields="docs/orchestration.md lists the fields")
