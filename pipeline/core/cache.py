"""Cache of step results: one folder per result, named by a key (hash) of the step, its parameters and its inputs.

```
ROOT/poisson.terrain/3f9a.../manifest.json   step, inputs, run time, outputs and metrics
                            /mesh.npz        the outputs
ROOT/label/.parts/17be.../                   results of single photos, for the next run (`pipeline.core.parts`)
ROOT/track/.part-81c2.../                    checkpoint of a step that can resume after it was killed
```
A result is written to a temporary folder and moved into place, so that a killed run leaves no partial result. A cached
result is valid while all its files exist with the sizes recorded in the manifest and none is newer than the manifest;
a newer file is hashed and accepted if its SHA-256 still matches (a copied file, for example). Before a step reads a
result of an earlier run, all its bytes are hashed (`intact`). A deleted or damaged result is rebuilt; results that
depend on it stay valid, because the rebuilt one has the same key and the same bytes.

A manifest holds a digest of itself; one that doesn't match it, or that names files outside its folder, is invalid.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from stat import S_ISREG
from typing import Any

from scan2sim.pipeline.core.errors import InputError, from_os_error
from scan2sim.pipeline.core.parts import Parts
from scan2sim.pipeline.core.paths import check_inside, new_folder
from scan2sim.pipeline.core.remote import Remote
from scan2sim.pipeline.core.step import Done, Params, Step

KEY_LENGTH = 24
SETTLED_NS = 2_000_000_000
"""Age below which a file's times don't show whether it was written again (FAT: 2 s)."""
TEMPORARY_PREFIX, CHECKPOINT_PREFIX, PARTS = ".tmp-", ".part-", ".parts"


@dataclass(frozen=True)
class Manifest:
    """Metadata of a cached result, stored beside its files.

    Attributes:
        label: full name of its task (`poisson.terrain`).
        version, params, inputs: what the key was computed from; inputs are keys or digests by name.
        inputs_digest: like the key, but computed from the contents of the inputs (files of the outputs that it reads)
            instead of their keys (cache hit by content).
        content: digest of all files.
        files: output name to path relative to the result's folder.
        sizes: bytes of every file below it.
        digests: SHA-256 of each of them.
        metrics, warnings: of the step.
        seconds, cpu_seconds, peak_mb: wall time, CPU time of all its threads, and peak memory of the step's process and
            its children.
        failed: parts of the result that failed, by name: where, cause, remedy, and the traceback if there is one. Only
            the run that made such a result uses it.
    """

    label: str
    version: int
    params: dict[str, Any]
    inputs: dict[str, str]
    inputs_digest: str
    content: str
    files: dict[str, str]
    sizes: dict[str, int]
    digests: dict[str, str]
    metrics: dict[str, Any]
    warnings: list[str]
    seconds: float
    peak_mb: float
    failed: dict[str, list[str]] = field(default_factory=dict)
    cpu_seconds: float = 0.0

    def content_of(self, output: str) -> str:
        """Digest of the files of one output, and of those that belong to no output."""
        paths = self.files.values()
        own = self.files[output]
        return content_of(
            {
                file: found
                for file, found in self.digests.items()
                if _is_at(file, own) or not any(_is_at(file, path) for path in paths)
            }
        )


def _is_at(file: str, path: str) -> bool:
    return file == path or file.startswith(f"{path}/")


def digest(path: Path) -> str:
    """SHA-256 of a source file, or of a folder's files by name; "missing" if there is none (the step reports that)."""
    try:
        if path.is_dir():
            return content_of({file.name: digest(file) for file in path.iterdir() if file.is_file()})
        if path.exists() and not path.is_file():
            return "missing"  # reading a pipe could block for ever
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        raise from_os_error(error, path) from None


