"""Certificates for tests, of one authority and of others."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from scan2sim.services.teleoperation.gateway.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.gateway.pki import Authority

OWN = Authority.make()
OTHER = Authority.make()


def identity(
    role: Role, name: str = "one", *, authority: Authority = OWN, believes: Authority | None = None, days: float = 1
) -> Identity:
    """A party; one that was expired long ago with negative days."""
    hosts = ("localhost", "127.0.0.1") if role == Role.GATEWAY else ()
    now = datetime.now(UTC) + timedelta(days=min(days, 0) * 2)
    certificate, key = authority.certify(role, name, abs(days), hosts, now)
    return Identity(Peer.of(certificate), certificate, key, (believes or authority).certificate)
