"""Server settings that all HTTP services share, for code and command line: address, token, TLS."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path
from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.loopback import is_loopback, require_protection

MIN_TOKEN_CHARS = 16


class ServerParams(Params):
    """Server settings of an HTTP service.

    Raises:
        SettingError: other machines could reach it, and neither a token nor a certificate is given.
    """

    PROTECTION: ClassVar[str] = "--token FILE, or --certificate and --key"
    """Options of which it requires one if other machines can reach it."""

    host: Annotated[
        str,
        Field(
            description="Address to listen on; 0.0.0.0 for all network interfaces. Addresses other than 127.0.0.1 and "
            "::1 can be reached by other machines and require --token, or --certificate and --key."
        ),
    ] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535, description="Port to listen on; 0: any free port.")] = 8080
    token: Annotated[
        File | None, Field(description="File with a secret token that clients must send (Authorization: Bearer TOKEN).")
    ] = None
    certificate: Annotated[
        File | None, Field(description="TLS certificate (PEM): serve over HTTPS; requires --key.")
    ] = None
    key: Annotated[File | None, Field(description="Private key of the TLS certificate (PEM).")] = None

    @model_validator(mode="after")
    def _is_protected(self) -> Self:
        require_protection(self.host, protected=self.has_protection(), options=self.PROTECTION)
        return self

    def has_protection(self) -> bool:
        """Whether a token or a certificate is given."""
        return self.token is not None or self.certificate is not None

    def secret(self) -> str | None:
        """Read the token; None: no token is required.

        Raises:
            InputError: the file can't be read or holds no valid token.
        """
        if self.token is None:
            return None
        text = _text(self.token).strip()
        if len(text) < MIN_TOKEN_CHARS or not text.isascii() or not text.isprintable() or " " in text:
            cause = f"must contain one token of at least {MIN_TOKEN_CHARS} ASCII characters without spaces"
            raise InputError(self.token, cause, "Generate one: openssl rand -hex 32")
        return text

    def check_tls(self) -> bool:
        """Validate certificate and key; returns whether TLS is used.

        Raises:
            SettingError: only one of certificate and key is given.
            InputError: they can't be read, or don't match.
        """
        if (self.certificate is None) != (self.key is None):
            missing = "--key" if self.key is None else "--certificate"
            raise SettingError(missing, "is missing: TLS needs a certificate and its key", "Give both, or neither")
        if self.certificate is None or self.key is None:
            return False
        for path in (self.certificate, self.key):
            _text(path)
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(self.certificate, self.key)
        except (ssl.SSLError, OSError) as error:
            cause = f"can't be used with {self.key} ({error})"
            raise InputError(self.certificate, cause, "Give a certificate and its private key as PEM files") from None
        return True

    def listen(self) -> socket.socket:
        """Open a listening socket.

        Raises:
            SettingError: the address isn't this machine's, or the port is in use or reserved.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            return socket.create_server((self.host, self.port), family=family)
        except OSError as error:
            cause = f"can't listen on this address ({error.strerror or error})"
            raise SettingError(f"{self.host}:{self.port}", cause, "Choose another --port or --host") from None

    def address(self, port: int) -> str:
        """URL of the service for browsers, once it listens on a port."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.certificate else 'http'}://{host}:{port}/"

    def is_local(self) -> bool:
        """Whether it can be reached from this machine only."""
        return is_loopback(self.host)

    def is_open(self) -> bool:
        """Whether other machines can use it without a token."""
        return self.token is None and not self.is_local()


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"can't be read ({error})", "Check that it exists and is a text file") from None
