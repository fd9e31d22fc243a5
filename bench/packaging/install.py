"""What an installation downloads and unpacks, and what importing it costs.

`python -m bench.packaging.install [--project .] [--extra NAME] [--parts wheels packages imports]`

- wheels: what `pip install -c constraints.txt PROJECT[EXTRA]` downloads into an empty environment of the Python that
  runs this, from PyPI alone (pip's configuration here is left aside), and how large it is unpacked, without the `.pyc`
  files that pip compiles. `--project` may be a checkout of another commit.
- packages: what apt-get would download for packages.txt on this system, and how large that is installed; nothing where
  they are installed: run it in a minimal Debian (it needs nothing but Python and its venv).
- imports: seconds of CPU until what the main job imports is loaded, with onnxruntime for the network and with torch;
  the least of five. Of the environment that runs this.

Ends with `RESULT {json}`; null where a part was left out.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from bench.paths import ROOT

PARTS = ("wheels", "packages", "imports")
SHARED = "import cv2, numba, numpy, open3d, scipy.spatial"
NETWORKS = {"onnxruntime": "import onnxruntime", "torch": "import torch, safetensors.torch"}


def wheels(project: Path, extra: str | None) -> dict[str, float]:
    """Number of packages, and megabytes downloaded and unpacked."""
    plain = {name: value for name, value in os.environ.items() if name not in ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL")}
    plain |= {"PIP_CONFIG_FILE": os.devnull}
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "venv", f"{folder}/venv"], check=True)
        pip = [f"{folder}/venv/bin/python", "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
        wanted = ["-c", str(project / "constraints.txt"), f"{project}[{extra}]" if extra else str(project)]
        subprocess.run([*pip, "-d", f"{folder}/wheels", *wanted], env=plain, check=True)
        files = [path for path in Path(folder, "wheels").iterdir() if not path.name.startswith("scan2sim")]
        sizes = {path.name.split("-")[0]: (path.stat().st_size / 1e6, _unpacked(path) / 1e6) for path in files}
    for name, (down, up) in sorted(sizes.items(), key=lambda item: -item[1][1])[:12]:
        print(f"{name:32s}{down:8.1f} MB{up:8.1f} MB unpacked")
    down, up = (sum(size[i] for size in sizes.values()) for i in (0, 1))
    print(f"{len(sizes)} packages of PyPI: {down:.0f} MB, {up:.0f} MB unpacked", flush=True)
    return {"wheels": len(sizes), "wheels_mb": down, "wheels_unpacked_mb": up}


def _unpacked(path: Path) -> int:
    if path.suffix != ".whl":
        return path.stat().st_size
    with zipfile.ZipFile(path) as wheel:
        return sum(item.file_size for item in wheel.infolist())


def packages(project: Path) -> dict[str, float]:
    """Number of Debian's packages that would be installed, and their megabytes."""
    wanted = (project / "packages.txt").read_text(encoding="utf-8").split()
    command = ["apt-get", "install", "--print-uris", "-qq", "--no-install-recommends", *wanted]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    names = [line.split()[1].split("_")[0] for line in lines if line.startswith("'")]
    down = sum(int(line.split()[2]) for line in lines if line.startswith("'")) / 1e6
    up = 0.0
    for name in names:
        shown = subprocess.run(["apt-cache", "show", "--no-all-versions", name], capture_output=True, text=True).stdout
        up += next(int(x.split()[1]) for x in shown.splitlines() if x.startswith("Installed-Size")) * 1024 / 1e6
    print(f"{len(names)} packages of the system: {down:.0f} MB, {up:.0f} MB installed", flush=True)
    return {"packages": len(names), "packages_mb": down, "packages_installed_mb": up}


def imports() -> dict[str, float]:
    """Seconds of CPU, by network."""
    found = {}
    for name, more in NETWORKS.items():
        found[f"import_{name}_s"] = min(_cpu(f"{SHARED}\n{more}") for _ in range(5))
        print(f"importing all, with {name}: {found[f'import_{name}_s']:.2f} s of CPU", flush=True)
    return found


def _cpu(code: str) -> float:
    def spent() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    before = spent()
    subprocess.run([sys.executable, "-c", code], check=True)
    return spent() - before


def main() -> None:
    """Run the parts, print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--project", type=Path, default=ROOT)
    parser.add_argument("--extra")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    given = parser.parse_args()
    result: dict[str, float | None] = dict.fromkeys(
        ("wheels", "wheels_mb", "wheels_unpacked_mb", "packages", "packages_mb", "packages_installed_mb",
         *(f"import_{name}_s" for name in NETWORKS))
    )  # fmt: skip
    if "wheels" in given.parts:
        result |= wheels(given.project.resolve(), given.extra)
    if "packages" in given.parts:
        result |= packages(given.project)
    if "imports" in given.parts:
        result |= imports()
    print("RESULT " + json.dumps({key: None if value is None else round(value, 2) for key, value in result.items()}))


if __name__ == "__main__":
    main()
