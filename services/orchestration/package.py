"""Packages as OSM takes them: descriptor, checksums and charts in a folder, `.tar.gz`; read without trusting them."""

from __future__ import annotations

import gzip
import hashlib
import io
import tarfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.orchestration import chart, descriptor, sol006
from scan2sim.services.orchestration.description import Description
from scan2sim.services.orchestration.descriptor import Descriptor
from scan2sim.services.orchestration.sol006 import Kind
from scan2sim.services.qos.requirements import Environment

CHECKSUMS = "checksums.txt"
CHARTS = "helm-chart-v3s"
"""Folder of charts that come with a package, as OSM's lifecycle manager looks for them."""
LARGEST = 64 * 2**20
"""Bytes of a package's files together, unpacked."""
MOST = 1000
"""Files of a package."""
REMEDY = "Make it anew: scan2sim orchestrate package"


@dataclass(frozen=True)
class Package:
    """Of a function or a network service.

    Attributes:
        name: of the file, without its suffixes.
        data: all of it, as `.tar.gz`.
        descriptor: in it.
    """

    name: str
    data: bytes
    descriptor: Descriptor

    @property
    def md5(self) -> str:
        """As `Content-File-MD5` has it."""
        return _md5(self.data)

    def save(self, folder: Path) -> Path:
        """Write it into a folder."""
        path = folder / f"{self.name}.tar.gz"
        path.write_bytes(self.data)
        return path


@dataclass(frozen=True)
class Packages:
    """Of a service: its function, and the network service around it."""

    function: Package
    service: Package


def build(
    service: Description, environment: Environment, kind: Kind, prefix: str = "scan2sim", repository: str | None = None
) -> Packages:
    """Make a service's packages; what is the same gives the same bytes and ids.

    Args:
        prefix: of the ids; the digest of what a package holds ends them, so that none is ever changed under its id.
        repository: of OSM, with a chart of the service's name; None: the chart comes with the package.

    Raises:
        SettingError: the service isn't meant to run there.
    """
    needs = service.needed(environment)
    charts = {}
    if kind == "container" and repository is None:
        folder = f"{CHARTS}/{service.name}"
        charts = {f"{folder}/{path}": text for path, text in chart.files(service, needs, "1.0.0").items()}
    named = f"{repository}/{service.name}" if repository else service.name

    def function(name: str, version: str) -> dict[str, Any]:
        return sol006.vnfd(service, needs, kind, name, version, named)

    digest = _digest(function("", ""), charts, sol006.nsd(service, needs, "", "", ""))
    name, version = f"{prefix}-{service.name}-{digest}", f"1.0+{digest}"
    return Packages(
        _packed(f"{name}_vnfd", function(name, version), charts),
        _packed(f"{name}_nsd", sol006.nsd(service, needs, name, version, name), {}),
    )


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:8]


def _packed(name: str, body: dict[str, Any], others: dict[str, str]) -> Package:
    import yaml

    files = {f"{name}.yaml": yaml.safe_dump(body, sort_keys=False, allow_unicode=True)} | others
    sums = "".join(f"{_md5(text.encode())}\t{path}\n" for path, text in files.items())
    data = io.BytesIO()
    with gzip.GzipFile(fileobj=data, mode="wb", mtime=0) as packed, tarfile.open(fileobj=packed, mode="w") as archive:
        for path, text in (files | {CHECKSUMS: sums}).items():
            member = tarfile.TarInfo(f"{name}/{path}")
            member.size, member.mode = len(text.encode()), 0o644
            archive.addfile(member, io.BytesIO(text.encode()))
    return Package(name, data.getvalue(), descriptor.checked(body, name))


def read(path: Path) -> Package:
    """Read a package's file; whether it is of a function or a network service its descriptor says, not its name.

    Raises:
        InputError: it is no such archive, would write elsewhere, is too large, or holds no descriptor that is right.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST:
            raise InputError(path, f"is of {size:,} bytes, more than {LARGEST:,}", "No package is")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "Give a package's file, .tar.gz") from None
    return unpacked(data, path)


def unpacked(data: bytes, where: str | Path) -> Package:
    """A package of its bytes.

    Raises:
        InputError: as `read`.
    """
    if data[:2] == b"PK":
        raise InputError(where, "is a ZIP", "Give the package as .tar.gz")
    files = dict(_files(data, where))
    tops = {path.parts[0] for path in files}
    if len(tops) != 1 or any(len(path.parts) < 2 for path in files):
        raise InputError(where, "doesn't hold one folder with all files in it", REMEDY)
    folder = PurePosixPath(tops.pop())
    described = [path for path in files if path.parent == folder and path.suffix in (".yaml", ".yml")]
    if len(described) != 1:
        raise InputError(where, f"holds {len(described)} descriptors (.yaml) at its top", "There must be one")
    if sums := files.get(folder / CHECKSUMS):
        _check_sums(_text(sums, where), folder, files, where)
    found = descriptor.read(_text(files[described[0]], where), f"{where}: {described[0].name}")
    name = Path(where).name.removesuffix(".gz").removesuffix(".tar").removesuffix(".tgz")
    return Package(name, data, found)


def _files(data: bytes, where: str | Path) -> Iterator[tuple[PurePosixPath, bytes]]:
    """Files of an archive, each looked at before it is read."""
    count = 0
    try:
        with tarfile.open(fileobj=_Bounded(data, where), mode="r|") as archive:
            for member in archive:
                count += 1
                path = PurePosixPath(member.name)
                if path.is_absolute() or ".." in path.parts or "\0" in member.name:
                    raise InputError(where, f"holds {member.name!r:.100}, outside of itself", REMEDY)
                if not (member.isreg() or member.isdir()):
                    raise InputError(where, f"holds {member.name!r:.100}, a link or a device", REMEDY)
                if count > MOST:
                    raise InputError(where, f"holds more than {MOST:,} files", "No package does")
                if member.isreg():
                    content = archive.extractfile(member)
                    yield path, content.read() if content else b""
    except (tarfile.TarError, EOFError, OSError, zlib.error, UnicodeError) as error:
        raise InputError(where, f"is no .tar.gz that can be read ({error})", REMEDY) from None


class _Bounded(io.RawIOBase):
    """An archive as it is unpacked, so far and no further."""

    def __init__(self, data: bytes, where: str | Path) -> None:
        self._packed, self._left, self._where = gzip.GzipFile(fileobj=io.BytesIO(data)), LARGEST, where

    def read(self, size: int = -1) -> bytes:
        part = self._packed.read(min(size if size >= 0 else LARGEST, 2**20))
        self._left -= len(part)
        if self._left < 0:
            raise InputError(self._where, f"holds more than {LARGEST:,} bytes", "No package does")
        return part


def _check_sums(text: str, folder: PurePosixPath, files: dict[PurePosixPath, bytes], where: str | Path) -> None:
    for line in text.splitlines():
        asked, _, name = line.strip().partition("\t" if "\t" in line else " ")
        content = files.get(folder / name.strip())
        if content is None:
            raise InputError(where, f"lacks {name.strip():.100}, which {CHECKSUMS} lists", REMEDY)
        if _md5(content) != asked:
            raise InputError(where, f"{name.strip():.100} isn't what {CHECKSUMS} says", REMEDY)


def _md5(content: bytes) -> str:
    return hashlib.md5(content, usedforsecurity=False).hexdigest()


def _text(content: bytes, where: str | Path) -> str:
    try:
        return content.decode("utf-8")
    except UnicodeError:
        raise InputError(where, "holds text that isn't UTF-8", "Save it as UTF-8") from None
