"""Health check of a service by exit code, for containers without curl.

    python -m scan2sim.services.http.healthcheck [http://localhost:8080]

The health endpoint needs no token. The certificate is not verified, because the service runs on this machine.
"""

from __future__ import annotations

import ssl
import sys
from urllib.error import HTTPError
from urllib.request import HTTPSHandler, ProxyHandler, build_opener

DEFAULT_ADDRESS = "http://localhost:8080"
"""Default address of the services."""
TIMEOUT_S = 4.0
"""Time for a response."""


def failing(address: str) -> str | None:
    """Why a service isn't ready; None: it is.

    Args:
        address: such as `http://localhost:8080`.
    """
    unchecked = ssl.create_default_context()
    unchecked.check_hostname, unchecked.verify_mode = False, ssl.CERT_NONE
    direct = build_opener(ProxyHandler({}), HTTPSHandler(context=unchecked))
    try:
        with direct.open(f"{address.rstrip('/')}/health/ready", timeout=TIMEOUT_S):
            return None
    except HTTPError as error:
        return f"{error.code} {error.read(1000).decode('utf-8', 'replace')}"
    except (OSError, ValueError) as error:
        return str(error)


def main() -> None:
    """Print the cause and exit with 1 if the service isn't ready."""
    address = sys.argv[1] if len(sys.argv) > 1 else DEFAULT_ADDRESS
    if reason := failing(address):
        sys.exit(f"{address} is not ready: {reason}")


if __name__ == "__main__":
    main()
