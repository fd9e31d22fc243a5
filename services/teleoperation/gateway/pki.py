"""The operator's own certificate authority: ECDSA on P-256, a folder for each party.

    DIR/authority/          certificate.pem and key.pem of the authority: belongs on no vehicle
    DIR/gateway/            certificate.pem, key.pem, authority.pem: what a party needs
    DIR/vehicle-NAME/       likewise
    DIR/station-NAME/       likewise

Whoever has the authority's key can be anybody; every other key proves one party alone.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, EllipticCurvePrivateKey, generate_private_key
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from scan2sim.pipeline.core.errors import InputError, SettingError, from_os_error
from scan2sim.services.teleoperation.gateway.identity import (
    AUTHORITY,
    CERTIFICATE,
    KEY,
    NAME,
    Identity,
    Role,
    host,
    read_certificate,
    read_key,
    uri,
)

FOLDER = "authority"
YEARS = 10
"""That an authority is valid."""
BEFORE = timedelta(days=1)
"""Certificates are valid from so long ago on: clocks of vehicles may be behind."""
HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,58}[A-Za-z0-9])?")
"""Name of a gateway's machine; it may be an address, too."""
USAGE = {
    Role.GATEWAY: [ExtendedKeyUsageOID.SERVER_AUTH],
    Role.VEHICLE: [ExtendedKeyUsageOID.CLIENT_AUTH],
    Role.STATION: [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH],
}
"""A vehicle dials gateway and stations, a station the gateway alone."""


@dataclass(frozen=True)
class Certified:
    """A party's folder: whether its certificate was made now, and until when it holds."""

    folder: Path
    party: str
    made: bool
    expires: datetime


@dataclass(frozen=True)
class Authority:
    """Signs certificates."""

    certificate: x509.Certificate
    key: EllipticCurvePrivateKey

    @staticmethod
    def make(now: datetime | None = None) -> Authority:
        """A new one."""
        key = generate_private_key(SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"scan2sim teleop {secrets.token_hex(4)}")])
        start = now or datetime.now(UTC)
        builder = _builder(name, name, key, start, start + timedelta(days=365 * YEARS))
        usage = _usage(sign=False)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        return Authority(builder.add_extension(usage, critical=True).sign(key, hashes.SHA256()), key)

    @staticmethod
    def read(folder: Path) -> Authority:
        """As it was written; raises InputError."""
        return Authority(read_certificate(folder / CERTIFICATE), read_key(folder / KEY))

    def certify(
        self, role: Role, name: str, days: float, hosts: Sequence[str] = (), now: datetime | None = None
    ) -> tuple[x509.Certificate, EllipticCurvePrivateKey]:
        """A party's certificate with a new key.

        Args:
            days: that it is valid.
            hosts: names and addresses that a gateway is reached by.
        """
        key = generate_private_key(SECP256R1())
        start = now or datetime.now(UTC)
        end = min(start + timedelta(days=days), self.certificate.not_valid_after_utc)
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"{role} {name}"[:64])])
        builder = _builder(subject, self.certificate.subject, key, start, end)
        names = x509.SubjectAlternativeName([uri(role, name), *(host(one) for one in hosts)])
        above = x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key())
        for extension, critical in (
            (x509.BasicConstraints(ca=False, path_length=None), True),
            (_usage(sign=True), True),
            (x509.ExtendedKeyUsage(USAGE[role]), False),
            (names, False),
            (above, False),
        ):
            builder = builder.add_extension(extension, critical=critical)
        return builder.sign(self.key, hashes.SHA256()), key


