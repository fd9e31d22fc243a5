"""XML parser that refuses document types, and so entity attacks (entity expansion, external entities)."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import file_checks

MAX_BYTES = 512_000_000
"""Maximum file size; enough for the cameras of a hundred thousand photos."""


def root(path: Path, remedy: str = "Export it again") -> ElementTree.Element:
    """The root element of an XML file.

    Raises:
        InputError: not a file, too large, not well-formed, or it declares a document type (in any encoding).
    """
    file_checks.check(path)
    if path.stat().st_size > MAX_BYTES:
        raise InputError(path, f"has {path.stat().st_size:,} bytes, more than {MAX_BYTES:,}", remedy)
    try:
        data = path.read_bytes()
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = _refuse
        parser.Parse(data, True)
        return ElementTree.fromstring(data)
    except (OSError, expat.ExpatError, ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        raise InputError(path, f"is not readable XML ({error})", remedy) from None


def _refuse(*_: object) -> None:
    raise ValueError("it declares a document type (DTD), which is not allowed")
