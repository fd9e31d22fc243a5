"""Which addresses only this machine reaches; what listens on any other must be protected."""

from __future__ import annotations

import contextlib
import ipaddress

from scan2sim.pipeline.core.errors import SettingError


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address: 127.0.0.0/8, ::1 or localhost.

    0.0.0.0, :: and an empty one are all addresses of this machine, and other names may lead anywhere.
    """
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    return host.lower() == "localhost"


def require_protection(host: str, *, protected: bool, options: str) -> None:
    """Refuse to listen where other machines reach it and nothing protects it.

    Args:
        host: address to listen on.
        protected: whether a token, a key or a certificate is given.
        options: which give one, as "--token FILE".

    Raises:
        SettingError: `host` is beyond the loopback and unprotected.
    """
    if not protected and not is_loopback(host):
        cause = f"{host or 'an empty address'} is reached by other machines, and nothing protects it"
        raise SettingError("--host", cause, f"Give {options}, or listen on this machine alone: --host 127.0.0.1")
