"""Folders in object storage (by fsspec: `s3://`, `gs://`, `az://`, ...), each with its likeness on this machine."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import InputError, UnavailableError
from scan2sim.pipeline.core.paths import inside
from scan2sim.pipeline.core.step import Report, silent

INDEX, PUSHED = ".remote.json", ".pushed.json"
CACHE = "SCAN2SIM_CACHE"
"""Environment variable: folder of likenesses; default: `~/.cache/scan2sim`. The same on all machines of a cluster."""


def is_remote(place: str | Path) -> bool:
    """Whether a place is a URL of object storage."""
    return "://" in str(place)


def likeness(place: str | Path) -> Path:
    """Where the files of a place are on this machine: itself, or the likeness of a folder in object storage."""
    return Remote.of(str(place)).local if is_remote(place) else Path(place)


@dataclass(frozen=True)
class Remote:
    """A folder in object storage.

    Attributes:
        url: as fsspec knows it, without a slash at its end.
        local: where its files are on a machine that has fetched them.
    """

    url: str
    local: Path

    @classmethod
    def of(cls, url: str) -> Remote:
        """With its likeness in this user's cache."""
        url = url.rstrip("/")
        cache = Path(os.environ.get(CACHE) or Path.home() / ".cache" / "scan2sim")
        return cls(url, cache / f"{url.rsplit('/', 1)[-1]}-{hashlib.sha256(url.encode()).hexdigest()[:12]}")

    def below(self, name: str) -> Remote:
        """A folder in it."""
        return Remote(f"{self.url}/{name}", self.local / name)

    def pull(self, names: Iterable[str]) -> bool:
        """Fetch files by their names in the folder, each whole or not at all; False if one isn't there.

        Raises:
            InputError: a name that leads out of the folder.
            UnavailableError: the storage can't be reached or read.
        """
        files, root = self._open()
        for name in names:
            target = self._path(name)
            target.parent.mkdir(parents=True, exist_ok=True)
            handle, fresh = tempfile.mkstemp(prefix=".fetch-", dir=target.parent)
            os.close(handle)
            try:
                files.get_file(f"{root}/{name}", fresh)
                Path(fresh).replace(target)
            except FileNotFoundError:
                return False
            except Exception as error:  # each storage has errors of its own
                raise self._unreachable(error) from error
            finally:
                Path(fresh).unlink(missing_ok=True)
        return True

    def pull_all(self, report: Report = silent) -> Path:
        """Bring the likeness up to date: what is new or changed is fetched, what is gone removed; returns it.

        Raises:
            InputError: there is nothing, or a key leads out of the folder.
            UnavailableError: the storage can't be reached or read.
        """
        files, root = self._open()
        index = self.local / INDEX
        try:
            files.invalidate_cache()
            found = {path[len(root) + 1 :]: str(files.ukey(path)) for path in files.find(root)}
        except Exception as error:
            raise self._unreachable(error) from error
        if not found:
            raise InputError(self.url, "there is nothing", "Check the address; `scan2sim tile --copy` makes a survey")
        for name in found:
            self._path(name)
        known: dict[str, str] = json.loads(index.read_text(encoding="utf-8")) if index.is_file() else {}
        new = [name for name, key in found.items() if known.get(name) != key or not (self.local / name).is_file()]
        for i, name in enumerate(new):
            report(i / len(new), name)
            self.pull([name])
        for name in known.keys() - found.keys():
            self._path(name).unlink(missing_ok=True)
        self.local.mkdir(parents=True, exist_ok=True)
        index.write_text(json.dumps(found), encoding="utf-8")
        return self.local

    def push(self, names: Iterable[str]) -> None:
        """Store files of the likeness, in order; what links lead to is stored, not links.

        Raises:
            UnavailableError: the storage can't be reached or written to.
        """
        files, root = self._open()
        try:
            for name in names:
                files.put_file(str((self.local / name).resolve()), f"{root}/{name}")
        except Exception as error:
            raise self._unreachable(error) from error

    def remove(self, name: str) -> None:
        """Take a file out of the storage, if it is there.

        Raises:
            UnavailableError: as `push`.
        """
        files, root = self._open()
        try:
            files.rm_file(f"{root}/{name}")
        except FileNotFoundError:
            pass
        except Exception as error:
            raise self._unreachable(error) from error

    def push_all(self, names: Iterable[str]) -> None:
        """Store those of the files that are new or have changed since this was last done from here.

        Raises:
            UnavailableError: as `push`.
        """
        index = self.local / PUSHED
        known: dict[str, list[int]] = json.loads(index.read_text(encoding="utf-8")) if index.is_file() else {}
        marks = {}
        for name in names:
            stat = (self.local / name).stat()
            marks[name] = [stat.st_size, stat.st_mtime_ns]
        self.push(name for name, mark in marks.items() if known.get(name) != mark)
        index.write_text(json.dumps(marks), encoding="utf-8")

    def _path(self, name: str) -> Path:
        """Where a key's file is on this machine."""
        try:
            return inside(self.local, name)
        except InputError:
            remedy = "Take that key out of the storage: a survey's keys are plain paths below its folder"
            raise InputError(f"{self.url}/{name}", "is a key that leads out of its folder", remedy) from None

    def _open(self) -> tuple[Any, str]:
        """The file system and the folder's path in it."""
        import fsspec

        try:
            files, root = fsspec.core.url_to_fs(self.url)
        except (ImportError, ValueError) as error:
            kind = self.url.split("://")[0]
            remedy = f"Install what fsspec needs for {kind}:// (pip install 'scan2sim[s3]' for s3)"
            raise UnavailableError(self.url, str(error), remedy) from None
        return files, root.rstrip("/")

    def _unreachable(self, error: Exception) -> UnavailableError:
        cause = f"can't be reached ({type(error).__name__}: {error})"
        return UnavailableError(self.url, cause, "Check the address, the credentials and the network")
