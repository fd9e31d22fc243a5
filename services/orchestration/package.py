"""OSM packages: .tar.gz of one folder with descriptor, checksums and charts. Uploaded packages are validated."""

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
from scan2sim.services.orchestration.sol006 import FunctionKind
from scan2sim.services.qos.requirements import Environment

CHECKSUMS = "checksums.txt"
CHARTS_FOLDER = "helm-chart-v3s"
"""Folder of the charts in a package, where OSM's lifecycle manager looks for them."""
MAX_BYTES = 64 * 2**20
"""Maximum size of a package, compressed and unpacked."""
MAX_FILES = 1000
"""Maximum number of files in a package."""
REMEDY = "Build it again (`scan2sim orchestrate package`, or `osm package-build`)"


@dataclass(frozen=True)
class Package:
    """Package of a function or a network service.

    Attributes:
        name: file name without suffixes.
        data: the whole .tar.gz file.
        descriptor: the descriptor in it.
    """

    name: str
    data: bytes
    descriptor: Descriptor

    @property
    def md5(self) -> str:
        """MD5 sum for the `Content-File-MD5` header."""
        return _md5(self.data)

    def save(self, folder: Path) -> Path:
        """Write the package into a folder and return its path."""
        path = folder / f"{self.name}.tar.gz"
        path.write_bytes(self.data)
        return path


@dataclass(frozen=True)
class Packages:
    """Packages of a service: its function and its network service."""

    function: Package
    service: Package


def build(
    service: Description,
    environment: Environment,
    kind: FunctionKind,
    prefix: str = "scan2sim",
    repository: str | None = None,
) -> Packages:
    """Build a service's packages; the same input gives the same bytes and ids.

    Args:
        prefix: prefix of the ids. They end with a digest of the content, so that a package never changes under its id.
        repository: Helm repository in OSM that has a chart of the service's name; None: the package includes the chart.

    Raises:
        SettingError: the service isn't meant for this environment.
    """
    needs = service.requirements_in(environment)
    charts = {}
    if kind == "container" and repository is None:
        folder = f"{CHARTS_FOLDER}/{service.name}"
        charts = {f"{folder}/{path}": text for path, text in chart.files(service, needs, "1.0.0").items()}
    chart_name = f"{repository}/{service.name}" if repository else service.name

    def function(name: str, version: str) -> dict[str, Any]:
        return sol006.vnfd(service, needs, kind, name, version, chart_name)

    digest = _digest(function("", ""), charts, sol006.nsd(service, needs, "", "", ""))
    name, version = f"{prefix}-{service.name}-{digest}", f"1.0+{digest}"
    return Packages(
        _pack(f"{name}_vnfd", function(name, version), charts),
        _pack(f"{name}_nsd", sol006.nsd(service, needs, name, version, name), {}),
    )


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:8]


def _pack(name: str, body: dict[str, Any], others: dict[str, str]) -> Package:
    import yaml

    files = {f"{name}.yaml": yaml.safe_dump(body, sort_keys=False, allow_unicode=True)} | others
    sums = "".join(f"{_md5(text.encode())}\t{path}\n" for path, text in files.items())
    data = io.BytesIO()
    with (
        gzip.GzipFile(fileobj=data, mode="wb", mtime=0) as compressed,
        tarfile.open(fileobj=compressed, mode="w") as archive,
    ):
        for path, text in (files | {CHECKSUMS: sums}).items():
            member = tarfile.TarInfo(f"{name}/{path}")
            member.size, member.mode = len(text.encode()), 0o644
            archive.addfile(member, io.BytesIO(text.encode()))
    return Package(name, data.getvalue(), descriptor.validate(body, name))


def read(path: Path) -> Package:
    """Read a package file. Its descriptor, not its name, decides whether it is of a function or a network service.

    Raises:
        InputError: not a .tar.gz, too large, paths that leave the archive's folder, or no valid descriptor.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(path, f"too large: {size:,} bytes, the limit is {MAX_BYTES:,}", "Give an OSM package")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "Give a package file (.tar.gz)") from None
    return parse(data, path)


def parse(data: bytes, where: str | Path) -> Package:
    """Read a package from the bytes of its file.

    Raises:
        InputError: see `read`.
    """
    if data[:2] == b"PK":
        raise InputError(where, "is a ZIP file", "Give the package as .tar.gz")
    files = dict(_files(data, where))
    tops = {path.parts[0] for path in files}
    if len(tops) != 1 or any(len(path.parts) < 2 for path in files):
        raise InputError(where, "must contain exactly one folder with all its files", REMEDY)
    folder = PurePosixPath(tops.pop())
    descriptors = [path for path in files if path.parent == folder and path.suffix in (".yaml", ".yml")]
    if len(descriptors) != 1:
        raise InputError(where, f"contains {len(descriptors)} descriptors (.yaml) at its top level", "Keep exactly one")
    if sums := files.get(folder / CHECKSUMS):
        _check_sums(_text(sums, where), folder, files, where)
    found = descriptor.read(_text(files[descriptors[0]], where), f"{where}: {descriptors[0].name}")
    name = Path(where).name.removesuffix(".gz").removesuffix(".tar").removesuffix(".tgz")
    return Package(name, data, found)


def _files(data: bytes, where: str | Path) -> Iterator[tuple[PurePosixPath, bytes]]:
    """Files of an archive; each entry is checked before its content is read.

    Links, such as those of charms to their code, are left to OSM if they stay inside the archive.
    """
    count = 0
    try:
        with tarfile.open(fileobj=_BoundedReader(data, where), mode="r|") as archive:
            for member in archive:
                count += 1
                path = PurePosixPath(member.name)
                if path.is_absolute() or ".." in path.parts or "\0" in member.name:
                    raise InputError(where, f"path traversal: {member.name!r:.100} is outside of the archive", REMEDY)
                if member.issym() or member.islnk():
                    if not _stays_inside(path, member):
                        cause = f"contains {member.name!r:.100}, a link that leaves the archive"
                        raise InputError(where, cause, "Replace the link by what it leads to")
                elif not (member.isreg() or member.isdir()):
                    raise InputError(where, f"contains {member.name!r:.100}, a device or pipe", "Remove it")
                if count > MAX_FILES:
                    raise InputError(where, f"contains more than {MAX_FILES:,} files", "Give an OSM package")
                if member.isreg():
                    content = archive.extractfile(member)
                    yield path, content.read() if content else b""
    except (tarfile.TarError, EOFError, OSError, zlib.error, UnicodeError) as error:
        raise InputError(where, f"not a readable .tar.gz ({error})", REMEDY) from None


def _stays_inside(path: PurePosixPath, link: tarfile.TarInfo) -> bool:
    """Whether a link leads to a path inside the top folder of its archive."""
    target = PurePosixPath(link.linkname) if link.islnk() else path.parent / link.linkname
    depth = 0
    for part in target.parts:
        depth += -1 if part == ".." else 1
        if depth < 1:
            return False
    return not target.is_absolute()


class _BoundedReader(io.RawIOBase):
    """Decompressed archive, with a limit on its size against decompression bombs."""

    def __init__(self, data: bytes, where: str | Path) -> None:
        self._compressed, self._left, self._where = gzip.GzipFile(fileobj=io.BytesIO(data)), MAX_BYTES, where

    def read(self, size: int = -1) -> bytes:
        part = self._compressed.read(min(size if size >= 0 else MAX_BYTES, 2**20))
        self._left -= len(part)
        if self._left < 0:
            raise InputError(self._where, f"contains more than {MAX_BYTES:,} bytes", "Give an OSM package")
        return part


def _check_sums(text: str, folder: PurePosixPath, files: dict[PurePosixPath, bytes], where: str | Path) -> None:
    """Check the sums: SUM NAME per line, the name with the folder (as OSM's tools write it) or without."""
    for line in filter(str.strip, text.splitlines()):
        expected, _, rest = line.strip().partition("\t" if "\t" in line else " ")
        name = PurePosixPath(rest.strip().removeprefix("*"))
        content = files.get(folder / name, files.get(name))
        if content is None:
            raise InputError(where, f"{name!s:.100}, listed in {CHECKSUMS}, is missing", REMEDY)
        if _md5(content) != expected.lower():
            raise InputError(where, f"{name!s:.100} doesn't match its checksum in {CHECKSUMS}", REMEDY)


def _md5(content: bytes) -> str:
    return hashlib.md5(content, usedforsecurity=False).hexdigest()


def _text(content: bytes, where: str | Path) -> str:
    try:
        return content.decode("utf-8")
    except UnicodeError:
        raise InputError(where, "contains text that isn't UTF-8", "Save it as UTF-8") from None
