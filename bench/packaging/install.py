"""Download and installed size of the package, and cost of importing it.

`python -m bench.packaging.install [--project .] [--extra NAME] [--parts wheels packages imports]`

- wheels: size of what `pip install -c constraints.txt PROJECT[EXTRA]` downloads into an empty environment of this
  Python from PyPI alone (ignoring local pip configuration), and its size unpacked, without the `.pyc` files compiled by
  pip. `--project` may be a checkout of another commit.
- packages: size of what apt-get would download for packages.txt on this system, and its installed size; nothing if
  already installed, so run it in a minimal Debian (it needs only Python and its venv).
- imports: CPU seconds until everything imported by the main job is loaded, with onnxruntime and with torch for the
  network; the minimum of five runs in the current environment.

Ends with `RESULT {json}`; null for parts that were not run.
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
COMMON_IMPORTS = "import cv2, numba, numpy, open3d, scipy.spatial"
BACKEND_IMPORTS = {"onnxruntime": "import onnxruntime", "torch": "import torch, safetensors.torch"}


def wheels(project: Path, extra: str | None) -> dict[str, float]:
    """Number of packages, and megabytes downloaded and unpacked."""
    environment = {
        name: value for name, value in os.environ.items() if name not in ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL")
    }
    environment |= {"PIP_CONFIG_FILE": os.devnull}
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "venv", f"{folder}/venv"], check=True)
        pip = [f"{folder}/venv/bin/python", "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
        requirements = ["-c", str(project / "constraints.txt"), f"{project}[{extra}]" if extra else str(project)]
        subprocess.run([*pip, "-d", f"{folder}/wheels", *requirements], env=environment, check=True)
        files = [path for path in Path(folder, "wheels").iterdir() if not path.name.startswith("scan2sim")]
        sizes = {path.name.split("-")[0]: (path.stat().st_size / 1e6, _unpacked(path) / 1e6) for path in files}
    for name, (down, up) in sorted(sizes.items(), key=lambda item: -item[1][1])[:12]:
        print(f"{name:32s}{down:8.1f} MB{up:8.1f} MB unpacked")
    down, up = (sum(size[i] for size in sizes.values()) for i in (0, 1))
    print(f"{len(sizes)} packages from PyPI: {down:.0f} MB, {up:.0f} MB unpacked", flush=True)
    return {"wheels": len(sizes), "wheels_mb": down, "wheels_unpacked_mb": up}


def _unpacked(path: Path) -> int:
    if path.suffix != ".whl":
        return path.stat().st_size
    with zipfile.ZipFile(path) as wheel:
        return sum(item.file_size for item in wheel.infolist())


def packages(project: Path) -> dict[str, float]:
    """Number of Debian packages that would be installed, and their megabytes."""
    requested = (project / "packages.txt").read_text(encoding="utf-8").split()
    command = ["apt-get", "install", "--print-uris", "-qq", "--no-install-recommends", *requested]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    names = [line.split()[1].split("_")[0] for line in lines if line.startswith("'")]
    down = sum(int(line.split()[2]) for line in lines if line.startswith("'")) / 1e6
    up = 0.0
    for name in names:
        shown = subprocess.run(["apt-cache", "show", "--no-all-versions", name], capture_output=True, text=True).stdout
        up += next(int(x.split()[1]) for x in shown.splitlines() if x.startswith("Installed-Size")) * 1024 / 1e6
    print(f"{len(names)} system packages: {down:.0f} MB, {up:.0f} MB installed", flush=True)
    return {"packages": len(names), "packages_mb": down, "packages_installed_mb": up}


def imports() -> dict[str, float]:
    """CPU seconds for each inference backend."""
    found = {}
    for name, more in BACKEND_IMPORTS.items():
        found[f"import_{name}_s"] = min(_cpu(f"{COMMON_IMPORTS}\n{more}") for _ in range(5))
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
    """Run the parts and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--project", type=Path, default=ROOT)
    parser.add_argument("--extra")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    given = parser.parse_args()
    result: dict[str, float | None] = dict.fromkeys(
        ("wheels", "wheels_mb", "wheels_unpacked_mb", "packages", "packages_mb", "packages_installed_mb",
         *(f"import_{name}_s" for name in BACKEND_IMPORTS))
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
