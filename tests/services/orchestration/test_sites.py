"""VIM accounts, clusters and Helm repositories are registered, listed and removed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from scan2sim.flows.commands.orchestrate import app
from scan2sim.pipeline.core.errors import InputError, ScanError, SettingError
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


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """File with a password."""
    path = tmp_path / "secret"
    path.write_text("hunter2\n", encoding="utf-8")
    return path


def test_settings_of_a_provider_are_sent(fake: FakeOsm, secret: Path, tmp_path: Path) -> None:
    config = tmp_path / "vim.yaml"
    config.write_text("security_groups: [default]\ninsecure: false\nca_password: hush\n", encoding="utf-8")
    account = ("vim", "add", "core", "http://vim:5000/v3", "--vim-user", "osm", "--vim-password", secret)
    run(fake, *account, "--config", config, "--set", "insecure=true", "--set", "keypair=laptop")
    (made,) = (one for one in fake.state.vims.values() if one["name"] == "core")
    assert made["config"] == {
        "security_groups": ["default"], "insecure": True, "ca_password": "hush", "keypair": "laptop"
    }  # fmt: skip


@pytest.mark.parametrize("text", ["", "[1, 2]", "just text", "a: [", "when: 2026-01-01", "a: .nan"])
def test_files_that_are_no_settings_of_a_provider_are_rejected(tmp_path: Path, text: str) -> None:
    path = tmp_path / "vim.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises((InputError, SettingError)):
        sites.vim_config(path, {})


def test_credentials_of_a_provider_are_not_accepted_on_the_command_line() -> None:
    with pytest.raises(SettingError, match="nsx_password is a credential") as caught:
        sites.vim_config(None, {"insecure": True, "nsx_password": "hunter2"})
    assert "--config" in caught.value.remedy and "hunter2" not in str(caught.value)


@pytest.mark.parametrize(("url", "is_oci"), [("https://charts.example.org", False), ("oci://registry/charts", True)])
def test_a_private_repository_is_registered_with_its_login(fake: FakeOsm, secret: Path, url: str, is_oci: bool) -> None:
    output = run(fake, "repo", "add", "charts", url, "--repo-user", "robot", "--repo-password", secret, "--wait")
    (made,) = fake.state.repositories.values()
    assert (made["user"], made["password"], made.get("oci", False)) == ("robot", "hunter2", is_oci)
    assert "charts is added" in output and "hunter2" not in output + run(fake, "repo", "list")


@pytest.mark.parametrize(
    ("url", "login", "expected"),
    [
        ("https://robot:hunter2@charts.example.org", {}, "contains a login"),
        ("https://charts.example.org", {"user": "robot"}, "--repo-password"),
        ("https://charts.example.org", {"password": "hunter2"}, "--repo-user"),
    ],
)
def test_logins_that_are_shown_or_incomplete_are_rejected(url: str, login: dict[str, Any], expected: str) -> None:
    with pytest.raises(SettingError, match=expected) as caught:
        sites.repository_request("charts", url, **login)
    assert "hunter2" not in str(caught.value)


def test_passwords_that_osm_quotes_are_redacted(fake: FakeOsm, secret: Path) -> None:
    secret.write_text(30 * "hunter2", encoding="utf-8")
    words = ("repo", "add", "charts", "https://charts", "--repo-user", "robot", "--repo-password", secret)
    with pytest.raises(ScanError, match="too long") as caught:
        run(fake, *words)
    assert "***" in caught.value.cause and "hunter" not in str(caught.value)


def test_empty_files_of_passwords_are_rejected(secret: Path) -> None:
    secret.write_text("\n", encoding="utf-8")
    with pytest.raises(InputError, match="is empty"):
        sites.read_secret(secret)


def test_progress_is_printed_without_a_terminal(fake: FakeOsm, tmp_path: Path) -> None:
    path = tmp_path / "services.toml"
    path.write_text(
        'deployment = "a"\n[[service]]\nname = "one"\nservice = "detect"\ncluster = "edge-cluster"\n', encoding="utf-8"
    )
    lines = run(fake, "apply", path, "--wait").splitlines()
    assert "a: one: create" in lines and "a: one: instantiate" in lines


def test_plan_and_apply_print_json_only_on_standard_output(fake: FakeOsm, town: Path) -> None:
    def as_json(*words: object) -> Any:
        return json.loads(CliRunner().invoke(app, [*map(str, words), "--json", "--osm", fake.address]).stdout)

    planned = as_json("plan", town)
    assert {"name": "detect-north", "action": "create", "reason": "not in OSM"} in planned
    applied = as_json("apply", town, "--wait")
    assert {one["name"] for one in applied["done"]} == {one["name"] for one in planned} and not applied["failed"]
    assert as_json("plan", town) == [] and as_json("apply", town) == {"done": [], "failed": {}}


def test_failures_of_apply_are_in_its_json(fake: FakeOsm, town: Path) -> None:
    fake.state.outcome = lambda kind, name: "FAILED" if (kind, name) == ("instantiate", "detect-north") else "COMPLETED"
    done = CliRunner().invoke(app, ["apply", str(town), "--wait", "--json", "--osm", fake.address])
    failed = json.loads(done.stdout)["failed"]
    assert done.exit_code and list(failed) == ["detect-north"] and "no quota" in failed["detect-north"]
