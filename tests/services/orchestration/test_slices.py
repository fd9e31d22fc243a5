"""Network slice templates are onboarded; slices are created from them, listed and removed."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from scan2sim.flows.commands.orchestrate import app
from scan2sim.pipeline.core.errors import InputError, ScanError, SettingError
from scan2sim.services.orchestration import slices
from scan2sim.services.orchestration.lifecycle import WaitPolicy
from scan2sim.services.orchestration.osm import Osm, OsmError
from tests.fakes.osm import FakeOsm

TEMPLATE = """
nst:
- id: video-slice
  name: video-slice
  SNSSAI-identifier: {{slice-service-type: eMBB}}
  netslice-subnet:
  - {{id: detection, nsd-ref: {service}, is-shared-nss: false}}
"""
NOT_WAITING = WaitPolicy(60.0, wait=False)


def run(fake: FakeOsm, *words: object) -> str:
    done = CliRunner().invoke(app, [*map(str, words), "--osm", fake.address])
    if done.exception and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return " ".join(done.output.split())


@pytest.fixture
def template(fake: FakeOsm, tmp_path: Path) -> Path:
    """File of a template whose network service is in OSM."""
    assert CliRunner().invoke(app, ["package", "detect", "--out", str(tmp_path / "packages")]).exit_code == 0
    run(fake, "onboard", *sorted((tmp_path / "packages").glob("*.tar.gz")))
    (service,) = (one["id"] for one in fake.state.services.values())
    path = tmp_path / "nst.yaml"
    path.write_text(TEMPLATE.format(service=service), encoding="utf-8")
    return path


def test_a_slice_is_created_from_a_template_listed_and_removed(fake: FakeOsm, template: Path) -> None:
    assert "video-slice is in OSM" in run(fake, "slice", "add-template", template)
    run(fake, "slice", "add-template", template)
    assert len(fake.state.templates) == 1, "it is onboarded once"
    listed = run(fake, "slice", "templates")
    assert "video-slice" in listed and "detect" in listed
    create = "slice", "create", "north", "video-slice", "--cluster", "edge-cluster", "--wait"
    assert "north is running" in run(fake, *create)
    assert "already in OSM" in run(fake, *create) and len(fake.state.slices) == 1
    (made,) = fake.state.slices.values()
    assert made["datacenter"] in fake.state.vims and made["nst-ref"] == "video-slice"
    assert "north" in run(fake, "slice", "list") and "running" in run(fake, "slice", "list")
    with pytest.raises(OsmError, match="using this descriptor"):
        run(fake, "slice", "remove-template", "video-slice")
    assert "north is removed" in run(fake, "slice", "remove", "north")
    assert "removed" in run(fake, "slice", "remove-template", "video-slice")
    assert not fake.state.slices and not fake.state.templates


def test_a_failed_slice_is_reported_and_can_be_removed(fake: FakeOsm, osm: Osm, template: Path) -> None:
    slices.add_template(osm, template)
    fake.state.outcome = lambda kind, name: "FAILED" if kind == "instantiate" else "COMPLETED"
    with pytest.raises(ScanError, match="instantiate failed .*no quota"):
        slices.create(osm, "north", "video-slice", osm.vim("edge-site"), WaitPolicy(60.0))
    assert "failed: no quota" in run(fake, "slice", "list")
    slices.remove(osm, "north", WaitPolicy(60.0))
    assert not fake.state.slices


def test_a_slice_that_is_not_removed_is_reported(fake: FakeOsm, osm: Osm, template: Path) -> None:
    slices.add_template(osm, template)
    slices.create(osm, "north", "video-slice", osm.vim("edge-site"), WaitPolicy(60.0))
    fake.state.outcome = lambda kind, name: "never"
    with pytest.raises(ScanError, match=r"hasn't removed the slice within 0.05 s"):
        slices.remove(osm, "north", WaitPolicy(0.05))


def test_a_template_in_a_package(fake: FakeOsm, osm: Osm, template: Path, tmp_path: Path) -> None:
    package, data = tmp_path / "nst.tar.gz", template.read_bytes()
    with tarfile.open(package, "w:gz") as archive:
        entry = tarfile.TarInfo("video/nst.yaml")
        entry.size = len(data)
        archive.addfile(entry, io.BytesIO(data))
    assert slices.add_template(osm, package) == "video-slice"


@pytest.mark.parametrize("text", ["", "[1", "nst: []", "nst: [{name: a}]", "vnfd: {id: a}"])
def test_other_files_are_no_templates(osm: Osm, tmp_path: Path, text: str) -> None:
    path = tmp_path / "nst.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="not a network slice template"):
        slices.add_template(osm, path)
    with pytest.raises(InputError, match="can't be read"):
        slices.add_template(osm, tmp_path / "gone")


def test_unknown_names_are_said(fake: FakeOsm, osm: Osm, template: Path) -> None:
    text = template.read_text("utf-8")
    template.write_text(text.replace("nsd-ref: ", "nsd-ref: other-"), encoding="utf-8")
    with pytest.raises(OsmError, match="references a non existing nsd"):
        slices.add_template(osm, template)
    template.write_text(text, encoding="utf-8")
    slices.add_template(osm, template)
    with pytest.raises(SettingError, match="no network slice template of this name") as caught:
        slices.create(osm, "north", "audio-slice", osm.vim("edge-site"), NOT_WAITING)
    assert "video-slice" in caught.value.remedy
    with pytest.raises(SettingError, match="no network slice of this name"):
        slices.remove(osm, "south", NOT_WAITING)
    for sites in ([], ["--vim", "edge-site", "--cluster", "edge-cluster"]):
        with pytest.raises(SettingError, match="either --vim or --cluster"):
            run(fake, "slice", "create", "north", "video-slice", *sites)
