"""Whether a service is ready, as its exit code: for containers, which needn't have curl.

    python -m scan2sim.services.http.healthcheck [http://localhost:8080]

Health needs no token. A certificate is not checked: who is asked is on this machine.
"""

from __future__ import annotations

import ssl
import sys
from urllib.error import HTTPError
from urllib.request import HTTPSHandler, ProxyHandler, build_opener

OWN = "http://localhost:8080"
"""Where services listen unless told otherwise."""
WITHIN = 4.0
"""Seconds for an answer."""


def failing(address: str) -> str | None:
    """Why a service can't be asked; None: it is ready.

    Args:
        address: as `http://localhost:8080`.
    """
    unchecked = ssl.create_default_context()
    unchecked.check_hostname, unchecked.verify_mode = False, ssl.CERT_NONE
    direct = build_opener(ProxyHandler({}), HTTPSHandler(context=unchecked))
    try:
        with direct.open(f"{address.rstrip('/')}/health/ready", timeout=WITHIN):
            return None
    except HTTPError as error:
        return f"{error.code} {error.read(1000).decode('utf-8', 'replace')}"
    except (OSError, ValueError) as error:
        return str(error)


def main() -> None:
    """Print what fails, and end with 1, if anything does."""
    address = sys.argv[1] if len(sys.argv) > 1 else OWN
    if reason := failing(address):
        sys.exit(f"{address} is not ready: {reason}")


if __name__ == "__main__":
    main()
