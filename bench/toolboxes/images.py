"""Size of the toolboxes' container images, computed without a container engine, and a check of their content.

`python -m bench.toolboxes.images`: for each `deploy/toolboxes/BOX.Dockerfile`, installs the image's packages into a new
virtual environment (from PyPI) and counts its files: the packages, their compiled code, pip, the project. `BASE_MB` is
added for python:3.11-slim, and for `classify` the network, which is exported by the current environment. Then the
toolbox is served from there, in a folder of its own, and must become ready. Libraries that shared objects need but a
minimal Debian doesn't have are reported, too.

Ends with `RESULT {json}`: size of each image in megabytes (1e6 bytes), uncompressed, and missing libraries.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.paths import ROOT
from deploy.containers import FOLDER, entry_point, requirements
from deploy.libraries import ALWAYS, NEVER_LOADED, needed_libraries
from scan2sim.services.http import healthcheck
from scan2sim.services.toolboxes import tasks

BASE_MB = 150.0
"""Size of python:3.11-slim, uncompressed; an upper bound, as `docker images` lists about 130 MB."""
MAX_IMAGE_MB = 1500.0
READY_TIMEOUT_S = 120.0


def install_image(path: Path, folder: Path) -> Path:
    """A virtual environment with the packages of an image."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    pip = [str(folder / "bin" / "pip"), "install", "--quiet", "--disable-pip-version-check", "--no-cache-dir"]
    for file in requirements(path):
        subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), "-r", str(file)], check=True)
    subprocess.run([*pip, "--no-deps", str(ROOT)], check=True)
    return folder


def megabytes(folder: Path) -> float:
    """Size of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink()) / 1e6


def copied_models(path: Path, folder: Path) -> list[Path]:
    """Networks named by an image's entry point, exported by the current environment."""
    names = re.findall(r"=/models/(\S+)", " ".join(entry_point(path)))
    for name in names:
        module = "scan2sim.services.toolboxes.detector.imagenet"
        subprocess.run([sys.executable, "-m", module, str(folder / name)], check=True, cwd=ROOT)
    return [folder / name for name in names]


def seconds_until_ready(command: list[str], address: str, cwd: Path) -> float:
    """Start a toolbox, wait until it is ready, and stop it.

    Raises:
        TimeoutError: it didn't become ready.
    """
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    began = time.monotonic()
    with subprocess.Popen(command, cwd=cwd, env=plain, stdout=subprocess.DEVNULL) as served:
        try:
            while reason := healthcheck.failing(address):
                if served.poll() is not None or time.monotonic() > began + READY_TIMEOUT_S:
                    raise TimeoutError(f"{shlex.join(command)}: {reason}")
                time.sleep(0.1)
            return time.monotonic() - began
        finally:
            served.terminate()


def measure_image(box: str, port: int) -> tuple[float, list[str]]:
    """Size of a toolbox's image in megabytes, and missing libraries; prints its parts."""
    path = FOLDER / f"{box}.Dockerfile"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = install_image(path, folder / "venv")
        packages = megabytes(environment)
        project = megabytes(next(environment.glob("lib/python*/site-packages/scan2sim")))
        network = copied_models(path, folder)
        models = sum(file.stat().st_size for file in network) / 1e6
        missing = sorted(needed_libraries(environment)[1].keys() - ALWAYS - NEVER_LOADED.keys())
        (token := folder / "token").write_text(secrets.token_hex(32), encoding="utf-8")
        command = [*entry_point(path), "--port", str(port), "--token", str(token)]
        command = [part.replace("/models/", f"{folder}/") for part in command]
        command[0] = str(environment / "bin" / command[0])
        waited = seconds_until_ready(command, f"http://localhost:{port}", folder)
    whole = BASE_MB + packages + models
    parts = (BASE_MB, packages - project, project, models, whole)
    print(f"| {box} | {' | '.join(f'{part:.0f}' for part in parts)} | {waited:.1f} |", flush=True)
    return whole, missing


def main() -> None:
    """Measure all images and print the result; exit status 1 if one is too large or misses a library."""
    print("| image | python:3.11-slim | packages | project | network | total, MB | ready after, s |")
    print("| --- | --- | --- | --- | --- | --- | --- |", flush=True)
    found = {box: measure_image(box, 18080 + i) for i, box in enumerate(tasks.names())}
    sizes = {box: round(size) for box, (size, _) in found.items()}
    missing = sorted({library for _, some in found.values() for library in some})
    print("RESULT " + json.dumps({"images_mb": sizes, "limit_mb": MAX_IMAGE_MB, "missing_libraries": missing}))
    if missing or max(sizes.values()) > MAX_IMAGE_MB:
        sys.exit(1)


if __name__ == "__main__":
    main()
