"""Khronos' glTF validator (npm): no errors or warnings in any GLB."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

from tests.fakes.cesium import node_module
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "glb"
NAME = "gltf-validator"
VALIDATE = """
const { validateBytes } = require(process.argv[1]), fs = require("fs");
validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then((r) => console.log(JSON.stringify(r.issues)));
"""


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    if shutil.which("node") is None:
        return "Node.js isn't installed"
    return "" if node_module(NAME) else f"{NAME} isn't installed (npm install -g {NAME})"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Validate all GLBs."""
    files = sorted(export.glob("*.glb"))
    for path in files:
        found = issues(path)
        if found["numErrors"] or found["numWarnings"]:
            raise Fault(f"{path.name}: {found['messages'][0]['message']}", {"errors": found["numErrors"]})
    return {"files": len(files)}


def issues(path: Path) -> dict[str, Any]:
    """Issues found in a GLB: `numErrors`, `numWarnings`, `messages`."""
    command = ["node", "-e", VALIDATE, str(node_module(NAME)), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout))
