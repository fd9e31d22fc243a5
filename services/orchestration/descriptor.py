"""Descriptors as text: read without trusting them, and checked against JSON Schemas before anything is sent.

SOL006's own YANG modules rest on others that can't be had, so the schemas (`schemas/`) hold the subset that is used.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from scan2sim.pipeline.core.errors import InputError

Sort = Literal["vnfd", "nsd"]
SCHEMAS = Path(__file__).parent / "schemas"
LARGEST = 1_000_000
"""Bytes of a descriptor."""
DEEPEST = 50
"""Levels of what is within something else."""
OLD = ("vnfd:vnfd-catalog", "vnfd-catalog", "nsd:nsd-catalog", "nsd-catalog")
"""How descriptors of the model before SOL006 begin; OSM takes none since Release 9."""
MOVED = (
    "Write it as SOL006: `vnfd-catalog.vnfd[0]` becomes `vnfd`, `connection-point` becomes `ext-cpd`, `mgmt-interface`"
    " `mgmt-cp`, a vdu's `image` and `vm-flavor` `sw-image-desc` and `virtual-compute-desc`; `nsd-catalog` becomes"
    " `nsd`, `constituent-vnfd` and `vld` become `df[].vnf-profile` and `virtual-link-desc`"
)


@dataclass(frozen=True)
class Descriptor:
    """Of a function or a network service.

    Attributes:
        sort: which of them.
        id: by which others name it.
        functions: ids of the functions that a network service has.
        body: all of it.
    """

    sort: Sort
    id: str
    functions: tuple[str, ...]
    body: dict[str, Any]

    @property
    def kdus(self) -> tuple[str, ...]:
        """Names of its Helm charts or Juju bundles."""
        return tuple(one["name"] for one in self.body["vnfd"].get("kdu", ())) if self.sort == "vnfd" else ()


def read(text: str, where: str | Path) -> Descriptor:
    """Check a descriptor.

    Args:
        where: it is from, for messages.

    Raises:
        InputError: it is none, of the old model, or says something that OSM would refuse.
    """
    return checked(_parsed(text, where), where)


def checked(body: Any, where: str | Path) -> Descriptor:
    """A descriptor of what its text says.

    Raises:
        InputError: as `read`.
    """
    import jsonschema

    if not isinstance(body, dict):
        raise InputError(where, "is no descriptor", "It begins with `vnfd:` or `nsd:`")
    old = next((key for key in OLD if key in body), None)
    if old:
        raise InputError(where, f"is of the model before SOL006 (`{old}`), which OSM refuses since Release 9", MOVED)
    sort: Sort | None = "vnfd" if "vnfd" in body else "nsd" if "nsd" in body else None
    if sort is None:
        raise InputError(where, "is no descriptor", "It begins with `vnfd:` or `nsd:`")
    validator = jsonschema.Draft202012Validator(_schema(sort))
    error = jsonschema.exceptions.best_match(validator.iter_errors(body))
    if error is not None:
        path = ".".join(str(part) for part in error.absolute_path) or sort
        raise InputError(where, f"{path}: {error.message:.200}", "Mend it: OSM would refuse it")
    if sort == "vnfd":
        return Descriptor(sort, body["vnfd"]["id"], (), body)
    one = body["nsd"]["nsd"][0]
    _check_profiles(one, where)
    return Descriptor(sort, one["id"], tuple(one["vnfd-id"]), body)


def _check_profiles(nsd: dict[str, Any], where: str | Path) -> None:
    links = {link["id"] for link in nsd.get("virtual-link-desc", ())}
    for profile in (profile for flavour in nsd["df"] for profile in flavour["vnf-profile"]):
        if profile["vnfd-id"] not in nsd["vnfd-id"]:
            cause = f"vnf-profile {profile['id']} is of {profile['vnfd-id']}, which `vnfd-id` doesn't list"
            raise InputError(where, cause, "List it")
        for connection in profile.get("virtual-link-connectivity", ()):
            if connection["virtual-link-profile-id"] not in links:
                cause = f"vnf-profile {profile['id']} joins {connection['virtual-link-profile-id']}, which is no link"
                raise InputError(where, cause, "Describe it under `virtual-link-desc`")


@cache
def _schema(sort: Sort) -> Any:
    return json.loads((SCHEMAS / f"{sort}.json").read_text("utf-8"))


def _parsed(text: str, where: str | Path) -> Any:
    """What YAML says; aliases are refused, as a few lines of them say a billion things."""
    import yaml

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        deep = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("aliases are refused: write out what they stand for")
            self.deep += 1
            if self.deep > DEEPEST:
                raise yaml.YAMLError(f"more than {DEEPEST} levels")
            node = super().compose_node(parent, index)
            self.deep -= 1
            return node

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = [str(key.value) for key, _ in node.value]
            twice = next((key for key in keys if keys.count(key) > 1), None)
            if twice is not None:
                raise yaml.YAMLError(f"`{twice}` stands twice")
            return super().construct_mapping(node, deep)

    if len(text) > LARGEST:
        raise InputError(where, f"is of more than {LARGEST:,} bytes", "No descriptor is")
    try:
        return Loader(text).get_single_data()
    except yaml.YAMLError as error:
        raise InputError(where, f"is no YAML that is taken ({' '.join(str(error).split())[:200]})", "Mend it") from None
    except (ValueError, RecursionError) as error:
        raise InputError(where, f"is no YAML ({error})", "Mend it") from None
