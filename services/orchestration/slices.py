"""Network slices of OSM: templates (NST) are onboarded; slices (NSI) are created from them and removed.

A slice instantiates the network services of its template together, connected by the template's links (ETSI GR NFV-EVE
012; 3GPP TS 28.530).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from scan2sim.pipeline.core.errors import InputError, SettingError, StepError
from scan2sim.services.orchestration import lifecycle
from scan2sim.services.orchestration.lifecycle import Notify, WaitPolicy
from scan2sim.services.orchestration.osm import SLICE_OPERATIONS, TEMPLATES, Osm
from scan2sim.services.orchestration.package import MAX_BYTES
from scan2sim.services.orchestration.records import SliceRecord, TemplateRecord

GZIP_MAGIC = b"\x1f\x8b"
Found = TypeVar("Found", TemplateRecord, SliceRecord)


def add_template(osm: Osm, path: Path) -> str:
    """Onboard a template, a YAML file or a .tar.gz package, whose network services OSM has; returns its id.

    A template with this id is kept as it is.

    Raises:
        InputError: the file can't be read, or isn't a template.
        OsmError: OSM refuses it; says why.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(path, f"larger than {MAX_BYTES:,} bytes", "Give a network slice template")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "Give a YAML file or a .tar.gz package") from None
    if data.startswith(GZIP_MAGIC):
        record = osm.add_template(data, "application/gzip")
        return next((one.id for one in osm.templates() if one.record == record), record)
    name = _template_id(path, data)
    if not any(one.id == name for one in osm.templates()):
        osm.add_template(data, "application/yaml")
    return name


def _template_id(path: Path, data: bytes) -> str:
    """Id in a template."""
    import yaml

    try:
        (template,) = yaml.safe_load(data)["nst"]
        return str(template["id"])
    except (yaml.YAMLError, ValueError, TypeError, KeyError, RecursionError):
        cause = "not a network slice template"
        raise InputError(path, cause, "Write a list `nst` of one template with `id` and `netslice-subnet`") from None


def create(
    osm: Osm, name: str, template: str, vim: str, wait_policy: WaitPolicy, notify: Notify = lambda _: None
) -> bool:
    """Create and instantiate a slice; one of this name is kept as it is.

    Args:
        template: name or id of its template.
        vim: id of the VIM account on which its network services are instantiated.

    Returns:
        Whether it is new.

    Raises:
        SettingError: there is no such template. OperationFailed: OSM reports a failure. StepError: timeout.
    """
    if any(one.name == name for one in osm.slices()):
        return False
    body = {
        "nsiName": name,
        "nstId": _find(osm.templates(), template, "network slice template").record,
        "vimAccountId": vim,
    }
    operation = osm.create_slice(body)
    if wait_policy.wait:
        lifecycle.wait_for_operation(osm, name, operation, wait_policy, notify, SLICE_OPERATIONS)
    return True


def remove(osm: Osm, name: str, wait_policy: WaitPolicy, notify: Notify = lambda _: None) -> None:
    """Terminate a slice with its network services and remove its record, given by name or id.

    Raises:
        SettingError: there is none. StepError: OSM can't terminate it, or `wait_policy.timeout` is exceeded.
    """
    key = _find(osm.slices(), name, "network slice").record
    osm.remove_slice(key)
    ends = time.monotonic() + wait_policy.timeout
    while found := [one for one in osm.slices() if one.record == key]:
        if time.monotonic() > ends:
            detail = f" ({found[0].detail[:300]})" if found[0].detail else ""
            cause = f"OSM hasn't removed the slice within {wait_policy.timeout:g} s{detail}"
            raise StepError(name, cause, "See the log of OSM's lifecycle manager")
        notify("waiting until it is removed")
        time.sleep(lifecycle.POLL_INTERVAL_S)


def remove_template(osm: Osm, name: str) -> None:
    """Remove a template, given by name or id.

    Raises:
        SettingError: there is none. OsmError: a slice uses it.
    """
    osm.remove(TEMPLATES, _find(osm.templates(), name, "network slice template").record)


def _find(records: Sequence[Found], name: str, kind: str) -> Found:
    """The record with this name or id."""
    found = [
        one for one in records if name in (one.name, one.record, one.id if isinstance(one, TemplateRecord) else "")
    ]
    if len(found) != 1:
        known = ", ".join(sorted(one.name for one in records)) or "none"
        count = "no" if not found else "more than one"
        raise SettingError(name, f"OSM has {count} {kind} of this name", f"Available: {known}")
    return found[0]
