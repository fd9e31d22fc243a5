"""Commands where standard streams are closed, few files may be open, or the current folder was deleted."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from scan2sim.flows import cli
from scan2sim.flows.commands.display import log_unexpected
from scan2sim.pipeline.core.errors import InputError, from_exception
from tests.conftest import ROOT

COMMAND = [sys.executable, "-m", "scan2sim.flows.cli"]


def run_in_shell(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a shell script with arguments "$@"."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(["sh", "-c", script, "sh", *arguments], capture_output=True, text=True, env=environment)


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_standard_streams_are_opened(closed: str, tmp_path: Path) -> None:
    program = f"""
import os
from scan2sim.flows.commands.process import open_standard_streams
open_standard_streams()
number = os.open({str(tmp_path / "file")!r}, os.O_CREAT)
os.write(os.open({str(tmp_path / "numbers")!r}, os.O_CREAT | os.O_WRONLY), f"{{number}}".encode())
for stream in (0, 1, 2):
    os.fstat(stream)
"""
    done = run_in_shell(f'"$@" {closed}', sys.executable, "-c", program)
    assert done.returncode == 0, done.stderr
    assert int((tmp_path / "numbers").read_text(encoding="utf-8")) > 2


def test_commands_may_open_more_files_than_the_shell_allows() -> None:
    program = """
import resource
from scan2sim.flows.commands import process
process.raise_file_limit()
print(*resource.getrlimit(resource.RLIMIT_NOFILE))
"""
    done = run_in_shell('ulimit -S -n 200 && ulimit -H -n 400 && "$@"', sys.executable, "-c", program)
    assert done.stdout.split() == ["400", "400"], done.stderr


def test_a_deleted_current_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    done = run_in_shell('cd "$0" && rmdir "$0" && "$@"'.replace("$0", str(tmp_path / "gone")), *COMMAND, "sample")
    assert done.returncode == 3 and "the current folder: was deleted" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr


def test_file_names_of_another_encoding_are_errors_of_the_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write_toml() -> None:
        f'file = "photos/{os.fsdecode("straße.jpg".encode("latin-1"))}"'.encode()

    with pytest.raises(UnicodeEncodeError) as caught:
        write_toml()
    error = from_exception(caught.value, "ingest", Path())
    assert isinstance(error, InputError) and "photos/stra\\udcdfe.jpg" in error.where
    monkeypatch.setattr(cli, "app", write_toml)
    monkeypatch.setattr(sys, "argv", ["scan2sim"])
    with pytest.raises(SystemExit, match="3"):
        cli.main()
    assert "is a file name that isn't UTF-8" in capsys.readouterr().err


def test_tracebacks_of_unexpected_errors_are_written_in_any_encoding() -> None:
    path = Path(log_unexpected(ValueError("→ " + os.fsdecode("straße".encode("latin-1")))))
    text = path.read_text(encoding="utf-8")
    path.unlink()
    assert "→ stra\\udcdfe" in text


def test_tracebacks_of_unexpected_errors_are_printed_without_a_temporary_folder(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/nowhere")
    assert log_unexpected(ValueError("no such luck")) == "the traceback above"
    assert "ValueError: no such luck" in capsys.readouterr().err
