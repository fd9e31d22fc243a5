"""Where and how a service listens: what every one of them is told, on the command line as in code."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params
from scan2sim.services.loopback import is_loopback, require_protection

SHORTEST_TOKEN = 16
"""Characters of a token, at least."""


class Served(Params):
    """Options of every HTTP service.

    Raises:
        SettingError: it would listen beyond the loopback without a token or a certificate.
    """

    host: Annotated[
        str,
        Field(
            description="Address to listen on; 0.0.0.0 for all of this machine. Other machines reach all but 127.0.0.1 "
            "and ::1, so these need --token, or --certificate and --key."
        ),
    ] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535, description="Port to listen on; 0 for any that is free.")] = 8080
    token: Annotated[
        File | None, Field(description="File that holds a token; who asks for anything must bring it (Bearer).")
    ] = None
    certificate: Annotated[File | None, Field(description="Certificate (PEM): serve by TLS; with --key.")] = None
    key: Annotated[File | None, Field(description="The certificate's private key (PEM).")] = None

    @model_validator(mode="after")
    def _is_protected(self) -> Self:
        protected = self.token is not None or self.certificate is not None
        require_protection(self.host, protected=protected, options="--token FILE, or --certificate and --key")
        return self

    def secret(self) -> str | None:
        """The token; None: everybody may ask.

        Raises:
            InputError: its file can't be read, or holds none that is worth the name.
        """
        if self.token is None:
            return None
        text = _text(self.token).strip()
        if len(text) < SHORTEST_TOKEN or not text.isascii() or not text.isprintable() or " " in text:
            cause = f"must hold one token, {SHORTEST_TOKEN} characters at least, no spaces"
            raise InputError(self.token, cause, "Make one: openssl rand -hex 32")
        return text

    def check_tls(self) -> bool:
        """Whether it is served by TLS.

        Raises:
            SettingError: of certificate and key there is but one.
            InputError: they can't be read, or don't belong together.
        """
        if (self.certificate is None) != (self.key is None):
            missing = "--key" if self.key is None else "--certificate"
            raise SettingError(missing, "is missing: TLS needs certificate and key", "Give both, or neither")
        if self.certificate is None or self.key is None:
            return False
        for path in (self.certificate, self.key):
            _text(path)
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(self.certificate, self.key)
        except (ssl.SSLError, OSError) as error:
            raise InputError(self.certificate, f"can't be used with {self.key} ({error})", "Give PEM files") from None
        return True

    def listen(self) -> socket.socket:
        """A socket that listens.

        Raises:
            SettingError: the address isn't this machine's, or the port is taken or reserved.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            return socket.create_server((self.host, self.port), family=family)
        except OSError as error:
            cause = f"can't be listened on ({error.strerror or error})"
            raise SettingError(f"{self.host}:{self.port}", cause, "Choose another --port or --host") from None

    def address(self, port: int) -> str:
        """Where a browser finds it, once it listens on a port."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.certificate else 'http'}://{host}:{port}/"

    def is_local(self) -> bool:
        """Whether only this machine reaches it."""
        return is_loopback(self.host)

    def is_open(self) -> bool:
        """Whether other machines may use it without a token."""
        return self.token is None and not self.is_local()


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"can't be read ({error})", "Check that it exists and is a text file") from None
