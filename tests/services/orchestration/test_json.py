"""`--json` of every command: one document on standard output, whatever happens; progress and errors elsewhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from scan2sim.flows.commands.orchestrate import app
from scan2sim.pipeline.core.errors import SettingError
from tests.fakes.osm import FakeOsm
from tests.services.orchestration.test_sites import KUBECONFIG
from tests.services.orchestration.test_slices import TEMPLATE


def run(fake: FakeOsm, *words: object) -> Any:
    """The document that a command prints; it succeeds."""
    done = CliRunner().invoke(app, [*map(str, words), "--json", "--osm", fake.address], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@pytest.fixture
def packages(tmp_path: Path) -> dict[str, str]:
    """Files of a detector's packages, by kind."""
    done = CliRunner().invoke(app, ["package", "detect", "--out", str(tmp_path / "packages"), "--json"])
    found: dict[str, str] = json.loads(done.stdout)
    assert set(found) == {"function", "service"} and all(Path(one).is_file() for one in found.values())
    return found


def test_life_of_an_instance(fake: FakeOsm, packages: dict[str, str]) -> None:
    onboarded = run(fake, "onboard", *packages.values())
    (nsd,) = (one["id"] for one in fake.state.services.values())
    assert nsd in onboarded["onboarded"] and len(onboarded["onboarded"]) == 2 and onboarded["failed"] == []
    started = run(fake, "instantiate", "one", nsd, "--cluster", "edge-cluster", "--wait")
    assert started == {"instance": "one", "operation": "instantiate", "finished": True}
    scaled = run(fake, "scale", "one", 3)
    assert scaled == {"instance": "one", "operation": "scale", "finished": False, "replicas": 3}
    assert run(fake, "heal", "one", "--wait")["operation"] == "heal"
    assert run(fake, "terminate", "one") == {"instance": "one", "operation": "terminate", "finished": True}
    assert run(fake, "delete", *packages.values()) == {"deleted": list(packages.values())}
    assert not fake.state.instances and not fake.state.services


def test_sites_and_slices(fake: FakeOsm, packages: dict[str, str], tmp_path: Path) -> None:
    password, kubeconfig, template = tmp_path / "password", tmp_path / "kubeconfig", tmp_path / "nst.yaml"
    password.write_text("hush", encoding="utf-8")
    kubeconfig.write_text(KUBECONFIG, encoding="utf-8")
    account = ("core", "http://vim:5000/v3", "--vim-user", "osm", "--vim-password", password)
    assert run(fake, "vim", "add", *account, "--wait") == {"name": "core", "added": True, "finished": True}
    assert run(fake, "vim", "add", *account) == {"name": "core", "added": False, "finished": False}
    assert run(fake, "cluster", "add", "blue", kubeconfig, "--vim", "core")["added"]
    assert run(fake, "repo", "add", "charts", "oci://registry.example.org/charts")["added"]
    for kind, name in (("repo", "charts"), ("cluster", "blue"), ("vim", "core")):
        assert run(fake, kind, "remove", name) == {"removed": name}
    run(fake, "onboard", *packages.values())
    (nsd,) = (one["id"] for one in fake.state.services.values())
    template.write_text(TEMPLATE.format(service=nsd), encoding="utf-8")
    assert run(fake, "slice", "add-template", template) == {"name": "video-slice"}
    create = ("slice", "create", "north", "video-slice", "--cluster", "edge-cluster", "--wait")
    assert run(fake, *create) == {"name": "north", "created": True, "finished": True}
    assert run(fake, "slice", "remove", "north") == {"removed": "north"}
    assert run(fake, "slice", "remove-template", "video-slice") == {"removed": "video-slice"}


def test_a_failure_prints_no_document_unless_part_of_it_succeeded(
    fake: FakeOsm, packages: dict[str, str], tmp_path: Path
) -> None:
    done = CliRunner().invoke(app, ["heal", "ghost", "--json", "--osm", fake.address])
    assert done.exit_code and not done.stdout
    bad = tmp_path / "bad.tar.gz"
    bad.write_bytes(b"rubbish")
    done = CliRunner().invoke(app, ["onboard", str(bad), *packages.values(), "--json", "--osm", fake.address])
    found = json.loads(done.stdout)
    assert done.exit_code and len(found["onboarded"]) == 2 and str(bad) in found["failed"][0]


def test_deleting_a_deployment_prints_what_apply_prints_and_mixed_files_are_rejected(
    fake: FakeOsm, town: Path, packages: dict[str, str]
) -> None:
    run(fake, "apply", town, "--wait")
    for files in ((town, town), (town, packages["service"])):
        with pytest.raises(SettingError, match="services.toml"):
            run(fake, "delete", *files)
    assert fake.state.instances, "nothing was deleted"
    deleted = run(fake, "delete", town)
    assert {one["action"] for one in deleted["done"]} == {"removed"} and not fake.state.instances
