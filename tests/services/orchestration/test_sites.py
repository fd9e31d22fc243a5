"""VIM accounts, clusters and Helm repositories are registered, listed and removed."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from scan2sim.flows.commands.orchestrate import app
from scan2sim.pipeline.core.errors import InputError, ScanError
from scan2sim.services.orchestration import sites
from tests.fakes.osm import FakeOsm

KUBECONFIG = """
kind: Config
clusters: [{name: a, cluster: {server: "https://10.0.0.1:6443", certificate-authority-data: "eA=="}}]
users: [{name: u, user: {token: hush}}]
"""


def run(fake: FakeOsm, *words: object) -> str:
    done = CliRunner().invoke(app, [*map(str, words), "--osm", fake.address])
    if done.exception and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.output


def test_a_site_is_added_listed_and_removed(fake: FakeOsm, tmp_path: Path) -> None:
    password, kubeconfig = tmp_path / "password", tmp_path / "kubeconfig.yaml"
    password.write_text("hush\n", encoding="utf-8")
    kubeconfig.write_text(KUBECONFIG, encoding="utf-8")
    account = ("vim", "add", "core", "http://vim:5000/v3", "--vim-user", "osm", "--vim-password", password, "--wait")
    assert "core is added" in run(fake, *account)
    assert "already in OSM" in run(fake, *account) and len(fake.state.vims) == 2
    (vim,) = (key for key, one in fake.state.vims.items() if one["name"] == "core")
    assert fake.state.vims[vim]["vim_password"] == "hush"
    assert "blue is added" in run(fake, "cluster", "add", "blue", kubeconfig, "--vim", "core", "--network", "ext")
    (made,) = (one for one in fake.state.clusters.values() if one["name"] == "blue")
    assert made["vim_account"] == vim and made["nets"] == {"mgmtnet": "ext"} and made["credentials"]["users"]
    assert "charts is added" in run(fake, "repo", "add", "charts", "oci://registry.example.org/charts")
    listed = run(fake, "vim", "list")
    assert "core" in listed and "enabled" in listed and "hush" not in listed + run(fake, "cluster", "list")
    for kind, name in (("repo", "charts"), ("cluster", "blue"), ("vim", vim)):
        assert "removed" in run(fake, kind, "remove", name)
    assert len(fake.state.vims) == len(fake.state.clusters) == 1 and not fake.state.repositories


def test_a_site_that_osm_cannot_use_is_reported(fake: FakeOsm, tmp_path: Path) -> None:
    password = tmp_path / "password"
    password.write_text("x", encoding="utf-8")
    words = ("vim", "add", "unreachable", "http://vim/v3", "--vim-user", "u", "--vim-password", password, "--wait")
    with pytest.raises(ScanError, match="no route to host"):
        run(fake, *words)
    assert "no route to host" in " ".join(run(fake, "vim", "list").split())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "not a kubeconfig"),
        ("[1", "invalid YAML"),
        ("kind: Deployment", "not a kubeconfig"),
        (KUBECONFIG.replace('certificate-authority-data: "eA=="', "certificate-authority: /ca.pem"), "/ca.pem"),
        (KUBECONFIG.replace("token: hush", "client-key: key.pem"), "key.pem"),
    ],
)
def test_kubeconfigs_that_osm_cannot_use_are_rejected(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "config"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=expected) as caught:
        sites.cluster_request("a", path, vim="1", version="1.30", network=None)
    assert "--raw" in caught.value.remedy
    with pytest.raises(InputError, match="can't be read"):
        sites.cluster_request("a", tmp_path / "gone", vim="1", version="1.30", network=None)


def test_progress_is_printed_without_a_terminal(fake: FakeOsm, tmp_path: Path) -> None:
    path = tmp_path / "services.toml"
    path.write_text(
        'deployment = "a"\n[[service]]\nname = "one"\nservice = "detect"\ncluster = "edge-cluster"\n', encoding="utf-8"
    )
    lines = run(fake, "apply", path, "--wait").splitlines()
    assert "a: one: create" in lines and "a: one: instantiate" in lines
