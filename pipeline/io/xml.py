"""XML files: read without document types, and so without entities, which could grow without bounds or name files."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import file_checks

LARGEST = 512_000_000
"""Bytes: cameras of a hundred thousand photos have room."""


def root(path: Path, remedy: str = "Export it again") -> ElementTree.Element:
    """The root of an XML file.

    Raises:
        InputError: it is no file, too large, no readable XML, or declares a document type, whatever its encoding.
    """
    file_checks.check(path)
    if path.stat().st_size > LARGEST:
        raise InputError(path, f"is of {path.stat().st_size:,} bytes, more than {LARGEST:,}", remedy)
    try:
        data = path.read_bytes()
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = _refuse
        parser.Parse(data, True)
        return ElementTree.fromstring(data)
    except (OSError, expat.ExpatError, ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        raise InputError(path, f"is no readable XML ({error})", remedy) from None


def _refuse(*_: object) -> None:
    raise ValueError("it declares a document type, with which come XML entities")
