"""The page of third-party licences (docs/third-party.md), from the metadata of what is installed.

`python -m bench.packaging.third_party > docs/third-party.md`, in an environment with all extras (`make test` makes
one). Names,
versions and licences are what the packages say of themselves; shared libraries that a wheel brings in a folder of its
own (`*.libs`) are looked up in `BUNDLED`; what is linked into a wheel's own binaries no metadata tells: `NOTES` holds
what was found there. A library that isn't in the table is printed as such, and the exit status is 1.
"""

from __future__ import annotations

import importlib.metadata
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import Distribution
from itertools import compress

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from bench.paths import ROOT

FFMPEG, RUNTIME = "LGPL-2.1-or-later", "GPL-3.0-or-later WITH GCC-exception-3.1"
NETTLE = "LGPL-3.0-or-later OR GPL-2.0-or-later"
ECLIPSE = "EPL-2.0 OR BSD-3-Clause"
BUNDLED = {
    "aec": "BSD-2-Clause", "aom": "BSD-2-Clause", "asound": "LGPL-2.1-or-later", "avcodec": FFMPEG,
    "avdevice": FFMPEG, "avfilter": FFMPEG, "avformat": FFMPEG, "avif": "BSD-2-Clause", "avutil": FFMPEG,
    "blosc": "BSD-3-Clause", "brotlicommon": "MIT", "brotlidec": "MIT", "crypto": "OpenSSL (1.1) or Apache-2.0 (3)",
    "curl": "curl", "cycloneddsidl": ECLIPSE, "dav1d": "BSD-2-Clause", "ddsc": ECLIPSE,
    "deflate": "MIT", "drm": "MIT", "freetype": "FTL OR GPL-2.0-or-later",
    "gdal": "MIT", "geos": "LGPL-2.1-or-later", "geos_c": "LGPL-2.1-or-later", "gfortran": RUNTIME, "gif": "MIT",
    "gmp": NETTLE, "gnutls": "LGPL-2.1-or-later", "gomp": RUNTIME, "harfbuzz": "MIT", "hdf5": "BSD-3-Clause",
    "hdf5_hl": "BSD-3-Clause", "hogweed": NETTLE, "jpeg": "IJG AND BSD-3-Clause", "json-c": "MIT", "lcms2": "MIT",
    "Lerc": "Apache-2.0", "lzma": "0BSD", "mp3lame": "LGPL-2.0-or-later", "netcdf": "BSD-3-Clause", "nettle": NETTLE,
    "nghttp2": "MIT", "opencore-amrnb": "Apache-2.0", "opencore-amrwb": "Apache-2.0", "openblasp": "BSD-3-Clause",
    "openjp2": "BSD-2-Clause", "opus": "BSD-3-Clause", "pcre2": "BSD-3-Clause", "png16": "libpng-2.0",
    "proj": "MIT", "quadmath": "LGPL-2.1-or-later", "rdkafka": "BSD-2-Clause", "scipy_openblas": "BSD-3-Clause",
    "scipy_openblas64_": "BSD-3-Clause", "sharpyuv": "BSD-3-Clause", "sqlite3": "public domain",
    "ssl": "OpenSSL (1.1) or Apache-2.0 (3)", "SvtAv1Enc": "BSD-3-Clause-Clear", "swresample": FFMPEG,
    "swscale": FFMPEG, "sz": "BSD-2-Clause", "tbb": "Apache-2.0", "tiff": "libtiff", "unistring": NETTLE,
    "usd_ms": "LicenseRef-TOST-1.0", "vpl": "MIT", "vpx": "BSD-3-Clause",
    "webp": "BSD-3-Clause", "webpdemux": "BSD-3-Clause", "webpmux": "BSD-3-Clause",
    "x264": "GPL-2.0-or-later", "x265": "GPL-2.0-or-later", "Xau": "MIT", "xcb": "MIT", "xcb-shape": "MIT",
    "xcb-shm": "MIT", "xcb-xfixes": "MIT", "xerces-c": "Apache-2.0", "zstd": "BSD-3-Clause",
}  # fmt: skip
"""Licences of shared libraries by name, without "lib" and versions."""