def certify(
    folder: Path,
    gateway: Sequence[str] = (),
    vehicles: Sequence[str] = (),
    stations: Sequence[str] = (),
    days: float = 365,
    renew: bool = False,
) -> list[Certified]:
    """Certificates of parties, each in a folder of its own; the authority is made where there is none.

    What is there and holds for longer than a third of `days` stays as it is; else it gets a new key and certificate.

    Args:
        gateway: names and addresses that the gateway is reached by.
        renew: whatever is named is made anew.

    Raises:
        SettingError: a name that can't be one.
        InputError: the authority's files are damaged, or it has expired.
        SpaceError: the folder can't be written to.
    """
    for option, names, fits in (
        ("--gateway", gateway, lambda name: HOST.fullmatch(name) or isinstance(host(name), x509.IPAddress)),
        ("--vehicle", vehicles, NAME.fullmatch),
        ("--station", stations, NAME.fullmatch),
    ):
        for wrong in (name for name in names if not fits(name)):
            raise SettingError(option, f"{wrong!r} can't be its name", "Letters, digits, dots and hyphens, 60 at most")
    try:
        authority = _authority(folder / FOLDER)
        wanted = [(Role.GATEWAY, gateway[0], tuple(gateway))] if gateway else []
        wanted += [(Role.VEHICLE, name, ()) for name in vehicles] + [(Role.STATION, name, ()) for name in stations]
        return [_kept(folder, authority, role, name, hosts, days, renew) for role, name, hosts in wanted]
    except OSError as error:
        raise from_os_error(error, folder) from error


def write(folder: Path, certificate: x509.Certificate, key: EllipticCurvePrivateKey) -> None:
    """A certificate and its key, which is its user's alone."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    for name, data, mode in ((KEY, pem, 0o600), (CERTIFICATE, certificate.public_bytes(Encoding.PEM), 0o644)):
        beside = folder / f".{name}.{secrets.token_hex(4)}"
        with os.fdopen(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
        beside.replace(folder / name)


def _authority(folder: Path) -> Authority:
    if not (folder / CERTIFICATE).exists() and not (folder / KEY).exists():
        made = Authority.make()
        write(folder, made.certificate, made.key)
    authority = Authority.read(folder)
    if authority.certificate.public_key() != authority.key.public_key():
        raise InputError(folder / CERTIFICATE, f"doesn't belong to {folder / KEY}", "Restore both from a copy")
    if authority.certificate.not_valid_after_utc <= datetime.now(UTC):
        remedy = "Make a new one in an empty folder, and give all parties new certificates"
        raise InputError(folder / CERTIFICATE, "has expired", remedy)
    return authority


def _kept(
    folder: Path, authority: Authority, role: Role, name: str, hosts: tuple[str, ...], days: float, renew: bool
) -> Certified:
    """A party's folder, as it is or made anew."""
    place = folder / (role if role == Role.GATEWAY else f"{role}-{name}")
    there = None if renew else _there(place, authority)
    fits = there is not None and (there.me.name, set(there.me.hosts)) == (name, set(hosts))
    if there is not None and fits and there.left() > timedelta(days=days) / 3:
        return Certified(place, str(there.me), False, there.me.expires)
    certificate, key = authority.certify(role, name, days, hosts)
    write(place, certificate, key)
    (place / AUTHORITY).write_bytes(authority.certificate.public_bytes(Encoding.PEM))
    return Certified(place, f"{role} {name}", True, certificate.not_valid_after_utc)


def _there(place: Path, authority: Authority) -> Identity | None:
    """What a party has of this authority, if it can be used."""
    try:
        found = Identity.read(place)
    except InputError:
        return None
    return found if found.authority == authority.certificate else None


def _builder(
    subject: x509.Name, issuer: x509.Name, key: EllipticCurvePrivateKey, start: datetime, end: datetime
) -> x509.CertificateBuilder:
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number()).not_valid_before(start - BEFORE).not_valid_after(end)
    return builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)


def _usage(*, sign: bool) -> x509.KeyUsage:
    """A party signs handshakes, the authority certificates."""
    return x509.KeyUsage(
        digital_signature=sign, key_cert_sign=not sign, crl_sign=not sign, content_commitment=False,
        key_encipherment=False, data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip
