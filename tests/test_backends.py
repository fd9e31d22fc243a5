"""All backends and formats implement their protocol; one file is enough to add another."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline import decimation
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.pipeline.core.optional_deps import EXTRA_OF
from scan2sim.pipeline.core.types import Camera
from scan2sim.pipeline.io import clouds, gps, mesh_formats, photogrammetry, robot_formats, world_formats
from scan2sim.pipeline.io.images import decoders
from scan2sim.pipeline.io.worlds.gltf import geometry, textures
from scan2sim.segmentation import backends as networks
from scan2sim.services.qos import links
from scan2sim.services.teleoperation import cameras, encoders
from scan2sim.services.teleoperation.vehicle import adapters
from scan2sim.slam import features, matchers, solvers, trackers
from scan2sim.texturing.splats import backends as rasterizers
from tests.conftest import ROOT
from tests.fakes import synthetic

PROTOCOLS: dict[ModuleType, tuple[type, ...]] = {
    networks: (networks.Backend,),
    features: (features.Backend,),
    matchers: (matchers.Backend,),
    trackers: (trackers.Backend,),
    solvers: (solvers.Solver,),
    clouds: (clouds.Format, clouds.CloudFormat),
    photogrammetry: (photogrammetry.Program,),
    gps: (gps.Format,),
    decoders: (decoders.Decoder,),
    mesh_formats: (mesh_formats.ModelFormat,),
    world_formats: (world_formats.Format,),
    robot_formats: (robot_formats.Format,),
    textures: (textures.Texture,),
    geometry: (geometry.Codec,),
    decimation: (decimation.Backend,),
    links: (links.Backend,),
    encoders: (encoders.Backend,),
    cameras: (cameras.Backend,),
    adapters: (adapters.VehicleAdapter,),
    rasterizers: (rasterizers.Backend,),
}
"""Packages of backends, and protocols of which their modules implement one."""
ALL_BACKENDS = [(package, name) for package in PROTOCOLS for name in plugins.names(package.__name__)]
each_backend = pytest.mark.parametrize(
    ("package", "name"), ALL_BACKENDS, ids=[f"{p.__name__.split('.', 1)[1]}-{n}" for p, n in ALL_BACKENDS]
)


def implements(module: Any, protocol: type) -> bool:
    """Whether a module has a protocol's constants, and its functions with the same leading parameters."""
    methods = {name: value for name, value in vars(protocol).items() if inspect.isfunction(value) and name[0] != "_"}
    for name, function in methods.items():
        required = [parameter for parameter in inspect.signature(function).parameters if parameter != "self"]
        actual = list(inspect.signature(getattr(module, name, lambda: None)).parameters.values())
        if [parameter.name for parameter in actual[: len(required)]] != required:
            return False
        if any(parameter.default is inspect.Parameter.empty for parameter in actual[len(required) :]):
            return False
    return all(hasattr(module, name) for name in protocol.__annotations__)


@each_backend
def test_a_backend_implements_its_protocol(package: ModuleType, name: str) -> None:
    module = plugins.module(package.__name__, name)
    assert sum(implements(module, protocol) for protocol in PROTOCOLS[package]) == 1


@each_backend
def test_a_missing_dependency_is_reported_with_its_extra(
    package: ModuleType, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = plugins.module(package.__name__, name)
    needs, preferred_extra = plugins.needs(backend), getattr(backend, "EXTRA", "")
    core = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    extras = {EXTRA_OF[package] for package in needs if package in EXTRA_OF}
    assert extras or set(needs) <= {re.split(r"[^\w.-]", line)[0] for line in core}
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *more: None if n in needs else real(n, *more))
    assert plugins.missing(package.__name__, name) == (", ".join(needs) or None)
    if needs:
        with pytest.raises(UnavailableError) as caught:
            plugins.find(package.__name__, name, "a.setting")
        assert caught.value.where == f"a.setting {name}" and all(n in caught.value.cause for n in needs)
        assert (
            not extras
            or caught.value.remedy == f"pip install 'scan2sim[{preferred_extra or ','.join(sorted(extras))}]'"
        )


@pytest.mark.parametrize("package", PROTOCOLS, ids=lambda p: p.__name__)
def test_an_unknown_name_lists_the_available_ones(package: ModuleType) -> None:
    with pytest.raises(SettingError, match=r"a\.setting: unknown value 'surf'") as caught:
        plugins.find(package.__name__, "surf", "a.setting")
    assert all(name in caught.value.remedy for name in plugins.names(package.__name__))


