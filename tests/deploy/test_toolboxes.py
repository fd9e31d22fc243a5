"""Toolbox container files are consistent, and the packages that they install are sufficient to serve."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from packaging.utils import canonicalize_name
from PIL import Image

from deploy.containers import FOLDER, entry_point, image, requirements, stages
from deploy.third_party import closure
from scan2sim.services.toolboxes import tasks
from tests.conftest import ROOT
from tests.fakes.ports import free_port

FILES = sorted(FOLDER.glob("*.Dockerfile"))
TASKS = tasks.names()
TOKEN = "0123456789abcdef"
RUN_SCAN2SIM = "import sys; from scan2sim.flows.cli import main; sys.argv[0] = 'scan2sim'; main()"


def requirement_lines(path: Path) -> list[str]:
    return [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith(("#", "--"))]


def site_packages(path: Path, folder: Path) -> Path:
    """Fill a folder with links to those installed packages that an image contains."""
    wanted = [line for file in requirements(path) for line in requirement_lines(file)]
    for package in closure(wanted).values():
        for part in {file.parts[0] for file in package.files or ()} - {"..", "__pycache__"}:
            (folder / part).symlink_to(str(package.locate_file(part)))
    return folder


@contextmanager
def running_scan2sim(packages: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """`scan2sim` in a process that can import only these packages."""
    env = {"PATH": os.environ["PATH"], "HOME": str(packages), "PYTHONUNBUFFERED": "1"}
    env["PYTHONPATH"] = f"{packages}:{ROOT}"
    command = [sys.executable, "-S", "-c", RUN_SCAN2SIM, *arguments]
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)


def healthcheck(address: str) -> int:
    """Exit status of an image's HEALTHCHECK command, run in a Python without packages."""
    command = [sys.executable, "-S", "-m", "scan2sim.services.http.healthcheck", address]
    return subprocess.run(command, env={"PYTHONPATH": str(ROOT)}).returncode


def infer(address: str, task: str, token: str) -> str:
    """Response of a toolbox to a grey image."""
    jpeg = io.BytesIO()
    Image.fromarray(np.full((96, 128, 3), 90, np.uint8)).save(jpeg, "JPEG")
    headers = {"Content-Type": "image/jpeg", "Authorization": f"Bearer {token}"}
    request = urllib.request.Request(f"{address}/v2/models/{task}/infer", jpeg.getvalue(), headers)
    with urllib.request.urlopen(request, timeout=60) as response:
        return str(response.read().decode())


def test_each_toolbox_has_a_container_file() -> None:
    assert [path.name.partition(".")[0] for path in FILES] == sorted([*TASKS, "base"])


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_copied_and_installed_files_exist_in_the_build_context(path: Path) -> None:
    build_context = [
        line[1:] for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines() if line.startswith("!")
    ]
    for stage in stages(path):
        copied: set[str] = set()
        for rest in stage.arguments_of("COPY"):
            *sources, target = rest.split()
            if earlier_stage := re.match(r"--from=(\w+)", rest):
                assert earlier_stage[1] in {one.name for one in stages(path)}
                continue
            copied |= {target + Path(source).name for source in sources}
            assert all((ROOT / source).exists() for source in sources), rest
            assert all(source == "." or Path(source).parts[0] in build_context for source in sources), rest
        assert set(re.findall(r"-[rc] (\S+)", " ".join(stage.arguments_of("RUN")))) <= copied


@pytest.mark.parametrize("task", TASKS)
def test_images_run_as_an_unprivileged_user_and_have_a_healthcheck(task: str) -> None:
    file = FOLDER / f"{task}.Dockerfile"
    parts = image(file)
    users = [user for part in parts for user in part.arguments_of("USER")]
    assert users[-1] == "1000", "a number: Kubernetes can't check that a name isn't root"
    assert any("useradd" in rest and users[-1] in rest for rest in parts[1].arguments_of("RUN"))
    health = parts[-1].arguments_of("HEALTHCHECK")[0]
    assert health.endswith('CMD ["python", "-m", "scan2sim.services.http.healthcheck"]')
    assert parts[0].base == parts[1].base == "python:3.11-slim" and parts[1].arguments_of("EXPOSE") == ["8080"]
    assert entry_point(file)[:6] == ["scan2sim", "toolbox", "serve", task, "--host", "0.0.0.0"]


def test_requirements_are_pinned_and_exclude_large_packages() -> None:
    pins = {canonicalize_name(line.split("==")[0]) for line in requirement_lines(ROOT / "constraints.txt")}
    for task in TASKS:
        files = requirements(FOLDER / f"{task}.Dockerfile")
        found = closure([line for file in files for line in requirement_lines(file)])
        assert found.keys() <= pins, task
        assert not {"torch", "open3d-cpu", "numba"} & found.keys()


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Model folder as created by a build stage of `classify`."""
    pytest.importorskip("efficientnet_lite_pytorch", reason="the extra toolboxes isn't installed")
    from scan2sim.services.toolboxes.detector import imagenet

    folder = tmp_path_factory.mktemp("models")
    imagenet.export(folder / "efficientnet-lite0.onnx")
    return folder


@pytest.mark.parametrize("task", TASKS)
def test_packages_of_an_image_are_sufficient_to_serve(task: str, models: Path, tmp_path: Path) -> None:
    path = FOLDER / f"{task}.Dockerfile"
    port = free_port()
    address = f"http://localhost:{port}"
    command = [part.replace("/models", str(models)) for part in entry_point(path)[1:]]
    (token := tmp_path / "token").write_text(TOKEN, encoding="utf-8")
    (packages := tmp_path / "packages").mkdir()
    assert healthcheck(address) == 1
    options = ["--port", str(port), "--token", str(token)]
    with running_scan2sim(site_packages(path, packages), *command, *options) as process:
        assert process.stdout is not None
        printed = process.stdout.readline()
        assert f":{port}/" in printed, printed + process.stdout.read()
        assert healthcheck(address) == 0
        assert '"state":"done"' in infer(address, task, TOKEN).replace(" ", "")


def test_an_image_without_a_token_refuses_to_serve(tmp_path: Path) -> None:
    path = FOLDER / "detect.Dockerfile"
    with running_scan2sim(site_packages(path, tmp_path), *entry_point(path)[1:]) as process:
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 2 and "--token" in output


def test_packages_of_an_image_are_sufficient_for_a_node(tmp_path: Path) -> None:
    packages = site_packages(FOLDER / "detect.Dockerfile", tmp_path)
    options = ["--kafka", f"localhost:{free_port()}", "--console", "--period", "0.2"]
    with running_scan2sim(packages, "toolbox", "node", "detect", "--images", "/camera/image", *options) as process:
        assert process.stdout is not None
        printed = [process.stdout.readline()]
        while printed[-1] and not printed[-1].startswith("{"):
            printed.append(process.stdout.readline())
        assert "/camera/image" in printed[-1] or '"node"' in printed[-1], "".join(printed)
