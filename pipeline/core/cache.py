"""Where results are kept: one folder a result, named by a key of everything it came from.

```
ROOT/poisson.terrain/3f9a.../manifest.json   what was run, on what, how long, with which outputs
                            /mesh.npz        the outputs
ROOT/track/.part-81c2.../                    how far a step has come that was killed, where it says so itself
```
A result is written to a temporary folder and moved into place, so that a killed run leaves nothing
half-made. A result counts as present while all its files are there with the sizes that the
manifest gives, and none has changed since that was written; one that has is digested, and counts if its bytes are the
same (it was copied, say). All bytes are digested before a step reads a result that its run hasn't made (`intact`). What
is deleted or damaged is rebuilt, and nothing that depends on it (same key, same bytes).

A manifest is sealed by its digest, and one that names files outside of its folder is none.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from stat import S_ISREG
from typing import Any

from scan2sim.pipeline.core.errors import InputError, from_os_error
from scan2sim.pipeline.core.paths import inside
from scan2sim.pipeline.core.step import Done, Params, Step
from scan2sim.pipeline.io.remote import Remote

KEY_LENGTH = 24
TEMPORARY, PART = ".tmp-", ".part-"


@dataclass(frozen=True)
class Manifest:
    """What is kept of a result beside its files.

    Attributes:
        label: the full name of its node (`poisson.terrain`).
        version, params, inputs: what the key was made of; inputs are keys or digests by name.
        fed: like the key, but of the contents of what was read, whatever made them.
        content: digest of all output files.
        files: output name to path relative to the result's folder.
        sizes: bytes of every file below it.
        digests: SHA-256 of each of them.
        facts, warnings: as the step gave them.
        seconds, peak_mb: wall time and peak memory of the step's process and its children.
    """

    label: str
    version: int
    params: dict[str, Any]
    inputs: dict[str, str]
    fed: str
    content: str
    files: dict[str, str]
    sizes: dict[str, int]
    digests: dict[str, str]
    facts: dict[str, Any]
    warnings: list[str]
    seconds: float
    peak_mb: float


def digest(path: Path) -> str:
    """SHA-256 of a source file, or of a folder's files by their names; "missing" where it isn't there.

    The step says what that means.
    """
    try:
        if path.is_dir():
            return content_of({file.name: digest(file) for file in path.iterdir() if file.is_file()})
        if path.exists() and not path.is_file():
            return "missing"  # a pipe, which would be waited on for ever
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        raise from_os_error(error, path) from None


class Digests:
    """`digest`, remembered in a file for sources whose size and time of change are as they were.

    A kilometre of survey is gigabytes: looking for what changed must not read them all again.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        try:
            self._known: dict[str, list[Any]] = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            self._known = {}
        self._used: dict[str, list[Any]] = {}

    def __call__(self, path: Path) -> str:
        """SHA-256 of a file or folder, in hex; of a file that is as it was, the one that was told before."""
        try:
            stat = path.stat()
        except OSError:
            return digest(path)
        if path.is_dir():
            return content_of({file.name: self(file) for file in path.iterdir() if file.is_file()})
        mark = [stat.st_size, stat.st_mtime_ns, stat.st_ino]
        known = self._known.get(str(path))
        found = known[3] if known and known[:3] == mark else digest(path)
        self._used[str(path)] = [*mark, found]
        return str(found)

    def save(self) -> None:
        """Write what was asked for."""
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            fresh = self._file.with_suffix(".tmp")
            fresh.write_text(json.dumps(self._used), encoding="utf-8")
            fresh.replace(self._file)
        except OSError as error:
            raise from_os_error(error, self._file) from None


def content_of(digests: Mapping[str, str]) -> str:
    """One digest of all files of a result, by their names and digests."""
    together = hashlib.sha256()
    for name in sorted(digests):
        together.update(f"{name}\0{digests[name]}\n".encode())
    return together.hexdigest()


