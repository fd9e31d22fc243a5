"""Input files can't execute code, expand XML entities, or inject terminal control sequences."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import xml
from tests.conftest import ROOT

PACKAGES = ("pipeline", "segmentation", "texturing", "slam", "flows", "services", "data_samples")
CODE_EXECUTION = re.compile(
    r"\bpickle\.load|allow_pickle=True|weights_only=False|yaml\.(unsafe_)?load\(|(?<![\w.])(eval|exec)\(|extractall\(|"
    r"shell=True|os\.system|\bmarshal\b|\bshelve\b|import_module\(.*input"
)
EXEMPT = {"pipeline/core/sandbox.py"}
"""Exchanges pickles between a run and its own child processes."""


def test_source_has_no_calls_that_execute_code_from_files() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            if path.relative_to(ROOT).as_posix() not in EXEMPT:
                found = CODE_EXECUTION.search(path.read_text(encoding="utf-8"))
                assert found is None, f"{path}: {found and found[0]}"


def test_only_one_module_parses_xml() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            if path.name != "xml.py":
                assert not re.search(
                    r"fromstring\(|ElementTree\.parse|ET\.parse|minidom", path.read_text(encoding="utf-8")
                ), path


NESTED_ENTITIES = "".join(f'<!ENTITY l{i + 1} "{f"&l{i};" * 10}">' for i in range(12))
ENTITY_EXPANSION = (
    f'<?xml version="1.0" encoding="ENCODING"?><!DOCTYPE a [<!ENTITY l0 "ha">{NESTED_ENTITIES}]><a>&l12;</a>'
)
EXTERNAL_ENTITY = (
    '<?xml version="1.0" encoding="ENCODING"?><!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>'
)


@pytest.mark.parametrize("text", [ENTITY_EXPANSION, EXTERNAL_ENTITY])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "iso-8859-1"])
def test_xml_entities_are_rejected_in_all_encodings(tmp_path: Path, text: str, encoding: str) -> None:
    path = tmp_path / "a.gpx"
    path.write_bytes(text.replace("ENCODING", encoding).encode(encoding))
    with pytest.raises(InputError, match="document type"):
        xml.root(path)
    path.write_bytes(b"<a><b/></a>")
    assert [child.tag for child in xml.root(path)] == ["b"]
    path.write_bytes(b"<a>" * 100_000)
    with pytest.raises(InputError, match="is not readable XML"):
        xml.root(path)


def test_control_characters_in_messages_are_escaped() -> None:
    error = InputError(Path("a\x1b[2J\nerror: b.las"), "is \x07wrong", "Fix it")
    assert str(error) == r"a\x1b[2J\nerror: b.las: is \x07wrong. Fix it"
