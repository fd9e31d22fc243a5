"""A proxy that demands TLS with client certificates and SASL in front of a Kafka broker, as companies have it.

It answers SaslHandshake and SaslAuthenticate (Kafka protocol guide, "SASL Authentication Sequence") and forwards all
other requests. Mechanisms: PLAIN, SCRAM (RFC 5802; the package scramp) and OAUTHBEARER (RFC 7628).
"""

from __future__ import annotations

import socket
import ssl
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from scramp import ScramException, ScramMechanism

SASL_HANDSHAKE, SASL_AUTHENTICATE, API_VERSIONS = 17, 36, 18
UNSUPPORTED_MECHANISM, AUTHENTICATION_FAILED = 33, 58

Dialogue = Callable[[bytes], tuple[bytes, bool]]
"""Server's side of a mechanism: from a client's message to the answer, and whether the client is authenticated."""


class Refused(Exception):
    """The client doesn't authenticate itself."""


def plain(user: str, password: str) -> Dialogue:
    """PLAIN (RFC 4616)."""

    def answer(message: bytes) -> tuple[bytes, bool]:
        if message != f"\0{user}\0{password}".encode():
            raise Refused
        return b"", True

    return answer


def scram(mechanism: str, user: str, password: str) -> Dialogue:
    """SCRAM-SHA-256 or SCRAM-SHA-512."""
    scheme = ScramMechanism(mechanism)
    known = {user: scheme.make_auth_info(password, iteration_count=4096)}
    server: Any = scheme.make_server(lambda name: known[name])
    first = True

    def answer(message: bytes) -> tuple[bytes, bool]:
        nonlocal first
        try:
            if first:
                first = False
                server.set_client_first(message.decode())
                return server.get_server_first().encode(), False
            server.set_client_final(message.decode())
            return server.get_server_final().encode(), True
        except (ScramException, KeyError):
            raise Refused from None

    return answer


def oauthbearer(is_valid: Callable[[str], bool]) -> Dialogue:
    """OAUTHBEARER; `is_valid` checks the token."""

    def answer(message: bytes) -> tuple[bytes, bool]:
        fields = dict(part.partition("=")[::2] for part in message.decode().split("\x01"))
        if not is_valid(fields.get("auth", "").removeprefix("Bearer ")):
            raise Refused
        return b"", True

    return answer


class SecureProxy:
    """Listens on a port and forwards the requests of authenticated clients to a broker.

    Attributes:
        port: on which it listens.
        refused: number of connections that were refused.
    """

    def __init__(
        self, port: int, broker_port: int, certificates: Path, mechanisms: dict[str, Callable[[], Dialogue]]
    ) -> None:
        """Begin to listen.

        Args:
            port: on which it listens.
            broker_port: of the broker.
            certificates: folder with ca.pem, server.pem and server.key.
            mechanisms: by name, a function that begins a dialogue.
        """
        self.port, self.refused = port, 0
        self._broker_port, self._mechanisms = broker_port, mechanisms
        self._context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(certificates / "ca.pem"))
        self._context.verify_mode = ssl.CERT_REQUIRED
        self._context.load_cert_chain(certificates / "server.pem", certificates / "server.key")
        self._listener = socket.create_server(("127.0.0.1", port))
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                raw, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(raw,), daemon=True).start()

    def _serve(self, raw: socket.socket) -> None:
        try:
            with self._context.wrap_socket(raw, server_side=True) as client:
                if self._authenticate(client):
                    return
        except OSError:
            pass
        self.refused += 1

    def _authenticate(self, client: ssl.SSLSocket) -> bool:
        """Serve a client; returns whether it has authenticated."""
        dialogue: Dialogue | None = None
        with socket.create_connection(("127.0.0.1", self._broker_port)) as broker:
            while True:
                frame = _read(client)
                key, _, correlation = struct.unpack(">hhi", frame[:8])
                content = frame[10 + max(0, struct.unpack(">h", frame[8:10])[0]) :]
                if key == API_VERSIONS:
                    _write(broker, frame)
                    _write(client, _read(broker))
                elif key == SASL_HANDSHAKE:
                    begin = self._mechanisms.get(content[2:].decode())
                    dialogue, error = (begin(), 0) if begin else (None, UNSUPPORTED_MECHANISM)
                    names = b"".join(struct.pack(">h", len(name)) + name.encode() for name in self._mechanisms)
                    _write(client, struct.pack(">ihi", correlation, error, len(self._mechanisms)) + names)
                    if dialogue is None:
                        return False
                else:
                    try:
                        if key != SASL_AUTHENTICATE or dialogue is None:
                            raise Refused
                        answer, done = dialogue(content[4:])
                    except Refused:
                        reason = b"wrong user or password"
                        body = struct.pack(">ihh", correlation, AUTHENTICATION_FAILED, len(reason)) + reason
                        _write(client, body + struct.pack(">iq", 0, 0))
                        return False
                    _write(
                        client, struct.pack(">ihhi", correlation, 0, -1, len(answer)) + answer + struct.pack(">q", 0)
                    )
                    if done:
                        break
            with suppress(OSError):
                while True:  # answers are in the order of requests, and each request here has one
                    frame = _read(client)
                    _write(broker, frame)
                    _write(client, _read(broker))
        return True


def _read(source: socket.socket) -> bytes:
    """Content of the next frame."""
    (size,) = struct.unpack(">i", _exactly(source, 4))
    return _exactly(source, size)


def _exactly(source: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        part = source.recv(min(65536, size - len(data)))
        if not part:
            raise ConnectionError("closed")
        data += part
    return bytes(data)


def _write(target: socket.socket, content: bytes) -> None:
    target.sendall(struct.pack(">i", len(content)) + content)
