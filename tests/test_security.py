"""What files could do besides being read: code, entities, names that steer terminals and pages."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import xml
from tests.conftest import ROOT

ROOMS = ("pipeline", "segmentation", "texturing", "slam", "flows", "services", "data_samples")
RUNS = re.compile(
    r"\bpickle\.load|allow_pickle=True|weights_only=False|yaml\.(unsafe_)?load\(|(?<![\w.])(eval|exec)\(|extractall\(|"
    r"shell=True|os\.system|\bmarshal\b|\bshelve\b|import_module\(.*input"
)
BETWEEN_PROCESSES = {"pipeline/core/sandbox.py"}
"""Pickles between a run and its own children."""


def test_nothing_that_is_read_is_run() -> None:
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            if path.relative_to(ROOT).as_posix() not in BETWEEN_PROCESSES:
                found = RUNS.search(path.read_text(encoding="utf-8"))
                assert found is None, f"{path}: {found and found[0]}"


def test_xml_is_read_in_one_place() -> None:
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            if path.name != "xml.py":
                assert not re.search(
                    r"fromstring\(|ElementTree\.parse|ET\.parse|minidom", path.read_text(encoding="utf-8")
                ), path


LAUGHS = "".join(f'<!ENTITY l{i + 1} "{f"&l{i};" * 10}">' for i in range(12))
BOMB = f'<?xml version="1.0" encoding="ENCODING"?><!DOCTYPE a [<!ENTITY l0 "ha">{LAUGHS}]><a>&l12;</a>'
OUTSIDE = '<?xml version="1.0" encoding="ENCODING"?><!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>'


@pytest.mark.parametrize("text", [BOMB, OUTSIDE])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "iso-8859-1"])
def test_entities_of_xml_are_refused_in_every_encoding(tmp_path: Path, text: str, encoding: str) -> None:
    path = tmp_path / "a.gpx"
    path.write_bytes(text.replace("ENCODING", encoding).encode(encoding))
    with pytest.raises(InputError, match="document type"):
        xml.root(path)
    path.write_bytes(b"<a><b/></a>")
    assert [child.tag for child in xml.root(path)] == ["b"]
    path.write_bytes(b"<a>" * 100_000)
    with pytest.raises(InputError, match="no readable XML"):
        xml.root(path)


def test_names_of_files_steer_no_terminal() -> None:
    error = InputError(Path("a\x1b[2J\nerror: b.las"), "is \x07wrong", "Mend it")
    assert str(error) == r"a\x1b[2J\nerror: b.las: is \x07wrong. Mend it"
