"""The operator's own certificate authority: ECDSA on P-256, one folder for each party.

    DIR/authority/          certificate.pem and key.pem of the authority: must not be copied to a vehicle
    DIR/gateway/            certificate.pem, key.pem, authority.pem: all that a party needs
    DIR/vehicle-NAME/       likewise, and adapter.key, shared with the vehicle adapter
    DIR/station-NAME/       likewise

Whoever has the authority's key can impersonate any party; any other key proves the identity of one party only.
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
from scan2sim.services.teleoperation import adapter_key
from scan2sim.services.teleoperation.adapter_key import ADAPTER_KEY_FILE
from scan2sim.services.teleoperation.gateway_protocol import NAME_PATTERN
from scan2sim.services.teleoperation.identity import (
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    Identity,
    Role,
    host,
    read_certificate,
    read_key,
    uri,
)

AUTHORITY_FOLDER = "authority"
AUTHORITY_YEARS = 10
"""Validity of an authority's certificate."""
CLOCK_SKEW_MAX = timedelta(days=1)
"""Certificates are backdated by this much, since clocks of vehicles may be slow."""
HOST_PATTERN = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,58}[A-Za-z0-9])?")
"""Host name of a gateway; an IP address is accepted as well."""
EXTENDED_KEY_USAGE = {
    Role.GATEWAY: [ExtendedKeyUsageOID.SERVER_AUTH],
    Role.VEHICLE: [ExtendedKeyUsageOID.CLIENT_AUTH],
    Role.STATION: [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH],
}
"""A vehicle connects to gateway and stations; a station connects to the gateway only."""


@dataclass(frozen=True)
class CertifiedParty:
    """Folder of a party.

    Attributes:
        created: whether a certificate was created now; False: the existing one was kept.
        expires: expiry of the certificate.
    """

    folder: Path
    party: str
    created: bool
    expires: datetime


@dataclass(frozen=True)
class Authority:
    """The certificate authority, which signs certificates."""

    certificate: x509.Certificate
    key: EllipticCurvePrivateKey

    @staticmethod
    def make(now: datetime | None = None) -> Authority:
        """Create an authority."""
        key = generate_private_key(SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"scan2sim teleop {secrets.token_hex(4)}")])
        start = now or datetime.now(UTC)
        builder = _builder(name, name, key, start, start + timedelta(days=365 * AUTHORITY_YEARS))
        usage = _usage(sign=False)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        return Authority(builder.add_extension(usage, critical=True).sign(key, hashes.SHA256()), key)

    @staticmethod
    def read(folder: Path) -> Authority:
        """Read an authority's folder; raises InputError."""
        return Authority(read_certificate(folder / CERTIFICATE_FILE), read_key(folder / KEY_FILE))

    def certify(
        self, role: Role, name: str, days: float, hosts: Sequence[str] = (), now: datetime | None = None
    ) -> tuple[x509.Certificate, EllipticCurvePrivateKey]:
        """Create a party's certificate with a new key.

        Args:
            days: validity of the certificate.
            hosts: host names and addresses of a gateway.
        """
        key = generate_private_key(SECP256R1())
        start = now or datetime.now(UTC)
        end = min(start + timedelta(days=days), self.certificate.not_valid_after_utc)
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"{role} {name}"[:64])])
        builder = _builder(subject, self.certificate.subject, key, start, end)
        names = x509.SubjectAlternativeName([uri(role, name), *(host(one) for one in hosts)])
        issuer_key = x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key())
        for extension, critical in (
            (x509.BasicConstraints(ca=False, path_length=None), True),
            (_usage(sign=True), True),
            (x509.ExtendedKeyUsage(EXTENDED_KEY_USAGE[role]), False),
            (names, False),
            (issuer_key, False),
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
) -> list[CertifiedParty]:
    """Create certificates of parties, each in its own folder; an authority is created where there is none.

    A certificate that is valid for longer than a third of `days` is kept; else it is replaced, with a new key.

    Args:
        gateway: host names and addresses of the gateway.
        renew: replace the certificates of all named parties.

    Raises:
        SettingError: a name is not valid.
        InputError: the authority's files are damaged, or its certificate has expired.
        SpaceError: the folder can't be written to.
    """
    for option, names, is_valid in (
        ("--gateway", gateway, lambda name: HOST_PATTERN.fullmatch(name) or isinstance(host(name), x509.IPAddress)),
        ("--vehicle", vehicles, NAME_PATTERN.fullmatch),
        ("--station", stations, NAME_PATTERN.fullmatch),
    ):
        for wrong in (name for name in names if not is_valid(name)):
            raise SettingError(
                option, f"{wrong!r} is not a valid name", "Use letters, digits, dots, hyphens; at most 60"
            )
    try:
        authority = _authority(folder / AUTHORITY_FOLDER)
        wanted = [(Role.GATEWAY, gateway[0], tuple(gateway))] if gateway else []
        wanted += [(Role.VEHICLE, name, ()) for name in vehicles] + [(Role.STATION, name, ()) for name in stations]
        return [_keep_or_renew(folder, authority, role, name, hosts, days, renew) for role, name, hosts in wanted]
    except OSError as error:
        raise from_os_error(error, folder) from error