NOTES = {
    "av": "its FFmpeg calls itself LGPL-3.0-or-later, but is linked with x264 and x265: the GPL holds for the whole",
    "llvmlite": "linked in: LLVM (Apache-2.0 WITH LLVM-exception)",
    "onnxruntime": "linked in: what its ThirdPartyNotices.txt tells, all permissive",
    "open3d-cpu": "linked in: FFmpeg (LGPL-2.1-or-later), librealsense (Apache-2.0), Intel MKL and IPP (Intel "
    "Simplified Software License), Embree, Assimp, Filament, Qhull and others under permissive licences",
    "opencv-python-headless": "linked in: Intel IPP-ICV (Intel Simplified Software License), and what its "
    "LICENSE-3RD-PARTY.txt tells",
    "openimageio": "linked in: OpenEXR, OpenColorIO, libtiff, libpng, libjpeg-turbo, libjxl, OpenJPEG, libwebp, "
    "giflib, FreeType and others under permissive licences",
    "pycolmap": "linked in: SuiteSparse, whose CHOLMOD (Supernodal) and SuiteSparseQR are GPL-2.0-or-later; Ceres, "
    "FAISS, METIS, OpenImageIO, PoseLib under permissive licences",
    "torch": "linked in: what its NOTICE tells; on Linux its default wheel asks for NVIDIA's CUDA packages, too",
}
"""What no metadata tells of wheels: what is linked into their binaries, as strings and symbols there show."""

PAGE = """# Third-party licences

Made by `python -m bench.packaging.third_party > docs/third-party.md`; don't edit it. Versions are those of
`constraints.txt`, on
Linux x86-64. scan2sim itself is under the [Apache License 2.0](../LICENSE). Its wheel holds no package of others but
three.js (MIT, `flows/reports/pages/three-LICENSE.txt`), which reports and `scan2sim view` show worlds by, and uPlot
1.6.32 (MIT, `services/pages/uplot-LICENSE.txt`), which live pages draw with. What follows is installed beside it, by
pip, from each project's own wheels.

This page tells what packages say of themselves; it is no legal advice.

## What to know before you ship it

Who runs scan2sim, or sells the worlds it makes, need not mind any of this: no licence here reaches what a program
writes. Who passes on an environment (an image, an appliance, an installer) passes on these, too:

| what | licence | comes with | what it asks for when you pass it on |
| --- | --- | --- | --- |
{attention}

Nothing that is GPL without an exception comes with the core. To ship without any GPL, leave out the extra `meshlab`,
one of four libraries that decimate, and the extras `slam`, `teleop` and `toolboxes`: what they do needs PyAV to read
and write videos (built against an FFmpeg without x264 and x265 it still reads them, and makes VP8), and pycolmap for
`slam --adjust` alone. Of the toolboxes' containers, that of `movement` alone holds PyAV
([toolboxes.md](toolboxes.md#containers)).
"""

ATTENTION = (
    ("x264, x265, and with them PyAV's whole FFmpeg", "GPL-2.0-or-later (GPL-3.0 in this combination)",
     "`slam`, `teleop`, `toolboxes` (by supervision): av",
     "source code of these libraries beside the binaries, and the GPL for what is linked with them; H.264 and H.265 "
     "may also need patent licences"),
    ("SuiteSparse in pycolmap's binary", "GPL-2.0-or-later", "`slam`: pycolmap",
     "as above, although COLMAP's own code is BSD"),
    ("MeshLab, all of it", "GPL-3.0", "`meshlab`: pymeshlab",
     "likewise; it also brings Qt 5 (LGPL) and what that is built with"),
    ("FFmpeg", "LGPL-2.1-or-later", "core: opencv-python-headless, open3d",
     "the licence's text and the source, and that users may put another build in its place; OpenCV's is a shared "
     "library, Open3D's is linked in (scan2sim reads no video by either)"),
    ("libquadmath", "LGPL-2.1-or-later", "core: numpy, scipy, opencv-python-headless",
     "the licence's text and the source; a shared library"),
    ("libgfortran, libgomp", "GPL-3.0 with the GCC Runtime Library Exception", "core: numpy, scipy",
     "nothing: the exception allows any use in compiled programs"),
    ("mp3lame, GnuTLS, nettle, GMP, libunistring, ALSA", "LGPL", "`slam`, `teleop`, `toolboxes`: av",
     "the licence's text and the source; shared libraries"),
    ("GEOS", "LGPL-2.1-or-later", "`rasters`: rasterio", "likewise"),
    ("python-can", "LGPL-3.0", "`can`",
     "the licence's text and the source, and that users may put another version in its place"),
    ("Intel MKL, IPP", "Intel Simplified Software License", "core: open3d, opencv-python-headless",
     "free to pass on unchanged, with its text; no source"),
    ("certifi, tqdm, orjson, pathspec", "MPL-2.0", "core (by open3d), `segmentation`, `flows`",
     "changes to their own files stay under the MPL"),
    ("text-unidecode", "Artistic License or GPL-2.0-or-later, as you choose", "`flows` (by prefect)",
     "nothing more than the Artistic License does"),
    ("CUDA (nvidia-* packages)", "NVIDIA's, proprietary", "`segmentation`: torch's default wheel",
     "as NVIDIA says; torch for processors alone comes without"),
)  # fmt: skip


