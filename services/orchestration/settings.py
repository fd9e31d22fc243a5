"""What commands and the page are told: where OSM is, who asks, how long to wait."""

from __future__ import annotations

import os
import ssl
from typing import Annotated
from urllib.parse import urlsplit

from pydantic import Field

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.credentials import redacted
from scan2sim.services.http.settings import Served
from scan2sim.services.loopback import is_loopback
from scan2sim.services.monitoring.settings.bus import FollowedParams


class Connection(Params):
    """Where OSM is, and who asks; the variables are those of its own client."""

    osm: Annotated[
        str, Field(max_length=500, description="Address of OSM's northbound interface; default: $OSM_HOSTNAME.")
    ] = ""
    user: Annotated[str, Field(max_length=200, description="User; default: $OSM_USER, or admin.")] = ""
    project: Annotated[str, Field(max_length=200, description="Project; default: $OSM_PROJECT, or admin.")] = ""
    password: Annotated[
        File | None, Field(description="File that holds the password; default: what $OSM_PASSWORD says.")
    ] = None
    ca: Annotated[
        File | None, Field(description="Certificate (PEM) that OSM's is signed by, where no public authority did.")
    ] = None

    def northbound(self) -> str:
        """https://HOST:PORT.

        Raises:
            SettingError: it is none.
        """
        given = self.osm or os.environ.get("OSM_HOSTNAME", "")
        if not given:
            raise SettingError("--osm", "is missing, and so is $OSM_HOSTNAME", "Give https://HOST:9999")
        parts = urlsplit(given if "://" in given else f"https://{given}")
        if parts.scheme != "https" and not (is_loopback(parts.hostname or "") and parts.scheme == "http"):
            raise SettingError("--osm", f"{redacted(given):.100} isn't reached by TLS", "Give https://HOST:9999")
        if not parts.hostname or "@" in parts.netloc or parts.path not in ("", "/", "/osm", "/osm/"):
            raise SettingError("--osm", f"{redacted(given):.100} is no address of OSM's", "Give https://HOST:9999")
        return f"{parts.scheme}://{parts.netloc}" + ("" if parts.port else ":9999")

    def login(self) -> str:
        """The password.

        Raises:
            InputError: its file can't be read. SettingError: there is none.
        """
        if self.password is not None:
            try:
                return self.password.read_text("utf-8").strip()
            except (OSError, UnicodeError) as error:
                raise InputError(self.password, f"can't be read ({error})", "Write the password into it") from None
        if "OSM_PASSWORD" not in os.environ:
            raise SettingError("--password", "is missing, and so is $OSM_PASSWORD", "Give a file that holds it")
        return os.environ["OSM_PASSWORD"]

    def trust(self) -> ssl.SSLContext:
        """Whose certificates are good.

        Raises:
            InputError: the authority's file is none.
        """
        try:
            return ssl.create_default_context(cafile=self.ca)
        except (OSError, ssl.SSLError) as error:
            raise InputError(self.ca or "", f"is no certificate ({error})", "Give a PEM file") from None


class ApplyParams(Connection):
    """How a deployment is brought about."""

    wait: Annotated[bool, Field(description="Wait until all services run, and say how that went.")] = False
    timeout: Annotated[float, Field(ge=1, le=86_400, description="Seconds for one operation of OSM's.")] = 1800.0
    parallel: Annotated[int, Field(ge=1, le=100, description="Instances that are worked on at once.")] = 10


class ActParams(Connection):
    """How something is done by hand."""

    wait: Annotated[bool, Field(description="Wait until OSM is done with it.")] = False
    timeout: Annotated[float, Field(ge=1, le=86_400, description="Seconds for one operation of OSM's.")] = 1800.0


class StartParams(ActParams):
    """How an instance is begun."""

    replicas: Annotated[int, Field(ge=1, le=1000, description="How many of its function there are to be.")] = 1


class ResizeParams(ActParams):
    """How an instance is scaled."""

    name: Annotated[str, Field(max_length=200, description="Its name in OSM, or its id.")]
    replicas: Annotated[int, Field(ge=1, le=1000, description="How many of its function there are to be.")]


class PageParams(Connection, Served):
    """Of the page."""

    packages: Annotated[File, Field(description="Folder of packages, which those that are uploaded go to as well.")]
    vim: Annotated[str, Field(max_length=200, description="VIM account that services are instantiated on.")] = ""
    cluster: Annotated[str, Field(max_length=200, description="Kubernetes cluster that they are instantiated on.")] = ""


class ScaledParams(FollowedParams, Connection):
    """Of a node that scales an instance as the event bus asks."""

    instance: Annotated[str, Field(max_length=200, description="Its name in OSM.")]