class Digests:
    """`digest`, cached in a file for sources whose size, times and inode are unchanged.

    A kilometre of survey is gigabytes: detecting changes must not read all of it again. The time of the last change of
    the status counts as well: programs can set the modification time, as "cp -p" and rsync do.

    Args:
        file: where the digests are cached.
        clock: time in nanoseconds since the epoch.
    """

    def __init__(self, file: Path, clock: Callable[[], int] = time.time_ns) -> None:
        self._file, self._clock = file, clock
        try:
            self._known: dict[str, list[Any]] = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            self._known = {}
        self._used: dict[str, list[Any]] = {}

    def __call__(self, path: Path) -> str:
        """SHA-256 of a file or folder, in hex; taken from the cache for an unchanged file."""
        try:
            stat = path.stat()
        except OSError:
            return digest(path)
        if path.is_dir():
            return content_of({file.name: self(file) for file in path.iterdir() if file.is_file()})
        fingerprint = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
        cached = self._known.get(str(path))
        settled = stat.st_ctime_ns < self._clock() - SETTLED_NS
        found = cached[-1] if cached and cached[:-1] == fingerprint else digest(path)
        if settled:
            self._used[str(path)] = [*fingerprint, found]
        return str(found)

    def save(self) -> None:
        """Write the digests that were requested since this object was created."""
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            temporary = self._file.with_suffix(".tmp")
            temporary.write_text(json.dumps(self._used), encoding="utf-8")
            temporary.replace(self._file)
        except OSError as error:
            raise from_os_error(error, self._file) from None


def content_of(digests: Mapping[str, str]) -> str:
    """Digest of all files of a result, computed from their names and digests."""
    combined = hashlib.sha256()
    for name in sorted(digests):
        combined.update(f"{name}\0{digests[name]}\n".encode(errors="surrogateescape"))  # names may not be UTF-8
    return combined.hexdigest()


def _seal(body: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def read_manifest(path: Path) -> Manifest | None:
    """Read a manifest; None if it is missing, was altered, or names files outside its folder."""
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
        if body.pop("seal") != _seal(body):
            return None
        manifest = Manifest(**body)
        if manifest.sizes.keys() != manifest.digests.keys():
            return None
        check_inside(path.parent, [*manifest.sizes, *manifest.files.values()])
        outputs = [path.parent / name for name in manifest.files.values()]
        links = [output.resolve() for output in outputs if output.is_symlink()]
        return manifest if all(file.is_relative_to(path.parent.resolve()) for file in links) else None
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError, InputError):
        return None


def damaged(folder: Path, manifest: Manifest) -> list[str]:
    """Names of the files of a result whose bytes no longer match the manifest."""
    return [name for name, expected in manifest.digests.items() if digest(folder / name) != expected]


