"""Trust in OSM's certificate by its fingerprint, for the self-signed and expired ones that it is shipped with.

A fingerprint that was given once (`--fingerprint`) is stored for this address, like SSH's known hosts, and checked at
every connection before the password is sent.
"""

from __future__ import annotations

import hashlib
import os
import re
import ssl
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from scan2sim.pipeline.core.errors import InputError, SettingError, UnavailableError

FETCH_TIMEOUT_S = 10.0
FINGERPRINT_ADVICE = (
    "Compare it with that of OSM's own file (openssl x509 -noout -fingerprint -sha256 -in FILE), then trust it with"
    " --fingerprint {}; or give --ca, its certificate authority"
)


def parse(text: str) -> str:
    """SHA-256 fingerprint as lower-case hexadecimal digits, from openssl's or any usual notation.

    Raises:
        SettingError: it isn't one.
    """
    digits = re.sub(r"^sha-?256:", "", text.rpartition("=")[2].strip().lower()).replace(":", "")
    if not re.fullmatch("[0-9a-f]{64}", digits):
        raise SettingError(
            "--fingerprint", "not a SHA-256 fingerprint", "Give 64 hexadecimal digits, with or without :"
        )
    return digits


def known_file() -> Path:
    """File of the fingerprints that are trusted, one line for each address."""
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "scan2sim" / "known_osm"


def known(url: str) -> str | None:
    """The fingerprint that is trusted at an address; None if there is none.

    Raises:
        InputError: the file of fingerprints can't be read.
    """
    return _read().get(urlsplit(url).netloc.lower())


def remember(url: str, fingerprint: str) -> None:
    """Store the fingerprint that is trusted at an address, in place of an earlier one.

    Raises:
        InputError: the file of fingerprints can't be read or written.
    """
    entries = _read()
    address = urlsplit(url).netloc.lower()
    if entries.get(address) == fingerprint:
        return
    path = known_file()
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        new = path.with_name(f"{path.name}.{os.getpid()}")
        new.write_text("".join(f"{one} {two}\n" for one, two in (entries | {address: fingerprint}).items()), "utf-8")
        new.replace(path)
    except OSError as error:
        raise InputError(path, f"can't be written ({error.strerror})", "Set XDG_STATE_HOME to another folder") from None


def _read() -> dict[str, str]:
    try:
        lines = known_file().read_text("utf-8").splitlines()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeError) as error:
        raise InputError(known_file(), f"can't be read ({error})", "Fix or remove it") from None
    return {words[0]: words[1] for words in map(str.split, lines) if len(words) == 2}


class PinnedContext(ssl.SSLContext):
    """TLS context that accepts exactly one certificate, whoever signed it and however old it is.

    Attributes:
        url: address of the server; fingerprint: of its certificate.
    """

    url: str
    fingerprint: str

    @classmethod
    def of(cls, url: str, fingerprint: str) -> PinnedContext:
        """Context for a server with a trusted fingerprint."""
        context = cls(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        context.url, context.fingerprint = url, fingerprint
        return context

    def wrap_socket(self, *args: Any, **options: Any) -> ssl.SSLSocket:
        """Connect, and check the certificate before anything is sent.

        Raises:
            ssl.SSLCertVerificationError: it is another one.
        """
        connected = super().wrap_socket(*args, **options)
        found = _fingerprint(connected.getpeercert(binary_form=True) or b"")
        if found != self.fingerprint:
            connected.close()
            raise ssl.SSLCertVerificationError(f"CERTIFICATE has the fingerprint {_notation(found)}")
        remember(self.url, self.fingerprint)
        return connected


def untrusted(url: str, reason: str, context: ssl.SSLContext) -> UnavailableError:
    """Error for a certificate that isn't trusted, with its fingerprint and what to do."""
    if isinstance(context, PinnedContext):
        found = reason.rpartition(" ")[2]
        trusted = _notation(context.fingerprint)
        cause = f"its certificate isn't the trusted one: the fingerprint is {found}, not {trusted}"
        remedy = "Somebody may intercept the connection; if the certificate was renewed: "
        return UnavailableError(url, cause, remedy + FINGERPRINT_ADVICE.format(found))
    why = re.sub(r"^.*certificate verify failed: |\s*\(_ssl.c:\d+\)$", "", reason.removeprefix("[SSL: "))
    try:
        parts = urlsplit(url)
        text = ssl.get_server_certificate((parts.hostname or "", parts.port or 443), timeout=FETCH_TIMEOUT_S)
        found = _notation(_fingerprint(ssl.PEM_cert_to_DER_cert(text)))
    except (OSError, ValueError):
        return UnavailableError(url, f"its certificate isn't trusted ({why})", "Give --ca, its certificate authority")
    cause = f"its certificate isn't trusted ({why}); its SHA-256 fingerprint is {found}"
    return UnavailableError(url, cause, FINGERPRINT_ADVICE.format(found))


def _fingerprint(certificate: bytes) -> str:
    return hashlib.sha256(certificate).hexdigest()


def _notation(fingerprint: str) -> str:
    """Fingerprint as openssl prints it."""
    return ":".join(fingerprint[i : i + 2] for i in range(0, len(fingerprint), 2)).upper()
