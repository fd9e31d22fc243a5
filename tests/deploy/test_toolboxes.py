"""Containers of the toolboxes: that their files hold together, and that what they install suffices to serve."""

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

from bench.packaging.containers import FOLDER, entry_point, image, requirements, stages
from bench.packaging.third_party import closure
from scan2sim.services.toolboxes import tasks
from tests.conftest import ROOT
from tests.fakes.ports import free_port

FILES = sorted(FOLDER.glob("*.Dockerfile"))
BOXES = tasks.names()
TOKEN = "0123456789abcdef"
SCAN2SIM = "import sys; from scan2sim.flows.cli import main; sys.argv[0] = 'scan2sim'; main()"


def lines(path: Path) -> list[str]:
    return [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith(("#", "--"))]


def site(path: Path, folder: Path) -> Path:
    """A folder with the packages that an image has, of those that are installed here."""
    wanted = [line for file in requirements(path) for line in lines(file)]
    for package in closure(wanted).values():
        for part in {file.parts[0] for file in package.files or ()} - {"..", "__pycache__"}:
            (folder / part).symlink_to(str(package.locate_file(part)))
    return folder


@contextmanager
def running(packages: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """`scan2sim` with these packages alone."""
    env = {"PATH": os.environ["PATH"], "HOME": str(packages), "PYTHONUNBUFFERED": "1"}
    env["PYTHONPATH"] = f"{packages}:{ROOT}"
    command = [sys.executable, "-S", "-c", SCAN2SIM, *arguments]
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)


def healthy(address: str) -> int:
    """As an image's HEALTHCHECK asks, in a Python that has no packages."""
    command = [sys.executable, "-S", "-m", "scan2sim.services.http.healthcheck", address]
    return subprocess.run(command, env={"PYTHONPATH": str(ROOT)}).returncode


def answer(address: str, box: str, token: str) -> str:
    jpeg = io.BytesIO()
    Image.fromarray(np.full((96, 128, 3), 90, np.uint8)).save(jpeg, "JPEG")
    headers = {"Content-Type": "image/jpeg", "Authorization": f"Bearer {token}"}
    request = urllib.request.Request(f"{address}/v2/models/{box}/infer", jpeg.getvalue(), headers)
    with urllib.request.urlopen(request, timeout=60) as told:
        return str(told.read().decode())


def test_each_toolbox_has_its_file() -> None:
    assert [path.name.partition(".")[0] for path in FILES] == sorted([*BOXES, "base"])


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_what_files_copy_and_install_is_there(path: Path) -> None:
    sent = [
        line[1:] for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines() if line.startswith("!")
    ]
    for stage in stages(path):
        copied: set[str] = set()
        for rest in stage.said("COPY"):
            *sources, where = rest.split()
            if before := re.match(r"--from=(\w+)", rest):
                assert before[1] in {one.name for one in stages(path)}
                continue
            copied |= {where + Path(source).name for source in sources}
            assert all((ROOT / source).exists() for source in sources), rest
            assert all(source == "." or Path(source).parts[0] in sent for source in sources), rest
        assert set(re.findall(r"-[rc] (\S+)", " ".join(stage.said("RUN")))) <= copied


@pytest.mark.parametrize("box", BOXES)
def test_images_run_as_nobody_special_and_tell_their_health(box: str) -> None:
    parts = image(FOLDER / f"{box}.Dockerfile")
    users = [user for part in parts for user in part.said("USER")]
    assert users[-1] == "scan2sim" and any("useradd" in rest and users[-1] in rest for rest in parts[1].said("RUN"))
    assert parts[-1].said("HEALTHCHECK")[0].endswith('CMD ["python", "-m", "scan2sim.services.http.healthcheck"]')
    assert parts[0].base == parts[1].base == "python:3.11-slim" and parts[1].said("EXPOSE") == ["8080"]
    assert entry_point(FOLDER / f"{box}.Dockerfile")[:6] == ["scan2sim", "toolbox", "serve", box, "--host", "0.0.0.0"]


def test_requirements_are_pinned_and_light() -> None:
    pins = {canonicalize_name(line.split("==")[0]) for line in lines(ROOT / "constraints.txt")}
    for box in BOXES:
        found = closure([line for file in requirements(FOLDER / f"{box}.Dockerfile") for line in lines(file)])
        assert found.keys() <= pins, box
        assert not {"torch", "open3d-cpu", "numba"} & found.keys()


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As the stage of `classify` makes it."""
    pytest.importorskip("efficientnet_lite_pytorch", reason="the extra toolboxes isn't installed")
    from scan2sim.services.toolboxes.detector import imagenet

    folder = tmp_path_factory.mktemp("models")
    imagenet.export(folder / "efficientnet-lite0.onnx")
    return folder


@pytest.mark.parametrize("box", BOXES)
def test_what_an_image_installs_suffices_to_serve(box: str, models: Path, tmp_path: Path) -> None:
    path = FOLDER / f"{box}.Dockerfile"
    port = free_port()
    address = f"http://localhost:{port}"
    command = [part.replace("/models", str(models)) for part in entry_point(path)[1:]]
    (token := tmp_path / "token").write_text(TOKEN, encoding="utf-8")
    (packages := tmp_path / "packages").mkdir()
    assert healthy(address) == 1
    with running(site(path, packages), *command, "--port", str(port), "--token", str(token)) as process:
        assert process.stdout is not None
        told = process.stdout.readline()
        assert f":{port}/" in told, told + process.stdout.read()
        assert healthy(address) == 0
        assert '"state":"done"' in answer(address, box, TOKEN).replace(" ", "")


def test_an_image_without_a_token_refuses_to_serve(tmp_path: Path) -> None:
    path = FOLDER / "detect.Dockerfile"
    with running(site(path, tmp_path), *entry_point(path)[1:]) as process:
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 2 and "--token" in output


def test_what_images_install_suffices_for_a_node(tmp_path: Path) -> None:
    packages = site(FOLDER / "detect.Dockerfile", tmp_path)
    options = ["--kafka", f"localhost:{free_port()}", "--console", "--period", "0.2"]
    with running(packages, "toolbox", "node", "detect", "--images", "/camera/image", *options) as process:
        assert process.stdout is not None
        told = [process.stdout.readline()]
        while told[-1] and not told[-1].startswith("{"):
            told.append(process.stdout.readline())
        assert "/camera/image" in told[-1] or '"node"' in told[-1], "".join(told)
