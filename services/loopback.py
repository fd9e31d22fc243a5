"""Loopback addresses: a server that listens on any other address must be protected."""

from __future__ import annotations

import contextlib
import ipaddress

from scan2sim.pipeline.core.errors import SettingError


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine only: 127.0.0.0/8, ::1 or localhost.

    0.0.0.0, :: and the empty string stand for all addresses of this machine; other names may resolve to any address.
    """
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    return host.lower() == "localhost"


def require_protection(host: str, *, protected: bool, options: str) -> None:
    """Refuse to listen on an address that other machines can reach unless the server is protected.

    Args:
        host: address to listen on.
        protected: whether a token, a key or a certificate is given.
        options: the options that provide protection, such as "--token FILE".

    Raises:
        SettingError: `host` isn't a loopback address and the server is unprotected.
    """
    if not protected and not is_loopback(host):
        cause = f"other machines can reach {host or 'an empty address'}, and nothing protects the server"
        raise SettingError("--host", cause, f"Give {options}, or listen on this machine only: --host 127.0.0.1")
