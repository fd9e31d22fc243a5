"""TLS and DTLS as the mission asks for them (D3.2, section 4.3), without sockets: bytes in, bytes out.

1.2 or newer, both ends with a certificate, ECDSA for signatures, ECDHE for keys, ciphers in the mission's order. TLS
1.3 agrees on keys by X25519 together with ML-KEM-768 where OpenSSL has that (from 3.5 on);
OpenSSL's DTLS ends at 1.2, which knows X25519 and the NIST's curves alone. Whoever isn't let in fails in
the handshake.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable
from typing import Any

from cryptography.hazmat.bindings.openssl.binding import Binding
from OpenSSL import SSL, crypto

from scan2sim.services.teleoperation.gateway.identity import Identity, Peer, Stranger

CIPHERS = b"ECDHE-ECDSA-CHACHA20-POLY1305:ECDHE-ECDSA-AES256-GCM-SHA384:ECDHE-ECDSA-AES128-GCM-SHA256"
CIPHERS_13 = b"TLS_CHACHA20_POLY1305_SHA256:TLS_AES_256_GCM_SHA384:TLS_AES_128_GCM_SHA256"
DTLS_1_2 = 0xFEFD
MTU = 1200
"""Bytes of a handshake's datagram: fits into any network's packet."""
DATAGRAM = 2048
"""Bytes of the largest datagram that is looked at."""
_HEADER = 13
"""Bytes before a DTLS record's content: kind, version, epoch, number, length."""
_WHY = {9: "isn't valid yet", 10: "has expired", 26: "is for another role"}
_FAILED = (SSL.Error, SSL.SysCallError, SSL.ZeroReturnError)


class Refused(Exception):
    """The handshake failed, or the connection broke; says why."""


class Ended(Exception):
    """The other end has closed the connection."""


def context(identity: Identity, *, datagrams: bool) -> SSL.Context:
    """For connections of a party, as client or server."""
    made = SSL.Context(SSL.DTLS_METHOD if datagrams else SSL.TLS_METHOD)
    made.set_min_proto_version(DTLS_1_2 if datagrams else SSL.TLS1_2_VERSION)
    made.set_cipher_list(CIPHERS)
    made.set_tls13_ciphersuites(CIPHERS_13)
    made.use_certificate(identity.certificate)
    made.use_privatekey(identity.key)
    store = made.get_cert_store()
    assert store is not None
    store.add_cert(crypto.X509.from_cryptography(identity.authority))
    made.set_verify(SSL.VERIFY_PEER | SSL.VERIFY_FAIL_IF_NO_PEER_CERT, _verify)
    made.set_session_cache_mode(SSL.SESS_CACHE_OFF)  # every handshake sees the certificates
    options = SSL.OP_NO_RENEGOTIATION | SSL.OP_NO_TICKET | SSL.OP_NO_COMPRESSION | SSL.OP_CIPHER_SERVER_PREFERENCE
    made.set_options(options | (SSL.OP_NO_QUERY_MTU if datagrams else 0))
    if datagrams:
        secret = secrets.token_bytes(32)

        def cookie(ssl: SSL.Connection) -> bytes:
            return hmac.digest(secret, ssl.get_app_data().address.encode(), "sha256")

        made.set_cookie_generate_callback(cookie)
        made.set_cookie_verify_callback(lambda ssl, given: hmac.compare_digest(given, cookie(ssl)))
    return made


def _verify(ssl: SSL.Connection, certificate: crypto.X509, error: int, depth: int, good: int) -> bool:
    channel: Channel = ssl.get_app_data()
    if not good:
        channel.why = f"its certificate {_WHY.get(error, 'is not of our authority')}"
        return False
    if depth:
        return True
    try:
        channel.peer = Peer.of(certificate.to_cryptography())
    except Stranger as stranger:
        channel.why = str(stranger)
        return False
    if not channel.accepts(channel.peer):
        channel.why = f"{channel.peer} is not expected here"
        return False
    return True


