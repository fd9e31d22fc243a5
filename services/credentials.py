"""Credentials in URLs, replaced before a URL is shown, logged, published or written."""

from __future__ import annotations

import re

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


def redacted(text: str) -> str:
    """A URL, or text with URLs in it, without their credentials; anything else stays as it is.

    User and password before the host become `***`, and so do the values of query parameters whose name ends like a
    credential's: `?password=`, `&access_token=`, `&X-Amz-Signature=`. Redacting twice changes nothing.
    """
    return _PARAMETER.sub(rf"\1{HIDDEN}", _USERINFO.sub(rf"\1{HIDDEN}@", text))
