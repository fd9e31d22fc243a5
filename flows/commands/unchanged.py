"""Detects that a command would do nothing, without importing a step: a record of the last run, compared by file status.

A finished run writes `OUT/steps/unchanged.json`: the command's arguments, the folders that it read sources from, what
it printed, and a digest of the status (size, times, inode) of all sources, results and published files, and of the
program's own files. The same command later finds the same status: nothing has changed that the full comparison of
cache keys would see. Any difference, also in files that don't matter, leads to that full comparison.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from scan2sim.flows.engine.lock import locked

RECORD = Path("steps") / "unchanged.json"
"""Path of the record below the output folder."""
OWN_FILES = ("run.log", ".lock", RECORD.name)
"""Files in an output folder that runs write without changing a result."""
PROGRAM = Path(__file__).parents[2]
NO_PROGRAM = ("docs", "data_samples", "__pycache__")
"""Folders of the package without influence on results."""
NEVER = ("--force", "--from", "--bus")
"""Options with which a command always does something."""
SETTLED_NS = 2_000_000_000
"""Age below which a file's times don't show whether it was written again (FAT: 2 s)."""

arguments: Sequence[str] | None = None
"""Arguments of this process's command; None: called from Python, no record is written."""


class Watch:
    """Status of the sources when a run began, to record after the run that they led to its results.

    Args:
        sources: files and folders that the run reads; of a folder, and of a file's folder, all files.
    """

    def __init__(self, sources: Iterable[Path]) -> None:
        # not resolved: a link to another folder is a change
        self._sources = sorted({str((path if path.is_dir() else path.parent).absolute()) for path in sources})
        try:
            self._inputs, newest = _inputs(self._sources, arguments or ())
            self._settled = newest < time.time_ns() - SETTLED_NS
        except OSError:  # the steps that read the sources say what is wrong with them
            self._inputs, self._settled = "", False

    def record(self, out: Path, lines: Sequence[str]) -> None:
        """Record a run that finished without failures and warnings about edited files.

        Args:
            out: output folder.
            lines: what the command prints when nothing has changed.
        """
        if arguments is None or not self._settled or _out(arguments) is None:
            return
        with suppress(OSError):  # a link that leads nowhere, a full disk: the next run compares everything
            state = _digest([self._inputs, _status(_walk(out, OWN_FILES))[0]])
            body = {"command": _command(arguments), "sources": self._sources, "state": state, "lines": list(lines)}
            temporary = (out / RECORD).with_suffix(".tmp")
            temporary.write_text(json.dumps(body), encoding="utf-8")
            temporary.replace(out / RECORD)


def unchanged(given: Sequence[str]) -> list[str] | None:
    """Lines to print if a command would do nothing; None if that isn't certain.

    Args:
        given: arguments of the command, `run TILE --out OUT ...`.

    Raises:
        BusyError: another run uses the output folder.
    """
    out = _out(given)
    if out is None or not (out / RECORD).is_file():
        return None
    with locked(out), suppress(OSError, ValueError, KeyError, TypeError):
        body = json.loads((out / RECORD).read_text(encoding="utf-8"))
        if body["command"] != _command(given):
            return None
        if body["state"] == _digest([_inputs(body["sources"], given)[0], _status(_walk(out, OWN_FILES))[0]]):
            return [str(line) for line in body["lines"]]
    return None


def _out(given: Sequence[str]) -> Path | None:
    """Output folder among the arguments of a command that may have nothing to do."""
    if not given or given[0] not in ("run", "survey") or any(text.split("=")[0] in NEVER for text in given):
        return None
    for text, following in zip(given, [*given[1:], ""], strict=True):
        name, equals, value = text.partition("=")
        if name in ("--out", "-o"):
            return Path(value if equals else following)
    return None


def _command(given: Sequence[str]) -> list[str]:
    return [str(Path.cwd()), *given]


def _inputs(folders: Sequence[str], given: Sequence[str]) -> tuple[str, int]:
    """Digest of the status of the program and of all files in folders and arguments; newest time of the latter (ns)."""
    packages = [Path(path) for path in sys.path if path.endswith("-packages") and Path(path).is_dir()]
    program = [sys.version, [(str(path), path.stat().st_mtime_ns) for path in packages]]
    named = {Path(text) for argument in given for text in (argument, argument.rpartition("=")[2]) if _is_file(text)}
    sources, newest = _status([*(file for folder in folders for file in _files(folder)), *named])
    return _digest([program, _status(_walk(PROGRAM, NO_PROGRAM))[0], sources]), newest


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except (OSError, ValueError):  # too long for a path, or with a zero
        return False


def _files(folder: str) -> list[os.DirEntry[str]]:
    with os.scandir(folder) as entries:
        return [entry for entry in entries if entry.is_file()]


def _walk(folder: Path | str, without: Sequence[str]) -> Iterator[os.DirEntry[str]]:
    """All files below a folder, except those of these names and in folders of these names."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name in without:
                continue
            if entry.is_dir():
                yield from _walk(entry.path, without)
            else:
                yield entry


def _status(files: Iterable[os.DirEntry[str] | Path]) -> tuple[str, int]:
    """Digest of the paths, sizes, times and inodes of files, and the newest of their times (ns)."""
    rows, newest = [], 0
    for file in files:
        stat = file.stat()
        rows.append((os.fspath(file), stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino))
        newest = max(newest, stat.st_mtime_ns, stat.st_ctime_ns)
    return _digest(sorted(rows)), newest


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()
