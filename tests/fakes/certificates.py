"""Certificates for tests, issued by one authority and by others."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from scan2sim.services.teleoperation.gateway.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.gateway.pki import Authority

OWN = Authority.make()
OTHER = Authority.make()


def identity(
    role: Role, name: str = "one", *, authority: Authority = OWN, trusts: Authority | None = None, days: float = 1
) -> Identity:
    """Identity of a party; negative days create an expired certificate."""
    hosts = ("localhost", "127.0.0.1") if role == Role.GATEWAY else ()
    now = datetime.now(UTC) + timedelta(days=min(days, 0) * 2)
    certificate, key = authority.certify(role, name, abs(days), hosts, now)
    return Identity(Peer.from_certificate(certificate), certificate, key, (trusts or authority).certificate)
