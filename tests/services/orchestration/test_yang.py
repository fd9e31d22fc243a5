"""Packages conform to the YANG models by which OSM itself validates descriptors (ETSI SOL006 with OSM's augmentations).

The models aren't part of this project. Put ETSI's modules of SOL006 2.6.1 (https://forge.etsi.org/rep/nfv/SOL006),
OSM's augmentations (`models/augments` of its repository IM), ietf-inet-types and ietf-yang-types (RFC 6991) into a
folder, name it in SCAN2SIM_SOL006_YANG, and `pip install pyang pyangbind`.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scan2sim.services.orchestration import description
from scan2sim.services.orchestration.package import build
from scan2sim.services.orchestration.sol006 import FunctionKind
from scan2sim.services.qos.requirements import Environment

VALIDATE = """
import importlib, json, sys
from pyangbind.lib.serialise import pybindJSONDecoder
sys.path.insert(0, sys.argv[1])
for line in sys.stdin:
    kind, name, body = json.loads(line)
    model = getattr(importlib.import_module(f"etsi_nfv_{kind}"), f"etsi_nfv_{kind}")()
    try:
        pybindJSONDecoder.load_ietf_json(body, None, None, obj=model, path_helper=True)
    except Exception as error:
        print(name, kind, error)
"""


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of Python classes that pyangbind has made of the models."""
    folder = os.environ.get("SCAN2SIM_SOL006_YANG")
    if not folder:
        pytest.skip("no YANG models: set SCAN2SIM_SOL006_YANG to their folder")
    pyang, pyangbind = shutil.which("pyang"), importlib.util.find_spec("pyangbind")
    if pyang is None or pyangbind is None or pyangbind.origin is None:
        pytest.skip("pyang or pyangbind isn't installed")

    out = tmp_path_factory.mktemp("models")
    plugins = Path(pyangbind.origin).parent / "plugin"
    yang = sorted(Path(folder).glob("*.yang"))
    augments = [path for path in yang if not path.name.startswith(("etsi-nfv", "ietf-"))]
    for kind in ("vnfd", "nsd"):
        subprocess.run(
            [pyang, "--path", folder, "--plugindir", plugins, "-f", "pybind", "-o",
             out / f"etsi_nfv_{kind}.py", *augments, Path(folder) / f"etsi-nfv-{kind}.yang"],
            check=True, capture_output=True,
        )  # fmt: skip
    return out


def bodies() -> Iterator[tuple[str, str, Any]]:
    """Kind, name and descriptor of all packages of the included services."""
    kinds: tuple[FunctionKind, ...] = ("container", "machine")
    for name in description.names():
        for kind in kinds:
            made = build(description.read(name), Environment.EDGE, kind)
            for package in (made.function, made.service):
                yield package.descriptor.type, package.name, package.descriptor.body


def test_packages_conform_to_the_models_of_osm(models: Path) -> None:
    wrong = ("vnfd", "wrong", {"vnfd": {"id": "a", "nonsense": 1}})
    lines = "\n".join(json.dumps(one) for one in (*bodies(), wrong))
    done = subprocess.run(
        [sys.executable, "-c", VALIDATE, models], input=lines, capture_output=True, text=True, check=True
    )
    assert len(done.stdout.splitlines()) == 1 and done.stdout.startswith("wrong vnfd")
