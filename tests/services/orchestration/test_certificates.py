"""OSM's certificate, self-signed, expired and without a host name as it is shipped, is trusted by its fingerprint."""

from __future__ import annotations

import datetime
import hashlib
import ssl
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from scan2sim.pipeline.core.errors import InputError, SettingError, UnavailableError
from scan2sim.services.orchestration import certificates
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.settings import Connection
from tests.fakes.osm import FakeOsm, OsmState


def shipped(folder: Path) -> tuple[ssl.SSLContext, str]:
    """A server's TLS context with an expired certificate without subjectAltName, and the certificate's fingerprint."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "nbi")])
    begin = datetime.datetime(2020, 6, 3, tzinfo=datetime.UTC)
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.not_valid_before(begin).not_valid_after(begin + datetime.timedelta(days=1000)).serial_number(1)
    certificate = builder.sign(key, hashes.SHA256())
    path = folder / "nbi.pem"
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    path.write_bytes(secret + certificate.public_bytes(serialization.Encoding.PEM))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(path)
    return context, hashlib.sha256(certificate.public_bytes(serialization.Encoding.DER)).hexdigest()


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[FakeOsm, str]]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    context, fingerprint = shipped(tmp_path)
    with FakeOsm(OsmState(), tls=context) as fake:
        yield fake, fingerprint


def notation(fingerprint: str) -> str:
    return ":".join(fingerprint[i : i + 2] for i in range(0, 64, 2)).upper()


def test_a_fingerprint_is_shown_given_once_and_stored(served: tuple[FakeOsm, str]) -> None:
    fake, fingerprint = served
    with Osm(Connection(osm=fake.address)) as osm, pytest.raises(UnavailableError, match="isn't trusted") as caught:
        osm.instances()
    assert notation(fingerprint) in caught.value.cause
    assert f"--fingerprint {notation(fingerprint)}" in caught.value.remedy and "openssl x509" in caught.value.remedy
    assert not certificates.known_file().exists() and fake.state.requests == []
    for given in (notation(fingerprint), ""):  # later it isn't needed
        with Osm(Connection(osm=fake.address, fingerprint=given)) as osm:
            assert osm.instances() == []
    assert certificates.known(fake.address) == fingerprint


def test_another_certificate_is_refused_before_the_password_is_sent(served: tuple[FakeOsm, str]) -> None:
    fake, fingerprint = served
    certificates.remember(fake.address, "00" * 32)
    with Osm(Connection(osm=fake.address)) as osm, pytest.raises(UnavailableError, match="isn't the trusted") as caught:
        osm.instances()
    assert notation(fingerprint) in caught.value.cause and "intercept" in caught.value.remedy
    assert fake.state.requests == [] and certificates.known(fake.address) == "00" * 32
    with Osm(Connection(osm=fake.address, fingerprint=fingerprint)) as osm:
        assert osm.instances() == []
    assert certificates.known(fake.address) == fingerprint


def test_usual_notations_of_fingerprints_are_read(served: tuple[FakeOsm, str]) -> None:
    _, digits = served
    for text in (digits, notation(digits), f"sha256 Fingerprint={notation(digits)}", f"SHA256:{digits.upper()}"):
        assert certificates.parse(text) == digits
    for text in ("", "abc", digits[:-2], digits[:-1] + "g"):
        with pytest.raises(SettingError, match="fingerprint"):
            certificates.parse(text)
    with pytest.raises(SettingError, match="--ca"):
        Connection(osm="https://x", fingerprint=digits, ca=Path("ca.pem")).ssl_context()


def test_an_unreadable_file_of_fingerprints_is_named(served: tuple[FakeOsm, str]) -> None:
    certificates.known_file().mkdir(parents=True)
    with pytest.raises(InputError, match="known_osm"):
        Osm(Connection(osm=served[0].address))
