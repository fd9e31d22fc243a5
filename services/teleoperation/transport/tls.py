"""TLS and DTLS as D3.2 requires (section 4.3), without sockets: bytes in, bytes out.

Version 1.2 or newer, certificates on both sides, ECDSA signatures, ECDHE key exchange, cipher order of D3.2. TLS 1.3
uses X25519 combined with ML-KEM-768 if OpenSSL supports it (3.5 or newer). OpenSSL's DTLS is limited to version 1.2,
and to X25519 and the NIST curves. A party that is not accepted fails in the handshake.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable
from typing import Any

from cryptography.hazmat.bindings.openssl.binding import Binding
from OpenSSL import SSL, crypto

from scan2sim.services.teleoperation.identity import Identity, InvalidCertificate, Peer

CIPHERS = b"ECDHE-ECDSA-CHACHA20-POLY1305:ECDHE-ECDSA-AES256-GCM-SHA384:ECDHE-ECDSA-AES128-GCM-SHA256"
CIPHERS_13 = b"TLS_CHACHA20_POLY1305_SHA256:TLS_AES_256_GCM_SHA384:TLS_AES_128_GCM_SHA256"
DTLS_1_2 = 0xFEFD
HANDSHAKE_MTU = 1200
"""Size of handshake datagrams, so that they fit the MTU of any network."""
DATAGRAM_MAX_BYTES = 2048
"""Size of the largest datagram that is processed."""
_RECORD_HEADER_BYTES = 13
"""Header of a DTLS record: type, version, epoch, number, length."""
_VERIFY_ERRORS = {9: "is not valid yet", 10: "has expired", 26: "is for another role"}
_SSL_ERRORS = (SSL.Error, SSL.SysCallError, SSL.ZeroReturnError)


class TlsError(Exception):
    """The handshake failed, or the connection broke; the message has the reason."""


class TlsClosed(Exception):
    """The remote end has closed the connection."""


def context(identity: Identity, *, datagrams: bool) -> SSL.Context:
    """TLS context of a party, for client and server connections."""
    result = SSL.Context(SSL.DTLS_METHOD if datagrams else SSL.TLS_METHOD)
    result.set_min_proto_version(DTLS_1_2 if datagrams else SSL.TLS1_2_VERSION)
    result.set_cipher_list(CIPHERS)
    result.set_tls13_ciphersuites(CIPHERS_13)
    result.use_certificate(identity.certificate)
    result.use_privatekey(identity.key)
    store = result.get_cert_store()
    assert store is not None
    store.add_cert(crypto.X509.from_cryptography(identity.authority))
    result.set_verify(SSL.VERIFY_PEER | SSL.VERIFY_FAIL_IF_NO_PEER_CERT, _verify)
    result.set_session_cache_mode(SSL.SESS_CACHE_OFF)  # every handshake verifies certificates
    options = SSL.OP_NO_RENEGOTIATION | SSL.OP_NO_TICKET | SSL.OP_NO_COMPRESSION | SSL.OP_CIPHER_SERVER_PREFERENCE
    result.set_options(options | (SSL.OP_NO_QUERY_MTU if datagrams else 0))
    if datagrams:
        secret = secrets.token_bytes(32)

        def cookie(ssl: SSL.Connection) -> bytes:
            return hmac.digest(secret, ssl.get_app_data().address.encode(), "sha256")

        result.set_cookie_generate_callback(cookie)
        result.set_cookie_verify_callback(lambda ssl, given: hmac.compare_digest(given, cookie(ssl)))
    return result


def _verify(ssl: SSL.Connection, certificate: crypto.X509, error: int, depth: int, good: int) -> bool:
    channel: Channel = ssl.get_app_data()
    if not good:
        channel.why = f"its certificate {_VERIFY_ERRORS.get(error, 'was not signed by our authority')}"
        return False
    if depth:
        return True
    try:
        channel.peer = Peer.from_certificate(certificate.to_cryptography())
    except InvalidCertificate as invalid:
        channel.why = str(invalid)
        return False
    if not channel.accepts(channel.peer):
        channel.why = f"{channel.peer} is not expected here"
        return False
    return True


class Channel:
    """State machine of one end of a TLS or DTLS connection; not thread-safe.

    Args:
        accepts: whether to accept a party with a valid certificate.
        address: remote address, for cookies and messages.

    Attributes:
        peer: the remote party, once `established`.
        why: reason for which the peer was rejected.
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
        self._ssl.set_ciphertext_mtu(HANDSHAKE_MTU)
        self._ssl.set_connect_state() if client else self._ssl.set_accept_state()

    def listen(self, hello: bytes) -> bool:
        """Server: process a ClientHello; returns whether it proves its address, else `take` has the answer."""
        self._ssl.bio_write(hello)
        try:
            self._ssl.DTLSv1_listen()
        except SSL.WantReadError:
            return False
        except _SSL_ERRORS as error:
            raise self._error(error) from None
        finally:
            Binding.lib.ERR_clear_error()  # errors left in the queue would be attributed to this thread's next call
        return True

    def handshake(self) -> bool:
        """Continue the handshake; returns whether it is complete.

        Raises:
            TlsError: the handshake failed.
        """
        try:
            self._ssl.do_handshake()
        except SSL.WantReadError:
            return False
        except _SSL_ERRORS as error:
            raise self._error(error) from None
        self.established = True
        return True

    def put(self, data: bytes) -> None:
        """Feed received bytes, or a received datagram."""
        self._ssl.bio_write(data)

    def read(self) -> bytes | None:
        """Next data from the remote end, decrypted; None: there is no more.

        Raises:
            TlsError: the connection broke.
            TlsClosed: the remote end has closed it.
        """
        try:
            return self._ssl.recv(2**14)
        except SSL.WantReadError:
            return None
        except SSL.ZeroReturnError:
            raise TlsClosed from None
        except _SSL_ERRORS as error:
            raise self._error(error) from None

    def write(self, data: bytes) -> None:
        """Encrypt data for the remote end; `take` returns what to send."""
        try:
            while data:  # one record at a time
                data = data[self._ssl.send(data) :]
        except (*_SSL_ERRORS, SSL.WantReadError) as error:
            raise self._error(error) from None

    def take(self) -> bytes:
        """Return all bytes to be sent."""
        parts = []
        try:
            while True:
                parts.append(self._ssl.bio_read(2**14))
        except SSL.WantReadError:
            return b"".join(parts)

    def encrypt_datagram(self, data: bytes) -> bytes:
        """Encrypt one datagram; returns what to send."""
        self.write(data)
        return self._ssl.bio_read(DATAGRAM_MAX_BYTES)

    def retransmit_delay(self) -> float | None:
        """Seconds until lost records of a DTLS handshake must be retransmitted; None: none are pending."""
        return self._ssl.DTLSv1_get_timeout()

    def retransmit(self) -> None:
        """Retransmit lost records of a handshake; `take` returns what to send.

        Raises:
            TlsError: the maximum number of retransmissions is reached.
        """
        try:
            self._ssl.DTLSv1_handle_timeout()
        except _SSL_ERRORS as error:
            raise self._error(error) from None

    def close(self) -> None:
        """Close the connection; `take` returns what to send."""
        try:
            self._ssl.shutdown()
        except (*_SSL_ERRORS, SSL.WantReadError):
            pass

    def negotiated(self) -> dict[str, str]:
        """Negotiated version, cipher, and key exchange group."""
        return {
            "version": self._ssl.get_protocol_version_name(),
            "cipher": self._ssl.get_cipher_name() or "",
            "group": self._ssl.get_group_name() or "",
        }

    def _error(self, error: Any) -> TlsError:
        if self.why:
            return TlsError(self.why)
        ssl_errors = error.args[0] if error.args and isinstance(error.args[0], list) else []
        reasons = ", ".join(str(reason) for _, _, reason in ssl_errors) or "the connection broke"
        return TlsError(reasons)


def datagrams(data: bytes) -> list[bytes]:
    """Pack DTLS records into as few datagrams as possible."""
    result: list[bytes] = []
    while data:
        size = _RECORD_HEADER_BYTES + int.from_bytes(data[11:13], "big")
        record, data = data[:size], data[size:]
        if result and len(result[-1]) + len(record) <= HANDSHAKE_MTU:
            result[-1] += record
        else:
            result.append(record)
    return result
