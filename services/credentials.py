"""Redacts credentials in URLs before a URL is displayed, logged, published or written."""

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
    """Replace the credentials in a URL, or in text that contains URLs; any other text is returned unchanged.

    User and password before the host become `***`, and so do the values of query parameters whose name ends like that
    of a credential: `?password=`, `&access_token=`, `&X-Amz-Signature=`. Redaction is idempotent.
    """
    return _PARAMETER.sub(rf"\1{HIDDEN}", _USERINFO.sub(rf"\1{HIDDEN}@", text))