def _seal(body: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def read_manifest(path: Path) -> Manifest | None:
    """The manifest in a file; None where there is none, it isn't as it was written, or names files elsewhere."""
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
        if body.pop("seal") != _seal(body):
            return None
        manifest = Manifest(**body)
        if manifest.sizes.keys() != manifest.digests.keys():
            return None
        for name in (*manifest.sizes, *manifest.files.values()):
            inside(path.parent, name)
        outputs = [(path.parent / name).resolve() for name in manifest.files.values()]
        return manifest if all(file.is_relative_to(path.parent.resolve()) for file in outputs) else None
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError, InputError):
        return None


def damaged(folder: Path, manifest: Manifest) -> list[str]:
    """Names of those of a result's files whose bytes aren't as they were made."""
    return [name for name, known in manifest.digests.items() if digest(folder / name) != known]


def key_of(step: Step, params: Params, inputs: Mapping[str, str]) -> str:
    """The key of a result: step, version, parameters and the keys of what it reads."""
    text = json.dumps([step.name, step.version, params.model_dump(mode="json"), dict(inputs)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


class Store:
    """Results below one folder; a `node` is named by its full name in the recipe (`poisson.terrain`).

    Args:
        root: the folder.
        remote: where results are kept besides, for machines that share no disk; `root` is its likeness then.
        sources: where files of the survey come from that aren't on this machine.
    """

    def __init__(self, root: Path, remote: Remote | None = None, sources: Remote | None = None) -> None:
        self.root, self.remote, self.sources = root, remote, sources
        self._sound: set[Path] = set()  # folders of results that this run has made, or digested

    def within(self, name: str) -> Store:
        """The store of the nodes whose full names begin with `name/`."""
        store = Store(self.root / name, self.remote and self.remote.below(name), self.sources)
        store._sound = self._sound
        return store

    def folder(self, node: str, key: str) -> Path:
        """Where the result is, or will be."""
        return self.root / node / key

    def find(self, node: str, key: str) -> Manifest | None:
        """The manifest of a complete result; None where it is absent or a file of it was deleted."""
        manifest = self._manifest(node, key)
        if manifest is None or self._complete(node, key, manifest):
            return manifest
        return manifest if self.remote is not None else None  # its files are fetched when they are read

    def read(self, node: str, key: str) -> Manifest | None:
        """As `find`, with its files on this machine."""
        manifest = self.find(node, key)
        if manifest is not None and self.remote is not None and not self._complete(node, key, manifest):
            return manifest if self.remote.pull(f"{node}/{key}/{name}" for name in manifest.sizes) else None
        return manifest

    def intact(self, node: str, key: str) -> bool:
        """Whether a result's files are on this machine, each with the bytes that it was made with."""
        folder = self.folder(node, key)
        if folder in self._sound:
            return True
        manifest = self.read(node, key)
        if manifest is not None and self.remote is not None and damaged(folder, manifest):
            shutil.rmtree(folder, ignore_errors=True)  # what was fetched: the storage has it
            manifest = self.read(node, key)
        if manifest is None or damaged(folder, manifest):
            return False
        self.trust(node, key)
        return True

    def trust(self, node: str, key: str) -> None:
        """The result was made in this run, or found intact: it isn't looked into any more."""
        self._sound.add(self.folder(node, key))

    def discard(self, node: str, key: str) -> None:
        """Remove a result that is of no use."""
        self._sound.discard(self.folder(node, key))
        if self.remote is not None:
            self.remote.remove(f"{node}/{key}/manifest.json")
        shutil.rmtree(self.folder(node, key), ignore_errors=True)

    def source(self, path: Path) -> Path:
        """A source file, fetched if it isn't on this machine and it is known where from."""
        if self.sources is not None and not path.exists() and path.is_relative_to(self.sources.local):
            self.sources.pull([path.relative_to(self.sources.local).as_posix()])
        return path

    def _manifest(self, node: str, key: str) -> Manifest | None:
        path = self.folder(node, key) / "manifest.json"
        if self.remote is not None and not path.is_file():
            self.remote.pull([f"{node}/{key}/manifest.json"])
        manifest = read_manifest(path)
        return manifest if manifest is not None and f"/{manifest.label}".endswith(f"/{node}") else None

    def _complete(self, node: str, key: str, manifest: Manifest) -> bool:
        folder = self.folder(node, key)
        try:
            written = newest = (folder / "manifest.json").stat().st_mtime_ns
            for name, size in manifest.sizes.items():
                stat = (folder / name).stat()
                if not S_ISREG(stat.st_mode) or stat.st_size != size:
                    return False
                if stat.st_mtime_ns > written and digest(folder / name) != manifest.digests[name]:
                    return False
                newest = max(newest, stat.st_mtime_ns)
        except OSError:
            return False
        if newest > written:  # copied, fetched: not to be digested again
            with suppress(OSError):
                os.utime(folder / "manifest.json", ns=(newest, newest))
        return True

    def begin(self, node: str) -> Path:
        """A fresh temporary folder to write a result in."""
        try:
            parent = self.root / node
            parent.mkdir(parents=True, exist_ok=True)
            return Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=parent))
        except OSError as error:
            raise from_os_error(error, self.root) from None

    def checkpoint(self, node: str, key: str) -> Path:
        """A folder that outlives a killed run: what the same step left there of the same inputs and parameters."""
        place = self.root / node / f"{PART}{key}"
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise from_os_error(error, self.root) from None
        return place

    def commit(self, node: str, key: str, folder: Path, done: Done, about: Mapping[str, Any]) -> Manifest:
        """Move a finished result into place, replacing an incomplete one of the same key.

        Args:
            folder: what `begin` gave, holding the outputs.
            about: the manifest's version, params, inputs, fed, seconds and peak_mb.
        """
        sizes = {p.relative_to(folder).as_posix(): p.stat().st_size for p in sorted(folder.rglob("*")) if p.is_file()}
        digests = {name: digest(folder / name) for name in sizes}
        manifest = Manifest(
            label=node,
            content=content_of(digests),
            files={name: path.relative_to(folder).as_posix() for name, path in done.files.items()},
            sizes=sizes,
            digests=digests,
            facts=done.facts,
            warnings=done.warnings,
            **about,
        )
        self._place(manifest, key, folder)
        shutil.rmtree(self.root / node / f"{PART}{key}", ignore_errors=True)
        return manifest

    def contents(self, node: str) -> set[str]:
        """Digests of the contents of all results of a node, of whatever key."""
        keys = (path.parent.name for path in (self.root / node).glob("*/manifest.json"))
        return {manifest.content for manifest in (self.find(node, key) for key in keys) if manifest is not None}

    def adopt(self, node: str, key: str, fed: str, inputs: Mapping[str, str]) -> Manifest | None:
        """Take a result over that was made of the same contents by the same step, whatever made those; None: no such.

        What was made anew and came out the same ends the need to redo what depends on it.
        """
        for other in self.folder(node, key).parent.glob("*/manifest.json"):
            old = self.find(node, other.parent.name)
            if old is not None and old.fed == fed:
                folder = self.begin(node)
                try:
                    shutil.copytree(other.parent, folder, symlinks=True, copy_function=os.link, dirs_exist_ok=True)
                    (folder / "manifest.json").unlink()  # shared with the old result
                    manifest = replace(old, inputs=dict(inputs))
                    self._place(manifest, key, folder)
                except OSError:
                    return None  # no hard links here: it is made again
                finally:
                    shutil.rmtree(folder, ignore_errors=True)
                return manifest
        return None

    def _place(self, manifest: Manifest, key: str, folder: Path) -> None:
        """Write the manifest into a finished folder and move it into place."""
        try:
            body = asdict(manifest)
            text = json.dumps(body | {"seal": _seal(body)}, indent=1)
            (folder / "manifest.json").write_text(text, encoding="utf-8")
            place = self.folder(manifest.label, key)
            if place.is_symlink():
                place.unlink()
            elif place.exists():
                shutil.rmtree(place)
            folder.replace(place)
        except OSError as error:
            raise from_os_error(error, self.root) from None
        if self.remote is not None:  # the manifest last: with it the result counts
            self.remote.push(f"{manifest.label}/{key}/{name}" for name in (*manifest.sizes, "manifest.json"))

    def sweep(self, used: Mapping[str, str]) -> None:
        """Remove what `used` (node to key) does not name, leftovers of killed runs included."""
        for path in self.root.glob("*/*"):
            if used.get(path.parent.name) != path.name:
                shutil.rmtree(path, ignore_errors=True)
        for path in self.root.glob("*"):
            if path.name not in used and path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
