"""Parser of descriptors: safe against malicious YAML, validated against JSON Schemas before anything is sent to OSM.

SOL006's YANG modules aren't part of this project: `schemas/` has what is read here, and OSM checks the rest;
`tests/services/orchestration/test_yang.py` validates packages by the modules themselves.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from scan2sim.pipeline.core.errors import InputError

DescriptorType = Literal["vnfd", "nsd"]
SCHEMAS = Path(__file__).parent / "schemas"
MAX_LENGTH = 1_000_000
"""Maximum length of a descriptor in characters."""
MAX_NESTING = 50
"""Maximum nesting depth of its YAML."""
PRE_SOL006_KEYS = ("vnfd:vnfd-catalog", "vnfd-catalog", "nsd:nsd-catalog", "nsd-catalog")
"""Top-level keys of descriptors of the older information model, which OSM rejects since Release 9."""
PRE_SOL006_FIELDS = ("mgmt-interface", "connection-point", "internal-vld", "constituent-vnfd", "vld")
"""Fields of the same model."""
MIGRATION_HINT = (
    "Convert it to SOL006: `vnfd-catalog.vnfd[0]` becomes `vnfd`, `connection-point` becomes `ext-cpd`,"
    " `mgmt-interface` becomes `mgmt-cp`, a vdu's `image` and `vm-flavor` become `sw-image-desc` and"
    " `virtual-compute-desc`; `nsd-catalog` becomes `nsd`, `constituent-vnfd` and `vld` become `df[].vnf-profile` and"
    " `virtual-link-desc`"
)


@dataclass(frozen=True)
class Descriptor:
    """Descriptor of a function or a network service.

    Attributes:
        type: "vnfd" or "nsd".
        id: its id, by which other descriptors refer to it.
        functions: ids of a network service's functions.
        body: the parsed descriptor.
    """

    type: DescriptorType
    id: str
    functions: tuple[str, ...]
    body: dict[str, Any]

    @property
    def kdus(self) -> tuple[str, ...]:
        """Names of its Helm charts or Juju bundles (Kubernetes deployment units)."""
        return tuple(one["name"] for one in self.body["vnfd"].get("kdu", ())) if self.type == "vnfd" else ()


def read(text: str, where: str | Path) -> Descriptor:
    """Parse and validate a descriptor.

    Args:
        where: its source, for error messages.

    Raises:
        InputError: not a descriptor, of the older model, or invalid.
    """
    return validate(_parse(text, where), where)


def validate(body: Any, where: str | Path) -> Descriptor:
    """Validate a parsed descriptor.

    Raises:
        InputError: see `read`.
    """
    import jsonschema

    if not isinstance(body, dict):
        raise InputError(where, "not a descriptor", "A descriptor begins with `vnfd:` or `nsd:`")
    inside = [key for part in body.values() if isinstance(part, dict) for key in part]
    old = [key for key in PRE_SOL006_KEYS if key in body] + [key for key in PRE_SOL006_FIELDS if key in inside]
    if old:
        cause = f"uses the model before SOL006 (`{old[0]}`), which OSM rejects since Release 9"
        raise InputError(where, cause, MIGRATION_HINT)
    type_: DescriptorType | None = "vnfd" if "vnfd" in body else "nsd" if "nsd" in body else None
    if type_ is None:
        raise InputError(where, "not a descriptor", "A descriptor begins with `vnfd:` or `nsd:`")
    validator = jsonschema.Draft202012Validator(_schema(type_))
    error = jsonschema.exceptions.best_match(validator.iter_errors(body))
    if error is not None:
        path = ".".join(str(part) for part in error.absolute_path) or type_
        raise InputError(where, f"{path}: {error.message:.200}", "Write it as SOL006 defines it")
    if type_ == "vnfd":
        return Descriptor(type_, body["vnfd"]["id"], (), body)
    one = body["nsd"]["nsd"][0]
    _check_profiles(one, where)
    return Descriptor(type_, one["id"], tuple(one.get("vnfd-id", ())), body)


def _check_profiles(nsd: dict[str, Any], where: str | Path) -> None:
    links = {link["id"] for link in nsd.get("virtual-link-desc", ())}
    for profile in (profile for flavour in nsd["df"] for profile in flavour.get("vnf-profile", ())):
        if profile["vnfd-id"] not in nsd.get("vnfd-id", ()):
            cause = f"vnf-profile {profile['id']} refers to {profile['vnfd-id']}, which is missing in `vnfd-id`"
            raise InputError(where, cause, "Add it to `vnfd-id`")
        for connection in profile.get("virtual-link-connectivity", ()):
            if connection["virtual-link-profile-id"] not in links:
                link = connection["virtual-link-profile-id"]
                cause = f"vnf-profile {profile['id']} refers to the link {link}, which isn't defined"
                raise InputError(where, cause, "Define it under `virtual-link-desc`")


@cache
def _schema(type_: DescriptorType) -> Any:
    return json.loads((SCHEMAS / f"{type_}.json").read_text("utf-8"))


def _parse(text: str, where: str | Path) -> Any:
    """Parse YAML; aliases are rejected because nested ones can expand to gigabytes ("billion laughs")."""
    import yaml

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("aliases aren't allowed: write out what they refer to")
            self.depth += 1
            if self.depth > MAX_NESTING:
                raise yaml.YAMLError(f"nested deeper than {MAX_NESTING} levels")
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

        def construct_mapping(self, node: Any, depth: bool = False) -> Any:
            keys = [str(key.value) for key, _ in node.value]
            duplicate = next((key for key in keys if keys.count(key) > 1), None)
            if duplicate is not None:
                raise yaml.YAMLError(f"duplicate key `{duplicate}`")
            return super().construct_mapping(node, depth)

    if len(text) > MAX_LENGTH:
        raise InputError(where, f"longer than {MAX_LENGTH:,} characters", "Give a descriptor, or shorten it")
    try:
        return Loader(text).get_single_data()
    except yaml.YAMLError as error:
        raise InputError(where, f"invalid YAML ({' '.join(str(error).split())[:200]})", "Fix it") from None
    except (ValueError, RecursionError) as error:
        raise InputError(where, f"invalid YAML ({error})", "Fix it") from None