def key_of(step: Step, params: Params, inputs: Mapping[str, str]) -> str:
    """Cache key of a result: hash of step name, version, parameters and the keys of its inputs."""
    text = json.dumps([step.name, step.version, params.model_dump(mode="json"), dict(inputs)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


class Store:
    """Cached results below one folder, by `task` (its full name in the pipeline, `poisson.terrain`) and key.

    Args:
        root: the folder.
        remote: object storage that mirrors `root`, for machines that share no disk.
        sources: storage from which files of the survey that aren't on this machine are fetched.
    """

    def __init__(self, root: Path, remote: Remote | None = None, sources: Remote | None = None) -> None:
        self.root, self.remote, self.sources = root, remote, sources
        self._verified: set[Path] = set()  # folders of results that this run has made or hashed

    def within(self, name: str) -> Store:
        """The store of the tasks whose full names begin with `name/`."""
        store = Store(self.root / name, self.remote and self.remote.below(name), self.sources)
        store._verified = self._verified
        return store

    def folder(self, task: str, key: str) -> Path:
        """Folder of a result, which may not exist yet."""
        return self.root / task / key

    def find(self, task: str, key: str) -> Manifest | None:
        """The manifest of a complete result; None if it is absent or one of its files was deleted or changed."""
        manifest = self._manifest(task, key)
        if manifest is None or self._complete(task, key, manifest):
            return manifest
        return manifest if self.remote is not None else None  # `read` fetches its files

    def keys(self, task: str) -> list[str]:
        """Keys of the task's results on this machine, valid or not."""
        try:
            return [path.name for path in (self.root / task).iterdir() if not path.name.startswith(".")]
        except OSError:
            return []

    def newest(self, task: str) -> Manifest | None:
        """The manifest of the task's newest result on this machine; None if there is none."""
        keys = self.keys(task)
        return self._manifest(task, max(keys, key=lambda k: self.folder(task, k).stat().st_mtime)) if keys else None

    def read(self, task: str, key: str) -> Manifest | None:
        """As `find`, and fetch its files to this machine."""
        manifest = self.find(task, key)
        if manifest is not None and self.remote is not None and not self._complete(task, key, manifest):
            return manifest if self.remote.pull(f"{task}/{key}/{name}" for name in manifest.sizes) else None
        return manifest

    def intact(self, task: str, key: str) -> bool:
        """Whether all files of a result are on this machine with unchanged bytes (SHA-256)."""
        folder = self.folder(task, key)
        if folder in self._verified:
            return True
        manifest = self.read(task, key)
        if manifest is not None and self.remote is not None and damaged(folder, manifest):
            shutil.rmtree(folder, ignore_errors=True)  # a fetched copy: the storage holds the original
            manifest = self.read(task, key)
        if manifest is None or damaged(folder, manifest):
            return False
        self.mark_verified(task, key)
        return True

    def mark_verified(self, task: str, key: str) -> None:
        """Skip further integrity checks of a result: it was made in this run, or has been hashed."""
        self._verified.add(self.folder(task, key))

    def is_verified(self, task: str, key: str) -> bool:
        """Whether `mark_verified` was called for a result."""
        return self.folder(task, key) in self._verified

    def discard(self, task: str, key: str) -> None:
        """Remove a result, from remote storage as well."""
        self._verified.discard(self.folder(task, key))
        if self.remote is not None:
            self.remote.remove(f"{task}/{key}/manifest.json")
        shutil.rmtree(self.folder(task, key), ignore_errors=True)

    def revalidate(self, task: str = "", key: str = "") -> None:
        """Let a network drive show what other machines have written below the root, or as a result.

        NFS caches for up to a minute that a file is absent; opening a folder compares it with the server's.
        """
        folder = self.root
        for name in ("", *task.split("/"), key):
            folder = folder / name
            with suppress(OSError):
                os.scandir(folder).close()

    def source(self, path: Path, expected: str | None = None) -> Path:
        """A source file, fetched from `sources` if it isn't on this machine, or if its copy here is an older one.

        Args:
            path: the file, below the local folder of `sources`; others are left as they are.
            expected: its SHA-256 when the run was planned; None: any.

        Raises:
            InputError: it has changed in the storage since then.
        """
        if self.sources is None or path.is_dir() or not path.is_relative_to(self.sources.local):
            return path
        if not path.exists() or (expected is not None and digest(path) != expected):
            name = path.relative_to(self.sources.local).as_posix()
            self.sources.pull([name])
            if expected is not None and digest(path) != expected:
                raise InputError(
                    f"{self.sources.url}/{name}", "has changed during the run", "Run again once all files are uploaded"
                )
        return path

    def _manifest(self, task: str, key: str) -> Manifest | None:
        path = self.folder(task, key) / "manifest.json"
        if self.remote is not None and not path.is_file():
            self.remote.pull([f"{task}/{key}/manifest.json"])
        manifest = read_manifest(path)
        return manifest if manifest is not None and f"/{manifest.label}".endswith(f"/{task}") else None

    def _complete(self, task: str, key: str, manifest: Manifest) -> bool:
        folder = self.folder(task, key)
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
        if newest > written:  # copied or fetched files: don't hash them again
            with suppress(OSError):
                os.utime(folder / "manifest.json", ns=(newest, newest))
        return True

    def begin(self, task: str) -> Path:
        """Create a temporary folder to write a result in."""
        try:
            parent = self.root / task
            parent.mkdir(parents=True, exist_ok=True)
            return new_folder(parent, TEMPORARY_PREFIX)
        except OSError as error:
            raise from_os_error(error, self.root) from None

    def checkpoint(self, task: str, key: str) -> Path:
        """Checkpoint folder: survives a killed run, for the same step with the same inputs and parameters."""
        target = self.root / task / f"{CHECKPOINT_PREFIX}{key}"
        try:
            target.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise from_os_error(error, self.root) from None
        return target

    def parts(self, task: str, step: Step) -> Parts:
        """Parts of the task's earlier results, on this machine."""
        return Parts(self.root / task / PARTS, step.name, step.version)

    def commit(self, task: str, key: str, folder: Path, done: Done, about: Mapping[str, Any]) -> Manifest:
        """Move a finished result into place, replacing an incomplete one of the same key.

        Args:
            folder: the folder from `begin`, holding the outputs.
            about: the manifest's version, params, inputs, inputs_digest, seconds, cpu_seconds and peak_mb.
        """
        sizes = {p.relative_to(folder).as_posix(): p.stat().st_size for p in sorted(folder.rglob("*")) if p.is_file()}
        digests = {name: digest(folder / name) for name in sizes}
        manifest = Manifest(
            label=task,
            content=content_of(digests),
            files={name: path.relative_to(folder).as_posix() for name, path in done.files.items()},
            sizes=sizes,
            digests=digests,
            metrics=done.metrics,
            warnings=done.warnings,
            failed={
                name: [error.where, error.cause, error.remedy, *getattr(error, "__notes__", ())]
                for name, error in done.failed.items()
            },
            **about,
        )
        self._place(manifest, key, folder)
        shutil.rmtree(self.root / task / f"{CHECKPOINT_PREFIX}{key}", ignore_errors=True)
        return manifest

    def contents(self, task: str) -> set[str]:
        """Content digests of all cached results of a task, under any key."""
        keys = (path.parent.name for path in (self.root / task).glob("*/manifest.json"))
        return {manifest.content for manifest in (self.find(task, key) for key in keys) if manifest is not None}

    def reuse_same_content(self, task: str, key: str, inputs_digest: str, inputs: Mapping[str, str]) -> Manifest | None:
        """Cache hit by content: reuse a result of the same step on inputs with the same bytes; None if there is none.

        If an input was rebuilt with the same bytes, nothing that depends on it runs again (early cutoff).
        """
        for other in self.folder(task, key).parent.glob("*/manifest.json"):
            old = self.find(task, other.parent.name)
            if old is not None and not old.failed and old.inputs_digest == inputs_digest:
                folder = self.begin(task)
                try:
                    shutil.copytree(other.parent, folder, symlinks=True, copy_function=os.link, dirs_exist_ok=True)
                    (folder / "manifest.json").unlink()  # shared with the old result
                    manifest = replace(old, inputs=dict(inputs))
                    self._place(manifest, key, folder)
                except OSError:
                    return None  # hard links are not supported here: the step runs again
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
            if not self._has_same(manifest, key):
                self._move(folder, self.folder(manifest.label, key))
        except OSError as error:
            raise from_os_error(error, self.root) from None
        if self.remote is not None:  # the manifest last: it makes the result valid
            self.remote.push(f"{manifest.label}/{key}/{name}" for name in (*manifest.sizes, "manifest.json"))

    def _has_same(self, manifest: Manifest, key: str) -> bool:
        """Whether an intact result with the same files is in place: of a worker that had lost its network, say.

        Readers on other machines may have its files open, so it stays.
        """
        folder = self.folder(manifest.label, key)
        if self.remote is not None or manifest.failed or folder.is_symlink():
            return False
        found = self.find(manifest.label, key)
        return not (found is None or found.failed or found.content != manifest.content or damaged(folder, found))

    def _move(self, folder: Path, target: Path) -> None:
        """Move a finished folder into place; an older one there, also one that appears meanwhile, is removed."""
        while True:
            try:
                folder.replace(target)
                return
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY) and not os.path.lexists(target):
                    raise
            aside = new_folder(target.parent, TEMPORARY_PREFIX)
            with suppress(FileNotFoundError):
                target.replace(aside / "replaced")
            shutil.rmtree(aside, ignore_errors=True)  # NFS keeps open files; `sweep` removes what is left

    def sweep(self, used: Mapping[str, str]) -> None:
        """Remove all results that `used` (task to key) does not name, and what killed runs left behind."""
        for path in self.root.glob("*/*"):
            if path.name not in (used.get(path.parent.name), PARTS):
                shutil.rmtree(path, ignore_errors=True)
        for path in self.root.glob("*"):
            if path.name not in used and path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
