"""Who takes part, and what proves it: a certificate that says role and name, from the operator's own authority.

A party's folder holds `certificate.pem`, `key.pem` (readable by its user alone) and `authority.pem`; `authority` makes
it. Role and name stand in the certificate as the URI `urn:scan2sim:ROLE:NAME`.
"""

from __future__ import annotations

import ipaddress
import re
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

CERTIFICATE, KEY, AUTHORITY = "certificate.pem", "key.pem", "authority.pem"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,59}")
"""Of a vehicle or station: it becomes part of paths, pages and logs."""
NEVER = datetime.max.replace(tzinfo=UTC)
_URN = "urn:scan2sim:"
_AGAIN = "Make it anew: `scan2sim teleop certificates` (docs/teleoperation.md)"


class Role(StrEnum):
    """What a party is."""

    GATEWAY = "gateway"
    VEHICLE = "vehicle"
    STATION = "station"


class Stranger(ValueError):
    """A certificate that says no role and name, or isn't for elliptic curves."""


@dataclass(frozen=True)
class Peer:
    """A party, as its certificate tells.

    Attributes:
        fingerprint: SHA-256 of the certificate, in hexadecimal digits.
        hosts: names and addresses that a gateway is reached by.
        expires: when the certificate does.
    """

    role: Role
    name: str
    fingerprint: str
    hosts: tuple[str, ...] = field(default=(), compare=False)
    expires: datetime = field(default=NEVER, compare=False)

    def __str__(self) -> str:
        return f"{self.role} {self.name}"

    @staticmethod
    def of(certificate: x509.Certificate) -> Peer:
        """Of a certificate, whose signature and dates TLS has checked.

        Raises:
            Stranger: it tells no role and name, or more than one, or its key isn't one for ECDSA.
        """
        if not isinstance(certificate.public_key(), EllipticCurvePublicKey):
            raise Stranger("its key is none for ECDSA")
        try:
            names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except (x509.ExtensionNotFound, x509.DuplicateExtension, ValueError):
            raise Stranger("it says no role and name") from None
        uris = [uri for uri in names.get_values_for_type(x509.UniformResourceIdentifier) if uri.startswith(_URN)]
        role, _, name = uris[0].removeprefix(_URN).partition(":") if len(uris) == 1 else ("", "", "")
        if role not in list(Role) or not name:
            raise Stranger("it says no role and name")
        hosts = (
            *names.get_values_for_type(x509.DNSName),
            *(str(one) for one in names.get_values_for_type(x509.IPAddress)),
        )
        print_ = certificate.fingerprint(hashes.SHA256()).hex()
        return Peer(Role(role), name, print_, tuple(hosts), certificate.not_valid_after_utc)


def uri(role: Role, name: str) -> x509.UniformResourceIdentifier:
    """What stands in a party's certificate."""
    return x509.UniformResourceIdentifier(f"{_URN}{role}:{name}")


def host(name: str) -> x509.GeneralName:
    """A host's name or address as certificates have it."""
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


@dataclass(frozen=True)
class Identity:
    """A party's own certificate and key, and the authority that it believes.

    Attributes:
        me: who it says that it is.
    """

    me: Peer
    certificate: x509.Certificate
    key: EllipticCurvePrivateKey
    authority: x509.Certificate

    @staticmethod
    def read(folder: Path, role: Role | None = None) -> Identity:
        """Of a party's folder.

        Args:
            role: that it must have; None: any.

        Raises:
            InputError: a file is missing, unreadable, expired, open to others, of another role, or doesn't fit.
        """
        certificate, authority = read_certificate(folder / CERTIFICATE), read_certificate(folder / AUTHORITY)
        key = read_key(folder / KEY)
        where = folder / CERTIFICATE
        try:
            me = Peer.of(certificate)
            certificate.verify_directly_issued_by(authority)
        except Stranger as error:
            raise InputError(where, str(error), _AGAIN) from None
        except Exception:  # whichever of cryptography's
            raise InputError(where, f"isn't signed by {folder / AUTHORITY}", _AGAIN) from None
        if certificate.public_key() != key.public_key():
            raise InputError(where, f"doesn't belong to {folder / KEY}", _AGAIN)
        if role is not None and me.role != role:
            raise InputError(where, f"is a {me.role}'s, not a {role}'s", f"Name the folder of a {role}")
        now = datetime.now(UTC)
        if not certificate.not_valid_before_utc <= now < me.expires:
            dates = f"{certificate.not_valid_before_utc:%Y-%m-%d %H:%M} to {me.expires:%Y-%m-%d %H:%M} UTC"
            raise InputError(where, f"is valid from {dates} alone", f"Set this machine's clock, or renew. {_AGAIN}")
        return Identity(me, certificate, key, authority)

    def left(self) -> timedelta:
        """How long the certificate is still valid."""
        return self.me.expires - datetime.now(UTC)


def read_certificate(path: Path) -> x509.Certificate:
    """Of a PEM file.

    Raises:
        InputError: it holds none.
    """
    try:
        return x509.load_pem_x509_certificate(_read(path))
    except ValueError as error:
        raise InputError(path, f"is no certificate ({error})", _AGAIN) from None


def read_key(path: Path) -> EllipticCurvePrivateKey:
    """Of a PEM file that only its user can read.

    Raises:
        InputError: it isn't one, or others may read it.
    """
    data = _read(path)
    if (mode := stat.S_IMODE(path.stat().st_mode)) & 0o077:
        raise InputError(path, f"is open to other users (mode {mode:o})", f"chmod 600 {path}")
    try:
        key = load_pem_private_key(data, None)
    except (ValueError, TypeError) as error:
        raise InputError(path, f"is no key ({error})", _AGAIN) from None
    if not isinstance(key, EllipticCurvePrivateKey):
        raise InputError(path, "is no key for ECDSA", _AGAIN)
    return key


def _read(path: Path) -> bytes:
    if not path.is_file():
        raise InputError(path, "isn't there", f"It comes from the authority: {_AGAIN[0].lower()}{_AGAIN[1:]}")
    try:
        with path.open("rb") as file:
            return file.read(2**16)
    except OSError as error:
        raise InputError(path, str(error.strerror), "Check that its user is the one who runs this") from None
