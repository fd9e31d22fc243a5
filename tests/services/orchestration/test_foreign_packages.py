"""Packages as OSM's examples and tools make them: links in charms, checksums with the folder, no provider."""

from __future__ import annotations

import hashlib
import io
import re
import tarfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from scan2sim.flows.commands.orchestrate import app
from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.orchestration import descriptor
from scan2sim.services.orchestration.package import parse
from tests.fakes.osm import FakeOsm, OsmState

CHARMED = """
vnfd:
  id: charmed-vnf
  product-name: charmed-vnf
  description: A VNF with a proxy charm
  version: "1.0"
  mgmt-cp: vnf-mgmt-ext
  sw-image-desc: [{id: ubuntu20.04, name: ubuntu20.04}]
  virtual-compute-desc:
  - {id: mgmt-compute, virtual-cpu: {num-virtual-cpu: "2"}, virtual-memory: {size: "2.0"}}
  virtual-storage-desc: [{id: mgmt-storage, block-storage-data: {size-of-storage: 10}}]
  vdu:
  - id: mgmtVM
    name: mgmtVM
    cloud-init-file: cloud-config.txt
    sw-image-desc: ubuntu20.04
    virtual-compute-desc: mgmt-compute
    virtual-storage-desc: mgmt-storage
    int-cpd: [{id: vnf-mgmt, virtual-network-interface-requirement: [{name: eth0, virtual-interface: {type: VIRTIO}}]}]
  kdu: [{name: native-kdu, juju-bundle: stable/native-kdu}]
  ext-cpd: [{id: vnf-mgmt-ext, int-cpd: {vdu-id: mgmtVM, cpd: vnf-mgmt}, virtual-network-interface-requirement: []}]
  placement-groups: []
  df:
  - id: default-df
    lcm-operations-configuration: {operate-vnf-op-config: {day1-2: [{id: charmed-vnf}]}}
"""
SERVICE = """
nsd:
  nsd:
  - id: {id}
    name: {id}
    designer: OSM
    vnfd-id: [{function}]
    virtual-link-desc: [{{id: mgmtnet, mgmt-network: "true", vim-network-name: mgmt}}]
    df: [{{id: default-df, vnf-profile: [{{id: "1", vnfd-id: {function}}}]}}]
"""
LINKS = {"p/charms/simple/hooks/start": "../src/charm.py", "p/charms/simple/lib/ops": "../mod/operator/ops"}


def archive(text: str, links: dict[str, str] | None = None, name: str = "p/{}") -> bytes:
    """A package with code and links, as `osm package-build` writes it: checksums with the folder's name."""
    files = {"p/x_vnfd.yaml": text.encode(), "p/charms/simple/src/charm.py": b"code", "p/cloud_init/a.txt": b""}
    sums = "".join(
        f"{hashlib.md5(content).hexdigest()}\t{name.format(path.removeprefix('p/'))}\n"
        for path, content in files.items()
    )
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:gz") as made:
        for folder in ("./p", "./p/charms"):
            member = tarfile.TarInfo(folder)
            member.type = tarfile.DIRTYPE
            made.addfile(member)
        for path, content in (files | {"p/checksums.txt": sums.encode()}).items():
            member = tarfile.TarInfo(f"./{path}")
            member.size = len(content)
            made.addfile(member, io.BytesIO(content))
        for path, target in (links or {}).items():
            member = tarfile.TarInfo(path)
            member.type, member.linkname = tarfile.SYMTYPE, target
            made.addfile(member)
    return data.getvalue()


@pytest.mark.parametrize("name", ["p/{}", "./p/{}", "{}", "./{}", "*p/{}"])
def test_packages_of_osms_tools_are_read(name: str) -> None:
    found = parse(archive(CHARMED, LINKS, name), "charmed.tar.gz").descriptor
    assert (found.type, found.id, found.kdus) == ("vnfd", "charmed-vnf", ("native-kdu",))


@pytest.mark.parametrize("target", ["/etc/passwd", "../../../../x", "../../../../../etc/passwd", "../../../.."])
def test_links_that_leave_the_archive_are_rejected(target: str) -> None:
    with pytest.raises(InputError, match="a link that leaves the archive"):
        parse(archive(CHARMED, {"p/charms/simple/hooks/start": target}), "bad.tar.gz")


@pytest.mark.parametrize("field", ["mgmt-interface", "connection-point", "internal-vld"])
def test_fields_of_the_older_model_are_named(field: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"model before SOL006 (`{field}`)")):
        descriptor.read(CHARMED.replace("mgmt-cp:", f"{field}: x\n  mgmt-cp:"), "vnfd.yaml")


@pytest.mark.parametrize("missing", ["  id: charmed-vnf\n", "  mgmt-cp: vnf-mgmt-ext\n"])
def test_what_osm_needs_is_required(missing: str) -> None:
    text = CHARMED.replace("  kdu: [{name: native-kdu, juju-bundle: stable/native-kdu}]\n", "")
    with pytest.raises(InputError, match="SOL006"):
        descriptor.read(text.replace(missing, ""), "vnfd.yaml")


def test_a_bad_package_does_not_stop_the_others(tmp_path: Path) -> None:
    files = {
        "a.tar.gz": archive(CHARMED), "bad.tar.gz": b"no archive",
        "orphan.tar.gz": archive(SERVICE.format(id="orphan", function="nowhere")),
        "b.tar.gz": archive(SERVICE.format(id="service", function="charmed-vnf")),
    }  # fmt: skip
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    with FakeOsm(OsmState(seconds=0.02)) as osm:
        done = CliRunner().invoke(app, ["onboard", *(str(tmp_path / name) for name in files), "--osm", osm.address])
    text = " ".join(done.output.split())
    assert "vnfd charmed-vnf is onboarded" in text and "nsd service is onboarded" in text
    assert done.exit_code != 0 and "bad.tar.gz" in f"{text} {done.exception}"
    assert "nowhere, which is neither given nor in OSM" in f"{text} {done.exception}"