@pytest.mark.parametrize("package", [clouds, decoders, gps])
def test_formats_have_different_suffixes(package: ModuleType) -> None:
    suffixes = [plugins.module(package.__name__, name).SUFFIXES for name in plugins.names(package.__name__)]
    assert sum(map(len, suffixes)) == len(plugins.by_suffix(package.__name__))


@pytest.fixture
def add(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Function that adds a module to a package, as a file in another folder of its path."""
    added = []

    def add_module(package: ModuleType, name: str, code: str) -> None:
        folder = tmp_path / package.__name__
        folder.mkdir()
        (folder / f"{name}.py").write_text(code, encoding="utf-8")
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(folder)])
        importlib.invalidate_caches()
        added.append((package, name))

    yield add_module
    for package, name in added:
        sys.modules.pop(f"{package.__name__}.{name}", None)
        vars(package).pop(name, None)


Add = Callable[[ModuleType, str, str], None]


def test_a_network_is_added_by_one_file(add: Add) -> None:
    from scan2sim.segmentation.photos import Classifier, class_map
    from scan2sim.segmentation.steps.label import LABEL

    add(networks, "allroad", """
import numpy as np
from scan2sim.segmentation.backends import NetworkInfo

class Network:
    info = NetworkInfo("allroad", ("road", "building", "vegetation", "car"), "0" * 64, "none", None)
    def probabilities(self, seen):
        return np.stack([np.full(seen.shape[:2], share, np.float32) for share in (0.7, 0.1, 0.1, 0.1)])

def check(weights):
    pass

def load(weights, device):
    return Network()
""")  # fmt: skip
    assert LABEL.check is not None
    LABEL.check(LABEL.params.of("label", {"network": "allroad"}))
    classifier = Classifier(networks.load("allroad", None), "allroad")
    seen = np.zeros((48, 64, 3), np.uint8)
    camera = Camera("pinhole", 64, 48, 50.0, 50.0, 31.5, 23.5)
    best, _ = class_map(classifier.probabilities(seen, camera, None), (48, 64))
    assert best.shape == (48, 64) and len(np.unique(best)) == 1


def test_a_feature_detector_is_added_by_one_file(add: Add) -> None:
    from scan2sim.slam.steps.track import TrackParams, tracker_of

    add(features, "blobs", """
import cv2
import numpy as np
from scan2sim.slam.features import FeatureSet

class Blobs:
    name, binary, dimension = "blobs", False, 25
    def detect(self, grey, mask=None):
        uv = cv2.goodFeaturesToTrack(grey, 300, 0.01, 5).reshape(-1, 2)
        descriptors = np.stack([cv2.getRectSubPix(grey, (5, 5), tuple(map(float, at))).ravel() for at in uv])
        descriptors = descriptors.astype(np.float32) / np.linalg.norm(descriptors, axis=1, keepdims=True)
        return FeatureSet(uv, descriptors, np.linspace(1, 0, len(uv), dtype=np.float32))
    def describe(self):
        return "blobs"

def load(weights, count, upsample, device):
    return Blobs()
""")  # fmt: skip
    grey = np.random.default_rng(0).integers(0, 255, (60, 80), np.uint8).repeat(4, 0).repeat(4, 1)
    camera = Camera("pinhole", 320, 240, 200.0, 200.0, 159.5, 119.5)
    tracker, _ = tracker_of(camera, None, TrackParams.model_validate({"count": 100, "features": "blobs"}), {})
    tracker.track(grey)
    assert tracker.refill() > 50
    assert tracker.track(grey) > 0.9


def test_an_export_format_is_added_by_one_file(add: Add, tmp_path: Path) -> None:
    add(mesh_formats, "off", """
SUFFIX = ".off"

def write(path, surface, names):
    rows = [f"{x} {y} {z}" for x, y, z in surface.mesh.vertices] + [f"3 {a} {b} {c}" for a, b, c in surface.mesh.faces]
    path.write_text("\\n".join(["OFF", f"{len(surface.mesh.vertices)} {len(surface)} 0", *rows]))
""")  # fmt: skip
    import trimesh

    world = synthetic.world(tmp_path, meshes=("obj", "off")).files["world"]
    folder = world / "models" / "street" / "meshes"
    assert len(trimesh.load_mesh(folder / "terrain.off", process=False).faces) == len(synthetic.ground())
    assert (folder / "terrain.obj").is_file() and not (folder / "terrain.dae").exists()
