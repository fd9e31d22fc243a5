"""Redacts credentials before a text is displayed, logged, published or written.

Those in URLs are found by their place (`redacted`), others by the request that contained them (`secrets_of`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

HIDDEN = "***"
_USERINFO = re.compile(
    r"""([a-z][a-z0-9+.-]*:/{1,2})       # scheme; a Path leaves one slash
        (?:[^/?#\n]*                     # user:password
          |[^/?#:\n]*:(?!\d+[/?#])\S*    # user:password with an unescaped / ? or #: no host:port
        )@""",
    re.IGNORECASE | re.VERBOSE,
)
_PARAMETER = re.compile(
    r"([?&;][\w.-]*(?:pass(?:word|wd|phrase)?|pwd?|pas|token|secret|key|auth|sig(?:nature)?|credentials?|session)=)[^\s&]+",
    re.IGNORECASE,
)
_SECRET_NAME = re.compile(r"pass(?:word|wd|phrase)?$|secret|token|credential|key(?:[-_]data)?$", re.IGNORECASE)
MIN_SECRET_CHARS = 4
"""Shorter texts aren't redacted: they would be found in any message."""


def redacted(text: str) -> str:
    """Replace the credentials in a URL, or in text that contains URLs; any other text is returned unchanged.

    User and password before the host become `***`, and so do the values of query parameters whose name ends like that
    of a credential: `?password=`, `&access_token=`, `&X-Amz-Signature=`. Redaction is idempotent.
    """
    return _PARAMETER.sub(rf"\1{HIDDEN}", _USERINFO.sub(rf"\1{HIDDEN}@", text))


def is_secret(name: str) -> bool:
    """Whether a setting of this name is a credential, such as `password` or `client-key-data`."""
    return bool(_SECRET_NAME.search(name))


def secrets_of(body: Any, name: str = "") -> Iterator[str]:
    """Credentials in a request's body: texts at any depth whose name is that of a credential."""
    if isinstance(body, Mapping):
        for key, value in body.items():
            yield from secrets_of(value, str(key))
    elif isinstance(body, list | tuple):
        for value in body:
            yield from secrets_of(value, name)
    elif isinstance(body, str) and len(body) >= MIN_SECRET_CHARS and is_secret(name):
        yield body


def without(text: str, secrets: Iterable[str]) -> str:
    """Replace credentials in a text by `***`, also where it quotes them as Python does."""
    for secret in sorted(set(secrets), key=len, reverse=True):
        for form in (secret, repr(secret)[1:-1]):
            text = text.replace(form, HIDDEN)
    return text
