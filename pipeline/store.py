"""Where results are kept: one folder a result, named by a key of everything it came from.

```
ROOT/poisson.terrain/3f9a.../manifest.json   what was run, on what, how long, with which outputs
                            /mesh.npz        the outputs
```
A result is written to a temporary folder and moved into place, so that a killed run leaves nothing
half-made. A result counts as present while all its files are there with the sizes that the
manifest gives; a deleted output is rebuilt, and nothing that depends on it (same key, same bytes).
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import from_os_error
from pipeline.step import Done, Params, Step

KEY_LENGTH = 24
TEMPORARY = ".tmp-"


@dataclass(frozen=True)
class Manifest:
    """What is kept of a result beside its files.

    Attributes:
        label: the node's name in the recipe (`poisson.terrain`).
        version, params, inputs: what the key was made of; inputs are keys or digests by name.
        files: output name to path relative to the result's folder.
        sizes: bytes of every file below it.
        facts, warnings: as the step gave them.
        seconds, peak_mb: wall time and peak memory of the step's process and its children.
    """

    label: str
    version: int
    params: dict[str, Any]
    inputs: dict[str, str]
    files: dict[str, str]
    sizes: dict[str, int]
    facts: dict[str, Any]
    warnings: list[str]
    seconds: float
    peak_mb: float


def digest(path: Path) -> str:
    """SHA-256 of a source file; "missing" where it isn't there (the step says what that means)."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        return "missing"
    except OSError as error:
        raise from_os_error(error, path) from None


def key_of(step: Step, params: Params, inputs: Mapping[str, str]) -> str:
    """The key of a result: step, version, parameters and the keys of what it reads."""
    text = json.dumps([step.name, step.version, params.model_dump(mode="json"), dict(inputs)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


class Store:
    """Results below one folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def folder(self, label: str, key: str) -> Path:
        """Where the result is, or will be."""
        return self.root / label / key

    def find(self, label: str, key: str) -> Manifest | None:
        """The manifest of a complete result; None where it is absent or a file of it was deleted."""
        folder = self.folder(label, key)
        try:
            manifest = Manifest(**json.loads((folder / "manifest.json").read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None
        for name, size in manifest.sizes.items():
            path = folder / name
            if not path.is_file() or path.stat().st_size != size:
                return None
        return manifest

    def begin(self, label: str) -> Path:
        """A fresh temporary folder to write a result in."""
        try:
            parent = self.root / label
            parent.mkdir(parents=True, exist_ok=True)
            return Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=parent))
        except OSError as error:
            raise from_os_error(error, self.root) from None

    def commit(self, label: str, key: str, folder: Path, done: Done, about: Mapping[str, Any]) -> Manifest:
        """Move a finished result into place, replacing an incomplete one of the same key.

        Args:
            folder: what `begin` gave, holding the outputs.
            about: the manifest's version, params, inputs, seconds and peak_mb.
        """
        manifest = Manifest(
            label=label,
            files={name: path.relative_to(folder).as_posix() for name, path in done.files.items()},
            sizes={
                p.relative_to(folder).as_posix(): p.stat().st_size for p in sorted(folder.rglob("*")) if p.is_file()
            },
            facts=done.facts,
            warnings=done.warnings,
            **about,
        )
        try:
            text = json.dumps(asdict(manifest), indent=1)
            (folder / "manifest.json").write_text(text, encoding="utf-8")
            place = self.folder(label, key)
            if place.exists():
                shutil.rmtree(place)
            folder.replace(place)
        except OSError as error:
            raise from_os_error(error, self.root) from None
        return manifest

    def sweep(self, used: Mapping[str, str]) -> None:
        """Remove what `used` (label to key) does not name, leftovers of killed runs included."""
        for path in self.root.glob("*/*"):
            if used.get(path.parent.name) != path.name:
                shutil.rmtree(path, ignore_errors=True)
        for path in self.root.glob("*"):
            if path.name not in used and path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