def write(folder: Path, certificate: x509.Certificate, key: EllipticCurvePrivateKey) -> None:
    """Write a certificate and its key; only its user can read the key."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    for name, data, mode in ((KEY_FILE, pem, 0o600), (CERTIFICATE_FILE, certificate.public_bytes(Encoding.PEM), 0o644)):
        temporary = folder / f".{name}.{secrets.token_hex(4)}"
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
        temporary.replace(folder / name)


def _authority(folder: Path) -> Authority:
    if not (folder / CERTIFICATE_FILE).exists() and not (folder / KEY_FILE).exists():
        made = Authority.make()
        write(folder, made.certificate, made.key)
    authority = Authority.read(folder)
    if authority.certificate.public_key() != authority.key.public_key():
        raise InputError(folder / CERTIFICATE_FILE, f"doesn't match {folder / KEY_FILE}", "Restore both from a backup")
    if authority.certificate.not_valid_after_utc <= datetime.now(UTC):
        remedy = "Create a new authority in an empty folder, and give all parties new certificates"
        raise InputError(folder / CERTIFICATE_FILE, "has expired", remedy)
    return authority


def _keep_or_renew(
    folder: Path, authority: Authority, role: Role, name: str, hosts: tuple[str, ...], days: float, renew: bool
) -> CertifiedParty:
    """Keep a party's certificate, or replace it."""
    party_folder = folder / (role if role == Role.GATEWAY else f"{role}-{name}")
    existing = None if renew else _read_existing(party_folder, authority)
    if role == Role.VEHICLE:
        party_folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        adapter_key.create(party_folder / ADAPTER_KEY_FILE)
    unchanged = existing is not None and (existing.me.name, set(existing.me.hosts)) == (name, set(hosts))
    if existing is not None and unchanged and existing.remaining() > timedelta(days=days) / 3:
        return CertifiedParty(party_folder, str(existing.me), False, existing.me.expires)
    certificate, key = authority.certify(role, name, days, hosts)
    write(party_folder, certificate, key)
    (party_folder / AUTHORITY_FILE).write_bytes(authority.certificate.public_bytes(Encoding.PEM))
    return CertifiedParty(party_folder, f"{role} {name}", True, certificate.not_valid_after_utc)


def _read_existing(party_folder: Path, authority: Authority) -> Identity | None:
    """Identity of a party, if it is valid and of this authority."""
    try:
        identity = Identity.read(party_folder)
    except InputError:
        return None
    return identity if identity.authority == authority.certificate else None


def _builder(
    subject: x509.Name, issuer: x509.Name, key: EllipticCurvePrivateKey, start: datetime, end: datetime
) -> x509.CertificateBuilder:
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key.public_key())
    builder = (
        builder.serial_number(x509.random_serial_number()).not_valid_before(start - CLOCK_SKEW_MAX).not_valid_after(end)
    )
    return builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)


def _usage(*, sign: bool) -> x509.KeyUsage:
    """Key usage: a party signs handshakes, the authority certificates."""
    return x509.KeyUsage(
        digital_signature=sign, key_cert_sign=not sign, crl_sign=not sign, content_commitment=False,
        key_encipherment=False, data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip
