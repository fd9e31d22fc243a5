"""Files that aren't what their name says: empty, web pages, pointers, archives, links that lead nowhere, meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.foreign.case import Case
from bench.foreign.scan import scan

CONTENT = {
    "empty": (b"", r"is empty \(0 bytes\)"),
    "page": (b"<!DOCTYPE html><html><title>404 Not Found</title></html>", "is a web page"),
    "lfs": (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n", "Git LFS pointer"),
    "denied": (b"<?xml version='1.0'?><Error><Code>AccessDenied</Code></Error>", "is an XML document"),
    "archive": (b"PK\x03\x04....", "is a ZIP archive"),
    "zeros": (bytes(5000), "contains only zeros"),
}
SUFFIXES = (".las", ".laz", ".ply", ".pcd", ".e57", ".csv", ".xyz")
Make = Callable[[Path], Sequence[object]]


def cases() -> Iterator[Case]:
    """Cases of kinds 4 and 10."""
    for name, (content, says) in CONTENT.items():
        for suffix in SUFFIXES:
            yield Case(f"file-{name}{suffix}", 10, _file(f"cloud{suffix}", content), "rejected", says)
    yield Case("file-link-nowhere", 10, _link("/nowhere/cloud.laz"), "rejected", "is a link that leads nowhere")
    yield Case("file-link-loop", 10, _link("cloud.laz"), "rejected", "is a link that leads nowhere")
    yield Case("file-missing", 10, lambda folder: _import(folder / "gone.laz"), "rejected", "not found|doesn't exist")
    yield Case("file-missing-mesh", 10, lambda folder: _import(folder / "gone.obj"), "rejected", "not found")
    yield Case("file-folder", 10, _folder, "rejected", "folder")
    yield Case(
        "ply-named-las", 10, _file("cloud.las", _ply(scan().xyz[:100])), "rejected", "is a PLY file by its content"
    )
    yield Case("ply-mesh", 4, _file("cloud.ply", _mesh()), "rejected", "mesh")
    yield Case("ply-splats", 4, _file("cloud.ply", _splats()), "rejected", "splat")


def _import(path: Path) -> Sequence[object]:
    return ("import", "clouds", path, "--crs", "local", "--out", path.parent / "tile")


def _file(name: str, content: bytes) -> Make:
    def make(folder: Path) -> Sequence[object]:
        (folder / name).write_bytes(content)
        return _import(folder / name)

    return make


def _link(target: str) -> Make:
    def make(folder: Path) -> Sequence[object]:
        (folder / "cloud.laz").symlink_to(target)
        return _import(folder / "cloud.laz")

    return make


def _folder(folder: Path) -> Sequence[object]:
    (folder / "cloud.laz").mkdir()
    return _import(folder / "cloud.laz")


def _ply(xyz: np.ndarray, fields: Sequence[str] = (), faces: np.ndarray | None = None) -> bytes:
    names = ["x", "y", "z", *fields]
    rows = np.zeros((len(xyz), len(names)), "<f4")
    rows[:, :3] = xyz
    head = "".join(f"property float {name}\n" for name in names)
    more = "" if faces is None else f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    text = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{head}{more}end_header\n"
    body = b"" if faces is None else b"".join(b"\x03" + np.asarray(face, "<i4").tobytes() for face in faces)
    return text.encode() + rows.tobytes() + body


def _mesh() -> bytes:
    """A room of 10 x 8 x 3 m with twelve triangles."""
    corners = np.array([(x, y, z) for x in (0, 10) for y in (0, 8) for z in (0, 3)], float)
    faces = np.array(
        [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4),
         (1, 5, 7), (1, 7, 3)]
    )  # fmt: skip
    return _ply(corners, faces=faces)


def _splats() -> bytes:
    fields = (
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    )
    return _ply(scan().xyz[:500] - scan().xyz[0], fields)
