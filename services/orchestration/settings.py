"""Settings of the `scan2sim orchestrate` commands and the web page: address of OSM, credentials, waiting."""

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
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.loopback import is_loopback
from scan2sim.services.orchestration import certificates

EXAMPLE = "Give https://HOST:9999"


class Connection(Params):
    """Address of OSM and credentials; the environment variables are those of OSM's own client."""

    osm: Annotated[
        str, Field(max_length=500, description="Address of OSM's northbound interface. Default: $OSM_HOSTNAME.")
    ] = ""
    user: Annotated[str, Field(max_length=200, description="User name. Default: $OSM_USER, or admin.")] = ""
    project: Annotated[str, Field(max_length=200, description="Project. Default: $OSM_PROJECT, or admin.")] = ""
    password: Annotated[
        File | None, Field(description="File with the password. Default: the value of $OSM_PASSWORD.")
    ] = None
    ca: Annotated[
        File | None, Field(description="CA certificate (PEM) to trust, if OSM's isn't signed by a public authority.")
    ] = None
    fingerprint: Annotated[
        str,
        Field(
            max_length=200,
            description="SHA-256 fingerprint of OSM's certificate, to trust it though no authority signed it or it has"
            " expired. Needed once: it is stored for this address.",
        ),
    ] = ""

    def northbound_url(self) -> str:
        """URL of the northbound interface: https://HOST:PORT.

        Raises:
            SettingError: the address is missing or invalid.
        """
        given = self.osm or os.environ.get("OSM_HOSTNAME", "")
        if not given:
            raise SettingError("--osm", "missing, and $OSM_HOSTNAME isn't set", EXAMPLE)
        try:
            parts = urlsplit(given if "://" in given else f"https://{given}")
            port = parts.port
        except ValueError as error:
            raise SettingError("--osm", f"{redacted(given):.100} isn't an address ({error})", EXAMPLE) from None
        if parts.scheme != "https" and not (is_loopback(parts.hostname or "") and parts.scheme == "http"):
            raise SettingError("--osm", f"{redacted(given):.100} doesn't use TLS", EXAMPLE)
        if not parts.hostname or "@" in parts.netloc or parts.path not in ("", "/", "/osm", "/osm/"):
            raise SettingError("--osm", f"{redacted(given):.100} isn't an address of OSM", EXAMPLE)
        return f"{parts.scheme}://{parts.netloc}" + ("" if port else ":9999")

    def read_password(self) -> str:
        """The password, from its file or $OSM_PASSWORD.

        Raises:
            InputError: the file can't be read. SettingError: there is no password.
        """
        if self.password is not None:
            try:
                return self.password.read_text("utf-8").strip()
            except (OSError, UnicodeError) as error:
                raise InputError(self.password, f"can't be read ({error})", "Give a text file that holds it") from None
        if "OSM_PASSWORD" not in os.environ:
            raise SettingError("--password", "missing, and $OSM_PASSWORD isn't set", "Give a file with the password")
        return os.environ["OSM_PASSWORD"]

    def ssl_context(self) -> ssl.SSLContext:
        """TLS context that trusts the given certificate authority, the fingerprint, or public authorities.

        Raises:
            InputError: the certificate file or the file of fingerprints can't be read. SettingError: no fingerprint.
        """
        if self.northbound_url().startswith("http:"):
            return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # isn't used
        if self.fingerprint and self.ca:
            raise SettingError("--fingerprint", "given together with --ca", "Give one of them")
        trusted = certificates.parse(self.fingerprint) if self.fingerprint else None
        if not self.ca and (trusted := trusted or certificates.known(self.northbound_url())):
            return certificates.PinnedContext.of(self.northbound_url(), trusted)
        try:
            return ssl.create_default_context(cafile=self.ca)
        except (OSError, ssl.SSLError) as error:
            raise InputError(self.ca or "", f"not a certificate ({error})", "Give a PEM file") from None


class ApplyParams(Connection):
    """Settings of `apply` and `delete`."""

    wait: Annotated[bool, Field(description="Wait until all services are running, and report the outcome.")] = False
    timeout: Annotated[float, Field(ge=1, le=86_400, description="Timeout of one OSM operation in seconds.")] = 1800.0
    parallel: Annotated[int, Field(ge=1, le=100, description="Number of instances to change at the same time.")] = 10


class OperationParams(Connection):
    """Settings of a single operation."""

    wait: Annotated[bool, Field(description="Wait until OSM has completed the operation.")] = False
    timeout: Annotated[float, Field(ge=1, le=86_400, description="Timeout of one OSM operation in seconds.")] = 1800.0


class InstantiateParams(OperationParams):
    """Settings of `instantiate`."""

    replicas: Annotated[int, Field(ge=1, le=1000, description="Number of replicas of its function.")] = 1


class ScaleInstanceParams(OperationParams):
    """Settings of `scale`."""

    name: Annotated[str, Field(max_length=200, description="Name or id of the instance in OSM.")]
    replicas: Annotated[int, Field(ge=1, le=1000, description="Number of replicas of its function.")]


class PageParams(Connection, ServerParams):
    """Settings of the web page."""

    packages: Annotated[File, Field(description="Folder of packages; uploads are stored here too.")]
    vim: Annotated[str, Field(max_length=200, description="VIM account to instantiate services on.")] = ""
    cluster: Annotated[str, Field(max_length=200, description="Kubernetes cluster to instantiate services on.")] = ""
