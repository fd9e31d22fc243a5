"""Folders in object storage (through fsspec: `s3://`, `gs://`, `az://`, ...), each mirrored in a local cache."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import tempfile
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import InputError, ScanError, UnavailableError, from_os_error
from scan2sim.pipeline.core.paths import inside
from scan2sim.pipeline.core.step import Report, silent

PULLED_INDEX, PUSHED_INDEX = ".remote.json", ".pushed.json"
INDEX_INTERVAL_S = 60.0
"""Seconds after which an index is written again, so that a killed transfer continues."""
CACHE_VARIABLE = "SCAN2SIM_CACHE"
"""Environment variable: the cache folder; default: `~/.cache/scan2sim`. The same on all machines of a cluster."""


def is_remote(location: str | Path) -> bool:
    """Whether a location is a URL of object storage."""
    return "://" in str(location)


def local_copy(location: str | Path) -> Path:
    """Local path of a location: the path itself, or the cached copy of a folder in object storage."""
    return Remote.of(str(location)).local if is_remote(location) else Path(location)


@dataclass(frozen=True)
class Remote:
    """A folder in object storage.

    Attributes:
        url: fsspec URL without a trailing slash.
        local: local folder that its files are cached in.
    """

    url: str
    local: Path

    @classmethod
    def of(cls, url: str) -> Remote:
        """The remote folder at a URL, cached in this user's cache folder.

        Raises:
            UnavailableError: the user has no cache folder, or can't write it.
        """
        url = url.rstrip("/")
        try:
            cache = Path(os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "scan2sim")
            cache.mkdir(parents=True, exist_ok=True)
        except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home folder
            cause = f"can't be copied to this machine ({error})"
            raise UnavailableError(url, cause, f"Set {CACHE_VARIABLE} to a writable folder") from None
        return cls(url, cache / f"{url.rsplit('/', 1)[-1]}-{hashlib.sha256(url.encode()).hexdigest()[:12]}")

    def below(self, name: str) -> Remote:
        """A subfolder."""
        return Remote(f"{self.url}/{name}", self.local / name)

    def pull(self, names: Iterable[str]) -> bool:
        """Download files by their names in the folder, each one atomically; False if one doesn't exist.

        Raises:
            InputError: a name points outside of the folder.
            SpaceError: the disk of the local copy is full, or can't be written.
            UnavailableError: the storage can't be reached or read.
        """
        files, root = self._open()
        for name in names:
            target = self._path(name)
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
                handle, temporary = tempfile.mkstemp(prefix=".fetch-", dir=target.parent)
            except OSError as error:
                raise from_os_error(error, target) from None
            os.close(handle)
            try:
                files.get_file(f"{root}/{name}", temporary)
                Path(temporary).replace(target)
            except FileNotFoundError:
                return False
            except Exception as error:  # each storage has its own exception types
                raise self._unreachable(error) from error
            finally:
                Path(temporary).unlink(missing_ok=True)
        return True

    def pull_all(self, report: Report = silent) -> Path:
        """Synchronize the local copy: download new and changed files, delete removed ones; returns its folder.

        Raises:
            InputError: the remote folder is empty, or a key points outside of it.
            UnavailableError: the storage can't be reached or read.
        """
        files, root = self._open()
        index = self.local / PULLED_INDEX
        try:
            files.invalidate_cache()
            # consoles and other programs mark folders by empty objects whose keys end with a slash
            paths = [path for path in files.find(root) if len(path) > len(root) and not path.endswith("/")]
            found = {path[len(root) + 1 :]: str(files.ukey(path)) for path in paths}
        except Exception as error:
            raise self._unreachable(error) from error
        if not found:
            raise InputError(self.url, "is empty", "Check the address; `scan2sim tile --copy` creates a survey")
        for name in found:
            self._path(name)
        known = _read_index(index)
        removed = known.keys() - found.keys()
        new = [name for name, key in found.items() if known.get(name) != key or not (self.local / name).is_file()]
        saved = time.monotonic()
        for i, name in enumerate(new):
            report(i / len(new), name)
            self.pull([name])
            known[name] = found[name]
            if time.monotonic() - saved > INDEX_INTERVAL_S:
                _write_index(index, known)
                saved = time.monotonic()
        for name in removed:
            self._path(name).unlink(missing_ok=True)
        _write_index(index, found)
        return self.local

    def push(self, names: Iterable[str]) -> None:
        """Upload files of the local copy, in order; links are followed.

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
        """Delete a file from the storage, if it exists.

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
        """Upload the files that are new or have changed since the last `push_all` from this machine.

        Raises:
            UnavailableError: as `push`.
        """
        index = self.local / PUSHED_INDEX
        known = _read_index(index)
        stamps: dict[str, list[int]] = {}
        for name in names:
            stat = (self.local / name).stat()
            stamps[name] = [stat.st_size, stat.st_mtime_ns]
        saved = time.monotonic()
        for name in [name for name, stamp in stamps.items() if known.get(name) != stamp]:
            self.push([name])
            known[name] = stamps[name]
            if time.monotonic() - saved > INDEX_INTERVAL_S:
                _write_index(index, known)
                saved = time.monotonic()
        _write_index(index, stamps)

    def _path(self, name: str) -> Path:
        """Local path of a key."""
        try:
            return inside(self.local, name)
        except InputError:
            remedy = "Delete that key from the storage: a survey's keys are plain paths below its folder"
            raise InputError(f"{self.url}/{name}", "is a key that points outside of its folder", remedy) from None

    def _open(self) -> tuple[Any, str]:
        """The fsspec file system and the folder's path in it."""
        import fsspec

        try:
            files, root = fsspec.core.url_to_fs(self.url)
        except (ImportError, ValueError) as error:
            kind = self.url.split("://")[0]
            remedy = f"Install fsspec's package for {kind}:// (pip install 'scan2sim[s3]' for s3)"
            raise UnavailableError(self.url, str(error), remedy) from None
        return files, root.rstrip("/")

    def _unreachable(self, error: Exception) -> ScanError:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return from_os_error(error, self.local)  # this machine's disk
        cause = f"can't be reached ({type(error).__name__}: {error})"
        remedy = "Check the address, the credentials (they must permit listing the folder, too) and the network"
        return UnavailableError(self.url, cause, remedy)


def _read_index(path: Path) -> dict[str, Any]:
    """What was transferred before, by name; empty, so that all is transferred again, if the file can't be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _write_index(path: Path, index: Mapping[str, Any]) -> None:
    temporary = path.with_suffix(".tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(index), encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise from_os_error(error, path) from None
