"""Connections to a broker that demands TLS with client certificates and SASL, by a file of librdkafka's options."""

from __future__ import annotations

import base64
import json
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services import kafka
from scan2sim.services.outbox import OutboxRecord
from tests.fakes.broker import Broker
from tests.fakes.kafka_proxy import SecureProxy, oauthbearer, plain, scram
from tests.fakes.ports import free_port

OPTIONS = """# as a company's administrators hand it out
security.protocol=SASL_SSL
ssl.ca.location={folder}/ca.pem
ssl.certificate.location={folder}/client.pem
ssl.key.location={folder}/client.key
sasl.mechanisms={mechanism}
sasl.username=robot
sasl.password={password}
"""
OIDC = """security.protocol=SASL_SSL
ssl.ca.location={folder}/ca.pem
ssl.certificate.location={folder}/client.pem
ssl.key.location={folder}/client.key
sasl.mechanisms=OAUTHBEARER
sasl.oauthbearer.method=oidc
sasl.oauthbearer.client.id=robot
sasl.oauthbearer.client.secret={secret}
sasl.oauthbearer.token.endpoint.url={url}
"""
USER, PASSWORD = "robot", "secret=#1"
MECHANISMS = ("PLAIN", "SCRAM-SHA-256", "SCRAM-SHA-512")


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    """Folder with an authority, and certificates of a server and a client."""
    now, authority_key = datetime.now(UTC), ec.generate_private_key(ec.SECP256R1())
    authority = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "authority")])
    for name in ("ca", "server", "client"):
        key = authority_key if name == "ca" else ec.generate_private_key(ec.SECP256R1())
        subject = authority if name == "ca" else x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        certificate = (
            x509.CertificateBuilder(authority, subject, key.public_key(), x509.random_serial_number())
            .not_valid_before(now - timedelta(days=1))
            .not_valid_after(now + timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=name == "ca", path_length=None), critical=True)
            .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
            .sign(authority_key, hashes.SHA256())
        )
        (tmp_path / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        private = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        (tmp_path / f"{name}.key").write_bytes(key.private_bytes(serialization.Encoding.PEM, *private))
    return tmp_path


def a_token() -> str:
    """A JSON Web Token that is valid for an hour; nothing here verifies its signature."""
    now = int(time.time())
    parts = {"alg": "HS256", "typ": "JWT"}, {"sub": USER, "iat": now, "exp": now + 3600}
    coded = [base64.urlsafe_b64encode(json.dumps(part).encode()).rstrip(b"=").decode() for part in parts]
    return ".".join([*coded, "c2lnbmF0dXJl"])


class Issuer(BaseHTTPRequestHandler):
    """Token endpoint of an identity provider (OAuth 2.0, client credentials)."""

    issued: ClassVar[set[str]] = set()

    def do_POST(self) -> None:
        """Issue a token."""
        given = base64.b64decode(self.headers["Authorization"].removeprefix("Basic "))
        granted, token = given == f"{USER}:{PASSWORD}".encode(), a_token()
        if granted:
            self.issued.add(token)
        answer = {"access_token": token, "token_type": "Bearer", "expires_in": 3600}
        body = json.dumps(answer if granted else {"error": "invalid_client"})
        self.send_response(200 if granted else 401)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body.encode())

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


@pytest.fixture
def issuer() -> Iterator[str]:
    """Address of an identity provider's token endpoint."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Issuer)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/token"
    server.shutdown()
    server.server_close()


@pytest.fixture
def secured(certificates: Path) -> Iterator[str]:
    """Address of a broker behind a proxy that demands a certificate, and a user and password or a token."""
    broker, port = Broker(), free_port()
    broker.advertised = f"localhost:{port}"
    broker.start()
    mechanisms = {
        "PLAIN": lambda: plain(USER, PASSWORD),
        "SCRAM-SHA-256": lambda: scram("SCRAM-SHA-256", USER, PASSWORD),
        "SCRAM-SHA-512": lambda: scram("SCRAM-SHA-512", USER, PASSWORD),
        "OAUTHBEARER": lambda: oauthbearer(Issuer.issued.__contains__),
    }
    proxy = SecureProxy(port, int(broker.servers.rpartition(":")[2]), certificates, mechanisms)
    yield broker.advertised
    proxy.close()
    broker.kill()


def _cluster(folder: Path, servers: str, text: str) -> kafka.Cluster:
    (folder / "client.properties").write_text(text, encoding="utf-8")
    return kafka.Cluster.read(servers, folder / "client.properties")


def _send(cluster: kafka.Cluster) -> None:
    kafka.TopicProducer(cluster, "records").send([OutboxRecord(1, "a:1", b"body")])


@pytest.mark.parametrize("mechanism", MECHANISMS)
def test_records_pass_a_broker_with_tls_and_sasl(mechanism: str, certificates: Path, secured: str) -> None:
    text = OPTIONS.format(folder=certificates, password=PASSWORD, mechanism=mechanism)
    cluster = _cluster(certificates, secured, text)
    _send(cluster)
    bodies = kafka.read(cluster, "records", group="test", from_start=True)
    assert next(body for body in bodies if body) == b"body"


def test_options_by_the_environment(certificates: Path, secured: str, monkeypatch: pytest.MonkeyPatch) -> None:
    _cluster(certificates, secured, OPTIONS.format(folder=certificates, password=PASSWORD, mechanism="PLAIN"))
    monkeypatch.setenv(kafka.CONFIG_VARIABLE, str(certificates / "client.properties"))
    _send(kafka.Cluster.read(secured, None))


@pytest.mark.parametrize("mechanism", MECHANISMS)
def test_refused_password_is_reported(
    mechanism: str, certificates: Path, secured: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kafka, "ACKNOWLEDGE_TIMEOUT_S", 5.0)
    text = OPTIONS.format(folder=certificates, password="guess", mechanism=mechanism)
    with pytest.raises(ConnectionError, match="wrong user or password") as caught:
        _send(_cluster(certificates, secured, text))
    assert "guess" not in str(caught.value)


def test_tokens_of_an_identity_provider(certificates: Path, secured: str, issuer: str) -> None:
    cluster = _cluster(certificates, secured, OIDC.format(folder=certificates, secret=PASSWORD, url=issuer))
    _send(cluster)
    bodies = kafka.read(cluster, "records", group="test", from_start=True)
    assert next(body for body in bodies if body) == b"body"


def test_refused_token_is_reported(
    certificates: Path, secured: str, issuer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kafka, "ACKNOWLEDGE_TIMEOUT_S", 5.0)
    with pytest.raises(ConnectionError, match="token endpoint answers .*invalid_client") as caught:
        _send(_cluster(certificates, secured, OIDC.format(folder=certificates, secret="guess", url=issuer)))
    assert "guess" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("security.protocol SSL\n", "line 1 isn't KEY=VALUE"),
        ("# TLS\n\nsecurity.protcol=SSL\n", 'No such configuration property: "security.protcol"'),
        ("security.protocol=TLS\n", 'Invalid value "TLS" for configuration property "security.protocol"'),
        ("sasl.jaas.config=x\n", "Java JAAS configuration is not supported"),
    ],
)
def test_invalid_options_name_the_file(text: str, cause: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        kafka.TopicProducer(_cluster(tmp_path, "localhost:1", text), "records")
    assert cause in caught.value.cause and str(caught.value.where).endswith("client.properties")
