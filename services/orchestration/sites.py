"""Sites of OSM: VIM accounts, Kubernetes clusters and Helm repositories are registered, listed and removed."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import InputError, SettingError, StepError
from scan2sim.services.credentials import is_secret, redacted, secrets_of, without
from scan2sim.services.orchestration import lifecycle
from scan2sim.services.orchestration.lifecycle import Notify, WaitPolicy
from scan2sim.services.orchestration.osm import CLUSTERS, REPOSITORIES, SITE_KINDS, VIMS, Osm
from scan2sim.services.orchestration.sol006 import LINK_ID

MAX_FILE_BYTES = 1_000_000
"""Maximum size of a kubeconfig, or of a VIM's settings."""


def read_secret(path: Path) -> str:
    """A password or token in a text file.

    Raises:
        InputError: the file can't be read, or is empty.
    """
    remedy = "Give a text file that holds it"
    try:
        found = path.read_text("utf-8").strip()
    except (OSError, UnicodeError) as error:
        raise InputError(path, f"can't be read ({error})", remedy) from None
    if not found:
        raise InputError(path, "is empty", remedy)
    return found


def vim_config(path: Path | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a VIM that depend on its type, such as `security_groups` and `insecure` of OpenStack.

    Args:
        path: YAML or JSON file with them; None: no file.
        given: further ones from the command line, which override those of the file.

    Raises:
        InputError: the file isn't a mapping of names to values. SettingError: a credential is given on the command
            line, where other users of the machine see it, or a value can't be sent as JSON.
    """
    if wrong := next(filter(is_secret, given), None):
        cause = f"{wrong} is a credential, which other users see on the command line"
        raise SettingError("--set", cause, "Put it in the file of --config")
    remedy = "Write a mapping, such as: security_groups: [default]"
    found = {} if path is None else _read_yaml(path, "a file of settings", remedy)
    if not isinstance(found, dict):
        raise InputError(path or "--config", "not a mapping of names to values", remedy)
    config = {str(name): value for name, value in found.items()} | dict(given)
    try:
        json.dumps(config, allow_nan=False)
    except (TypeError, ValueError):
        cause = "has a value that JSON doesn't have, such as a date"
        raise SettingError("--config", cause, "Put it in quotes") from None
    return config


def vim_request(
    name: str, url: str, *, kind: str, user: str, password: str, tenant: str, config: Mapping[str, Any]
) -> dict[str, Any]:
    """Body of the request that registers a VIM account.

    Args:
        kind: type of the VIM, such as openstack.
        user, password, tenant: account and project at the VIM.
        config: settings that depend on the type of the VIM; without any, none are sent.
    """
    return {
        "name": name,
        "vim_type": kind,
        "vim_url": url,
        "vim_user": user,
        "vim_password": password,
        "vim_tenant_name": tenant,
    } | ({"config": dict(config)} if config else {})


def cluster_request(name: str, kubeconfig: Path, *, vim: str, version: str, network: str | None) -> dict[str, Any]:
    """Body of the request that registers a Kubernetes cluster.

    Args:
        kubeconfig: file with its address and credentials.
        vim: id of the VIM account that it belongs to.
        version: its version of Kubernetes.
        network: network of the VIM on which its nodes are; None if there is no VIM behind the account.

    Raises:
        InputError: the file isn't a kubeconfig.
    """
    return {
        "name": name,
        "credentials": _read_kubeconfig(kubeconfig),
        "vim_account": vim,
        "k8s_version": version,
        "nets": {LINK_ID: network},
        "deployment_methods": {"helm-chart-v3": True, "juju-bundle": False},
        "namespace": "kube-system",
    }


def repository_request(name: str, url: str, *, user: str | None = None, password: str | None = None) -> dict[str, Any]:
    """Body of the request that registers a repository of Helm charts.

    Args:
        url: its address, https:// or oci://.
        user, password: login of a private repository; None: it is public.

    Raises:
        SettingError: the address contains a login, which OSM would list, or a login isn't complete.
    """
    if (user is None) != (password is None):
        missing = "--repo-user" if user is None else "--repo-password"
        raise SettingError(missing, "missing: a login is a user name and a password", "Give both, or neither")
    if redacted(url) != url:
        raise SettingError("URL", "contains a login", "Give --repo-user, and a file with the password: --repo-password")
    body: dict[str, Any] = {"name": name, "type": "helm-chart", "url": url}
    if url.startswith("oci://"):
        body["oci"] = True
    return body if user is None else body | {"user": user, "password": password}


def _read_yaml(path: Path, what: str, remedy: str) -> Any:
    import yaml

    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(path, f"too large for {what}", remedy)
        return yaml.safe_load(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", remedy) from None
    except (yaml.YAMLError, ValueError, RecursionError):
        raise InputError(path, f"not {what} (invalid YAML)", remedy) from None


def _read_kubeconfig(path: Path) -> dict[str, Any]:
    remedy = "Give the file that kubectl uses, with its certificates inside (kubectl config view --raw --minify)"
    found = _read_yaml(path, "a kubeconfig", remedy)
    if not isinstance(found, dict) or found.get("kind") != "Config" or not isinstance(found.get("clusters"), list):
        raise InputError(path, "not a kubeconfig", remedy)
    files = [
        str(value)
        for entry in (*found["clusters"], *(found.get("users") or ()))
        for part in (entry.values() if isinstance(entry, dict) else ())
        for name, value in (part.items() if isinstance(part, dict) else ())
        if name in ("certificate-authority", "client-certificate", "client-key", "tokenFile")
    ]
    if files:
        raise InputError(path, f"refers to {files[0]:.100}, a file that OSM doesn't have", remedy)
    return found


def add(osm: Osm, collection: str, body: Mapping[str, Any], wait_policy: WaitPolicy, notify: Notify) -> bool:
    """Register a VIM account, cluster or repository; one of this name is kept as it is.

    Args:
        collection: `VIMS`, `CLUSTERS` or `REPOSITORIES`.

    Returns:
        Whether it is new.

    Raises:
        StepError: OSM reports that it can't be used, or `wait_policy.timeout` is exceeded.
    """
    name = str(body["name"])
    new = not any(one.name == name for one in osm.sites(collection))
    if new:
        osm.add_site(collection, body)
    if wait_policy.wait:
        _wait_until_usable(osm, collection, body, wait_policy, notify)
    return new


def _wait_until_usable(
    osm: Osm, collection: str, body: Mapping[str, Any], wait_policy: WaitPolicy, notify: Notify
) -> None:
    name, ends = str(body["name"]), time.monotonic() + wait_policy.timeout
    while not wait_policy.stop():
        found = osm.site(collection, name)
        state, detail = found.admin.operational_state, without(found.admin.detail, secrets_of(body))[:300]
        if state == "ENABLED":
            return
        if state == "ERROR":
            cause = f"OSM can't use this {SITE_KINDS[collection]} ({detail or 'no reason given'})"
            raise StepError(name, cause, "Check its address and credentials, remove it, and add it again")
        if time.monotonic() > ends:
            cause = f"OSM hasn't checked this {SITE_KINDS[collection]} within {wait_policy.timeout:g} s"
            raise StepError(name, cause, "Run again to continue waiting")
        notify(f"waiting until it can be used ({detail or state})")
        time.sleep(lifecycle.POLL_INTERVAL_S)


def remove(osm: Osm, collection: str, name: str, wait_policy: WaitPolicy) -> None:
    """Remove a VIM account, cluster or repository, given by name or id.

    Raises:
        SettingError: there is none. OsmError: it is in use. StepError: `wait_policy.timeout` is exceeded.
    """
    key = osm.site(collection, name).record
    osm.remove(collection, key)
    ends = time.monotonic() + wait_policy.timeout
    while any(one.record == key for one in osm.sites(collection)):
        if time.monotonic() > ends:
            cause = f"OSM hasn't removed this {SITE_KINDS[collection]} within {wait_policy.timeout:g} s"
            raise StepError(name, cause, "See the log of OSM's lifecycle manager")
        time.sleep(lifecycle.POLL_INTERVAL_S)


COLLECTIONS = {"vim": VIMS, "cluster": CLUSTERS, "repo": REPOSITORIES}
"""Collections by the names of their commands."""