class Channel:
    """One end of a connection. Not for several threads at once.

    Args:
        accepts: whether a party whose certificate holds is let in.
        address: where the other end is, for cookies and messages.

    Attributes:
        peer: who is at the other end, once `established`.
        why: it was refused.
    """

    def __init__(
        self, context: SSL.Context, *, client: bool, accepts: Callable[[Peer], bool], address: str = ""
    ) -> None:
        self.accepts, self.address = accepts, address
        self.established = False
        self.peer: Peer | None = None
        self.why = ""
        self._ssl = SSL.Connection(context)
        self._ssl.set_app_data(self)
        self._ssl.set_ciphertext_mtu(MTU)
        self._ssl.set_connect_state() if client else self._ssl.set_accept_state()

    def listen(self, hello: bytes) -> bool:
        """A server's first datagram: whether its sender is where it says; else `take` what to answer."""
        self._ssl.bio_write(hello)
        try:
            self._ssl.DTLSv1_listen()
        except SSL.WantReadError:
            return False
        except _FAILED as error:
            raise self._refused(error) from None
        finally:
            Binding.lib.ERR_clear_error()  # what it leaves behind, this thread's next call would take for its own
        return True

    def handshake(self) -> bool:
        """Go on with it; whether it is done.

        Raises:
            Refused: it failed.
        """
        try:
            self._ssl.do_handshake()
        except SSL.WantReadError:
            return False
        except _FAILED as error:
            raise self._refused(error) from None
        self.established = True
        return True

    def put(self, data: bytes) -> None:
        """Bytes, or a datagram, that came."""
        self._ssl.bio_write(data)

    def read(self) -> bytes | None:
        """Of what was put, what the other end has sent; None: there is nothing more.

        Raises:
            Refused: the connection broke.
            Ended: the other end has closed it.
        """
        try:
            return self._ssl.recv(2**14)
        except SSL.WantReadError:
            return None
        except SSL.ZeroReturnError:
            raise Ended from None
        except _FAILED as error:
            raise self._refused(error) from None

    def write(self, data: bytes) -> None:
        """Something for the other end; `take` what is to be sent."""
        try:
            while data:  # a record at a time
                data = data[self._ssl.send(data) :]
        except (*_FAILED, SSL.WantReadError) as error:
            raise self._refused(error) from None

    def take(self) -> bytes:
        """All that is to be sent."""
        parts = []
        try:
            while True:
                parts.append(self._ssl.bio_read(2**14))
        except SSL.WantReadError:
            return b"".join(parts)

    def seal(self, data: bytes) -> bytes:
        """`write` and `take` of one datagram."""
        self.write(data)
        return self._ssl.bio_read(DATAGRAM)

    def timer(self) -> float | None:
        """Seconds until a lost part of DTLS's handshake is to be sent again; None: nothing waits."""
        return self._ssl.DTLSv1_get_timeout()

    def expired(self) -> None:
        """That time has passed; `take` what to send.

        Raises:
            Refused: it was sent often enough.
        """
        try:
            self._ssl.DTLSv1_handle_timeout()
        except _FAILED as error:
            raise self._refused(error) from None

    def close(self) -> None:
        """Tell the other end so; `take` what to send."""
        try:
            self._ssl.shutdown()
        except (*_FAILED, SSL.WantReadError):
            pass

    def agreed(self) -> dict[str, str]:
        """What the two agreed on: version, cipher, and the group that keys come from."""
        return {
            "version": self._ssl.get_protocol_version_name(),
            "cipher": self._ssl.get_cipher_name() or "",
            "group": self._ssl.get_group_name() or "",
        }

    def _refused(self, error: Any) -> Refused:
        if self.why:
            return Refused(self.why)
        told = error.args[0] if error.args and isinstance(error.args[0], list) else []
        reasons = ", ".join(str(reason) for _, _, reason in told) or "the connection broke"
        return Refused(reasons)


def datagrams(data: bytes) -> list[bytes]:
    """DTLS records, as many in a datagram as fit."""
    made: list[bytes] = []
    while data:
        size = _HEADER + int.from_bytes(data[11:13], "big")
        record, data = data[:size], data[size:]
        if made and len(made[-1]) + len(record) <= MTU:
            made[-1] += record
        else:
            made.append(record)
    return made
