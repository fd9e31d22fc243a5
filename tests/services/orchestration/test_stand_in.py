"""The fake OSM conforms to OSM's own OpenAPI file (tested with schemathesis)."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from tests.fakes.osm import FakeOsm

TESTED_PATHS = r"^/(vnfpkgm/v1/vnf_packages|nsd/v1/ns_descriptors|nslcm/v1/ns_(instances|lcm_op_occs)|nst/v1/netslice_templates|nsilcm/v1/(netslice_instances|nsi_lcm_op_occs)|admin/v1/(tokens|vim_accounts|k8sclusters))(/|$)"  # noqa: E501
UPLOAD_PATHS = r"(package|nsd|nst)_content$"  # schemathesis can't generate packages
# not response_headers_conformance: OSM itself returns relative locations, although its file says URI
CHECKS = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance"


@pytest.mark.parametrize("phases", ["fuzzing", pytest.param("coverage,fuzzing", marks=pytest.mark.slow)])
def test_the_fake_conforms_to_the_openapi_file(fake: FakeOsm, real_data: Path, tmp_path: Path, phases: str) -> None:
    if importlib.util.find_spec("schemathesis") is None:
        pytest.skip("schemathesis isn't installed")
    fake.state.as_json = False  # the file describes Release 8
    given = json.dumps({"username": "admin", "password": "admin"}).encode()
    with urllib.request.urlopen(f"{fake.address}/osm/admin/v1/tokens", given) as answer:
        token = json.load(answer)["id"]
    program = [sys.executable, "-c", "from schemathesis.cli import schemathesis; schemathesis()"]
    run = subprocess.run(
        [*program, "run", real_data / "osm" / "osm-openapi.yaml", "--url", f"{fake.address}/osm", "--phases", phases,
         "--include-path-regex", TESTED_PATHS, "--exclude-path-regex", UPLOAD_PATHS, "--checks", CHECKS, "-n", "5",
         "-H", f"Authorization: Bearer {token}", "--seed", "1"],
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-5000:] + run.stderr[-2000:]
