"""How large the toolboxes' images are, computed where no engine runs, and that what is in them suffices.

`python -m bench.toolboxes.images`: for each `deploy/toolboxes/BOX.Dockerfile`, installs what its image has into a fresh
virtual environment (from PyPI), and counts its files: the packages, their compiled code, pip, the project.
`BASE` is added for python:3.11-slim, and for `classify` the network, which the environment that runs this writes. Then
the toolbox is served from there, in a folder of its own, and must become ready. Shared objects that need a library
which is in no minimal Debian are told, too.

Ends with `RESULT {json}`: megabytes (1e6 bytes) of each image, uncompressed, and the libraries that it lacks.
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

from bench.packaging.containers import FOLDER, entry_point, requirements
from bench.packaging.libraries import ALWAYS, NEVER_LOADED, needed
from bench.paths import ROOT
from scan2sim.services.http import healthcheck
from scan2sim.services.toolboxes import tasks

BASE = 150.0
"""Megabytes of python:3.11-slim, uncompressed: `docker images` lists about 130, and no engine runs here to ask."""
LIMIT = 1500.0
READY_WITHIN = 120.0


def installed(path: Path, folder: Path) -> Path:
    """A virtual environment with what an image has."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    pip = [str(folder / "bin" / "pip"), "install", "--quiet", "--disable-pip-version-check", "--no-cache-dir"]
    for file in requirements(path):
        subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), "-r", str(file)], check=True)
    subprocess.run([*pip, "--no-deps", str(ROOT)], check=True)
    return folder


def megabytes(folder: Path) -> float:
    """Of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink()) / 1e6


def copied_models(path: Path, folder: Path) -> list[Path]:
    """Networks that an image's entry point names, written by this environment."""
    names = re.findall(r"=/models/(\S+)", " ".join(entry_point(path)))
    for name in names:
        module = "scan2sim.services.toolboxes.detector.imagenet"
        subprocess.run([sys.executable, "-m", module, str(folder / name)], check=True, cwd=ROOT)
    return [folder / name for name in names]


def seconds_until_ready(command: list[str], address: str, cwd: Path) -> float:
    """Start a toolbox, wait until it is ready, and end it.

    Raises:
        TimeoutError: it didn't become ready.
    """
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    began = time.monotonic()
    with subprocess.Popen(command, cwd=cwd, env=plain, stdout=subprocess.DEVNULL) as served:
        try:
            while reason := healthcheck.failing(address):
                if served.poll() is not None or time.monotonic() > began + READY_WITHIN:
                    raise TimeoutError(f"{shlex.join(command)}: {reason}")
                time.sleep(0.1)
            return time.monotonic() - began
        finally:
            served.terminate()


def measured(box: str, port: int) -> tuple[float, list[str]]:
    """Megabytes of a toolbox's image, and libraries that it lacks; tells its parts."""
    path = FOLDER / f"{box}.Dockerfile"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = installed(path, folder / "venv")
        packages = megabytes(environment)
        project = megabytes(next(environment.glob("lib/python*/site-packages/scan2sim")))
        network = copied_models(path, folder)
        models = sum(file.stat().st_size for file in network) / 1e6
        lacking = sorted(needed(environment)[1].keys() - ALWAYS - NEVER_LOADED.keys())
        (token := folder / "token").write_text(secrets.token_hex(32), encoding="utf-8")
        command = [*entry_point(path), "--port", str(port), "--token", str(token)]
        command = [part.replace("/models/", f"{folder}/") for part in command]
        command[0] = str(environment / "bin" / command[0])
        waited = seconds_until_ready(command, f"http://localhost:{port}", folder)
    whole = BASE + packages + models
    parts = (BASE, packages - project, project, models, whole)
    print(f"| {box} | {' | '.join(f'{part:.0f}' for part in parts)} | {waited:.1f} |", flush=True)
    return whole, lacking


def main() -> None:
    """Measure all, print the result; end with 1 if one is too large, or lacks a library."""
    print("| image | python:3.11-slim | packages | project | network | together, MB | ready after, s |")
    print("| --- | --- | --- | --- | --- | --- | --- |", flush=True)
    found = {box: measured(box, 18080 + i) for i, box in enumerate(tasks.names())}
    sizes = {box: round(size) for box, (size, _) in found.items()}
    lacking = sorted({library for _, some in found.values() for library in some})
    print("RESULT " + json.dumps({"images_mb": sizes, "limit_mb": LIMIT, "libraries_lacking": lacking}))
    if lacking or max(sizes.values()) > LIMIT:
        sys.exit(1)


if __name__ == "__main__":
    main()
