"""The audit trail shows that an entry was changed, removed or inserted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.services.teleoperation.gateway.audit import AuditTrail, verify


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A trail of five entries, two of which a second process has added."""
    path = tmp_path / "audit.jsonl"
    for numbers in ((0, 1, 2), (3, 4)):
        trail = AuditTrail(path)
        for number in numbers:
            trail.add({"time": number, "what": "join", "by": "anna"})
    return path


def test_unchanged_trail_is_valid_and_its_head_grows(path: Path) -> None:
    before = verify(path)
    assert (before.entries, before.damage) == (5, "")
    trail = AuditTrail(path)
    assert trail.verification == before
    trail.add({"time": 5})
    assert trail.verification == verify(path) and verify(path).head != before.head


@pytest.mark.parametrize("at", range(4))
def test_changed_removed_and_inserted_entries_are_found(path: Path, at: int) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    changed = [*lines]
    changed[at] = changed[at].replace("anna", "nobody")
    inserted = [*lines[: at + 1], json.dumps(json.loads(lines[at + 1]) | {"by": "nobody"}), *lines[at + 1 :]]
    for wrong in (
        changed,
        lines[:at] + lines[at + 1 :],
        inserted,
        [*lines[:at], lines[at + 1], lines[at], *lines[at + 2 :]],
    ):
        path.write_text("\n".join(wrong) + "\n", encoding="utf-8")
        found = verify(path)
        assert found.damage.split(":")[0] in [f"line {at + after}" for after in (1, 2, 3)]
        done = CliRunner().invoke(app, ["teleop", "audit", str(path.parent)])
        assert done.exit_code != 0


def test_trail_is_printed_as_json_also_if_it_was_changed(path: Path) -> None:
    done = CliRunner().invoke(app, ["teleop", "audit", str(path), "--json"])
    found = json.loads(done.stdout)
    assert done.exit_code == 0 and (found["entries"], found["damage"]) == (5, "") and found["head"] == verify(path).head
    assert [(one["time"], one["by"]) for one in found["trail"]] == [(number, "anna") for number in range(5)]
    path.write_text(path.read_text(encoding="utf-8").replace("anna", "nobody", 1) + "5\n{broken", encoding="utf-8")
    done = CliRunner().invoke(app, ["teleop", "audit", str(path), "--json"])
    found = json.loads(done.stdout)
    assert done.exit_code != 0 and found["damage"].startswith("line 2") and len(found["trail"]) == 5


def test_removed_last_entry_changes_the_head(path: Path) -> None:
    head = verify(path).head
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:-1]))
    assert verify(path).damage == "" and verify(path).head != head


def test_trail_of_an_earlier_version_and_truncated_line_are_no_damage(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_text('{"time": 1, "what": "join"}\n{"time": 2, "wh', encoding="utf-8")
    trail = AuditTrail(path)
    trail.add({"time": 3})
    trail.add({"time": 4})
    assert verify(path).damage == "" and verify(path).entries == 3
    done = CliRunner().invoke(app, ["teleop", "audit", str(path)])
    assert done.exit_code == 0 and "3 entries, none was changed" in done.output
