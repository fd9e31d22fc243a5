"""Identities of parties: certificates with role and name, signed by the operator's own authority.

A party's folder holds `certificate.pem`, `key.pem` (readable by its user only) and `authority.pem`; `pki` creates it.
The certificate contains role and name as the URI `urn:scan2sim:ROLE:NAME`.
"""

from __future__ import annotations

import ipaddress
import stat
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey, EllipticCurvePublicKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from scan2sim.pipeline.core.errors import InputError

CERTIFICATE_FILE, KEY_FILE, AUTHORITY_FILE = "certificate.pem", "key.pem", "authority.pem"
NO_EXPIRY = datetime.max.replace(tzinfo=UTC)
_URN = "urn:scan2sim:"
_RENEW_REMEDY = "Create it again: `scan2sim teleop certificates` (docs/teleoperation.md)"


class Role(StrEnum):
    """Role of a party."""

    GATEWAY = "gateway"
    VEHICLE = "vehicle"
    STATION = "station"


class InvalidCertificate(ValueError):
    """A certificate without role and name, or whose key isn't an elliptic curve key."""


@dataclass(frozen=True)
class Peer:
    """A party, identified by its certificate.

    Attributes:
        fingerprint: SHA-256 of the certificate, hexadecimal.
        hosts: host names and addresses of a gateway.
        expires: expiry of the certificate.
    """

    role: Role
    name: str
    fingerprint: str
    hosts: tuple[str, ...] = field(default=(), compare=False)
    expires: datetime = field(default=NO_EXPIRY, compare=False)

    def __str__(self) -> str:
        return f"{self.role} {self.name}"

    @staticmethod
    def from_certificate(certificate: x509.Certificate) -> Peer:
        """The party of a certificate, whose signature and dates TLS has verified.

        Raises:
            InvalidCertificate: it has no role and name, or several, or its key isn't an ECDSA key.
        """
        if not isinstance(certificate.public_key(), EllipticCurvePublicKey):
            raise InvalidCertificate("its key is not an ECDSA key")
        try:
            names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except (x509.ExtensionNotFound, x509.DuplicateExtension, ValueError):
            raise InvalidCertificate("it contains no role and name") from None
        uris = [uri for uri in names.get_values_for_type(x509.UniformResourceIdentifier) if uri.startswith(_URN)]
        role, _, name = uris[0].removeprefix(_URN).partition(":") if len(uris) == 1 else ("", "", "")
        if role not in list(Role) or not name:
            raise InvalidCertificate("it contains no role and name")
        hosts = (
            *names.get_values_for_type(x509.DNSName),
            *(str(one) for one in names.get_values_for_type(x509.IPAddress)),
        )
        fingerprint = certificate.fingerprint(hashes.SHA256()).hex()
        return Peer(Role(role), name, fingerprint, tuple(hosts), certificate.not_valid_after_utc)


def uri(role: Role, name: str) -> x509.UniformResourceIdentifier:
    """URI of a party in its certificate."""
    return x509.UniformResourceIdentifier(f"{_URN}{role}:{name}")


def host(name: str) -> x509.GeneralName:
    """Host name or IP address as a certificate's general name."""
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


@dataclass(frozen=True)
class Identity:
    """A party's own certificate and key, and the authority that it trusts.

    Attributes:
        me: the party itself.
    """

    me: Peer
    certificate: x509.Certificate
    key: EllipticCurvePrivateKey
    authority: x509.Certificate

    @staticmethod
    def read(folder: Path, role: Role | None = None) -> Identity:
        """Read a party's folder.

        Args:
            role: required role; None: any.

        Raises:
            InputError: a file is missing, unreadable, expired, readable by others, of another role, or doesn't match.
        """
        certificate, authority = read_certificate(folder / CERTIFICATE_FILE), read_certificate(folder / AUTHORITY_FILE)
        key = read_key(folder / KEY_FILE)
        path = folder / CERTIFICATE_FILE
        try:
            me = Peer.from_certificate(certificate)
            certificate.verify_directly_issued_by(authority)
        except InvalidCertificate as error:
            raise InputError(path, str(error), _RENEW_REMEDY) from None
        except Exception:  # any exception of the cryptography package
            raise InputError(path, f"was not signed by {folder / AUTHORITY_FILE}", _RENEW_REMEDY) from None
        if certificate.public_key() != key.public_key():
            raise InputError(path, f"doesn't match {folder / KEY_FILE}", _RENEW_REMEDY)
        if role is not None and me.role != role:
            raise InputError(path, f"belongs to a {me.role}, not to a {role}", f"Give the folder of a {role}")
        now = datetime.now(UTC)
        if not certificate.not_valid_before_utc <= now < me.expires:
            dates = f"{certificate.not_valid_before_utc:%Y-%m-%d %H:%M} to {me.expires:%Y-%m-%d %H:%M} UTC"
            raise InputError(
                path, f"is valid only from {dates}", f"Set this machine's clock, or renew. {_RENEW_REMEDY}"
            )
        return Identity(me, certificate, key, authority)

    def remaining(self) -> timedelta:
        """Remaining validity of the certificate."""
        return self.me.expires - datetime.now(UTC)


def read_certificate(path: Path) -> x509.Certificate:
    """Read a certificate from a PEM file.

    Raises:
        InputError: the file contains none.
    """
    try:
        return x509.load_pem_x509_certificate(_read(path))
    except ValueError as error:
        raise InputError(path, f"is not a certificate ({error})", _RENEW_REMEDY) from None


def read_key(path: Path) -> EllipticCurvePrivateKey:
    """Read a private key from a PEM file that only its user can read.

    Raises:
        InputError: the file isn't one, or others may read it.
    """
    data = _read(path)
    if (mode := stat.S_IMODE(path.stat().st_mode)) & 0o077:
        raise InputError(path, f"is accessible to other users (mode {mode:o})", f"chmod 600 {path}")
    try:
        key = load_pem_private_key(data, None)
    except (ValueError, TypeError) as error:
        raise InputError(path, f"is not a private key ({error})", _RENEW_REMEDY) from None
    if not isinstance(key, EllipticCurvePrivateKey):
        raise InputError(path, "is not an ECDSA key", _RENEW_REMEDY)
    return key


def _read(path: Path) -> bytes:
    if not path.is_file():
        raise InputError(
            path, "file not found", f"The authority creates it: {_RENEW_REMEDY[0].lower()}{_RENEW_REMEDY[1:]}"
        )
    try:
        with path.open("rb") as file:
            return file.read(2**16)
    except OSError as error:
        raise InputError(path, str(error.strerror), "Run this as the user who owns the file") from None