UNTOLD = "UNKNOWN"
"""What setuptools wrote as the licence where there was none."""
NOT_HERE = ("dev", "meshlab")
"""Extras that the page has no table of: its environment has none of MeshLab, which wants libraries of a desktop."""


def project() -> dict[str, list[str]]:
    """What pyproject.toml asks for: "core", then each extra but those that `make test` makes no environment with."""
    about = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {name: requested for name, requested in about["optional-dependencies"].items() if name not in NOT_HERE}
    return {"core": about["dependencies"], **extras}


def closure(requested: Iterable[str]) -> dict[str, Distribution]:
    """Requirements and all that they require, as installed, by name.

    Raises:
        PackageNotFoundError: one isn't.
    """
    extras = project()
    found: dict[tuple[str, frozenset[str]], Distribution] = {}
    waiting = [Requirement(line) for line in requested]
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": ""}):
            continue
        if name == "scan2sim":
            waiting += [Requirement(line) for extra in wanted.extras for line in extras[extra]]
        elif (key := (name, frozenset(wanted.extras))) not in found:
            found[key] = importlib.metadata.distribution(name)
            waiting += _required(found[key], wanted.extras)
    return {name: found[name, extra] for name, extra in sorted(found, key=lambda key: key[0])}


def _required(package: Distribution, extras: Iterable[str]) -> Iterator[Requirement]:
    for line in package.requires or ():
        wanted = Requirement(line)
        if wanted.marker is None or any(wanted.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            wanted.marker = None
            yield wanted


def licence(package: Distribution) -> str:
    """What a package says that it is under."""
    about = package.metadata.json
    classified = [line.split(" :: ")[-1] for line in about.get("classifier", ()) if line.startswith("License ::")]
    told = about.get("license_expression") or ", ".join(classified) or about.get("license", UNTOLD)
    return titled(package) if told == UNTOLD else str(told).split("\n")[0]


def titled(package: Distribution) -> str:
    """The first line of a package's file LICENSE, for one whose metadata tells nothing."""
    file = next((path for path in package.files or () if path.name.startswith("LICENSE")), None)
    lines = file.read_text(encoding="utf-8").splitlines() if file else []
    return next((line.strip() for line in lines if line.strip()), "not told")


def brought(package: Distribution) -> list[str]:
    """Shared libraries in a wheel's folder of bundled ones, without "lib" and versions."""
    files = [path for path in package.files or () if path.parts[0].endswith(".libs") or path.name.startswith("libtbb.")]
    names = (re.sub(r"^lib|\.so.*$|-[0-9a-f]{8}(?![0-9a-f])", "", path.name) for path in files)
    return sorted({re.sub(r"-r?\d[\d.]*$", "", name) for name in names})


def table(packages: dict[str, Distribution]) -> tuple[str, list[str]]:
    """Rows of packages, and bundled libraries whose licence nobody looked up."""
    rows, unknown = ["| package | version | licence | brings |", "| --- | --- | --- | --- |"], []
    for name, package in packages.items():
        libraries = brought(package)
        unknown += [library for library in libraries if library not in BUNDLED]
        kinds = [BUNDLED.get(library, "not looked up") for library in libraries]
        parts = [
            f"{one}: {', '.join(compress(libraries, (other == one for other in kinds)))}" for one in sorted({*kinds})
        ]
        parts += [NOTES[name]] if name in NOTES else []
        rows.append(f"| {name} | {package.version.split('+')[0]} | {licence(package)} | {'; '.join(parts)} |")
    return "\n".join(rows), unknown


def page() -> tuple[str, list[str]]:
    """The page, and bundled libraries whose licence nobody looked up."""
    text = PAGE.format(attention="\n".join(f"| {' | '.join(row)} |" for row in ATTENTION))
    shown: set[str] = set()
    unknown: list[str] = []
    for part, requested in project().items():
        packages = {name: package for name, package in closure(requested).items() if name not in shown}
        shown |= packages.keys()
        rows, missing = table(packages)
        unknown += missing
        title = "Core" if part == "core" else f"The extra `{part}`"
        text += f"\n## {title}\n\n{rows if packages else 'Nothing more.'}\n"
    return text, unknown


def main() -> None:
    """Print the page."""
    text, unknown = page()
    print(text, end="")
    if unknown:
        sys.exit(f"not in BUNDLED: {', '.join(sorted(set(unknown)))}")


if __name__ == "__main__":
    main()
