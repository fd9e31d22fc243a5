"""Fake of OSM's northbound interface: keeps state and returns the same responses as OSM.

`python -m tests.fakes.osm [--port 9999] [--seconds 2]` serves it by HTTP, user and password admin, for `scan2sim
orchestrate ... --osm http://localhost:9999`. Its responses were recorded from OSM's own server, a current one (2026)
and Release 8, with an in-memory database and a stubbed lifecycle manager, and conform to OSM's OpenAPI file. Operations
are accepted while another one runs, and executed one after the other. Nothing is deployed: an operation takes some
seconds and completes. Values of charts are merged like OSM's lifecycle manager does (`OsmState.releases`).
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import ssl
import tarfile
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import yaml
from jsonschema import Draft202012Validator

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.services.orchestration.package import MAX_BYTES, parse

TOKEN_LIFETIME_S = 3600.0
CUT_BEFORE, CUT_AFTER = "cut before", "cut after"
"""Faults in addition to HTTP statuses: the connection is closed before or after the request is executed."""

Record = dict[str, Any]
CHARTS = "additionalParamsForKdu"
_TEXT = {"type": "string"}
_UUID = {"type": "string", "pattern": r"^[a-fA-F0-9]{8}(-[a-fA-F0-9]{4}){3}-[a-fA-F0-9]{12}\Z"}
_NAME = {"type": "string", "minLength": 1, "maxLength": 60}
VIM_TYPES = ("openstack", "aws", "azure", "gcp", "vmware", "openvim", "opennebula", "fos", "dummy")


def _schema(required: Record, **optional: Record) -> Record:
    return {"type": "object", "properties": required | optional, "required": list(required)}


SCHEMAS: dict[str, Record] = {
    "vim_accounts": _schema(
        {"name": _NAME, "vim_url": _TEXT, "vim_type": {"enum": VIM_TYPES}}
        | {"vim_user": _TEXT, "vim_password": _TEXT, "vim_tenant_name": _TEXT},
        **dict.fromkeys(("description", "vim", "datacenter", "schema_type", "schema_version"), _TEXT),
        config={"type": "object"},
    )
    | {"additionalProperties": False},
    "k8sclusters": _schema(
        {"name": _NAME, "credentials": {"type": "object"}, "vim_account": _UUID, "k8s_version": _TEXT}
        | {"nets": {"type": ["object", "array"], "items": {"type": "object"}}},  # array: the OpenAPI file of Release 8
        **dict.fromkeys(("description", "namespace", "schema_type", "schema_version"), _TEXT),
        cni={"type": "array", "items": _TEXT},
    ),
    "k8srepos": _schema(
        {"name": _NAME, "url": _TEXT, "type": {"enum": ["helm-chart", "juju-bundle"]}},
        description=_TEXT,
        user=_TEXT,
        password={"type": "string", "minLength": 1, "maxLength": 60},
        oci={"type": "boolean"},
    )
    | {"additionalProperties": False},
    "instance": _schema(
        {"nsName": _TEXT, "nsdId": _UUID, "vimAccountId": _UUID}, nsDescription={"type": ["string", "null"]}
    ),
    "slice": _schema(
        {"nsiName": _TEXT, "nstId": _UUID, "vimAccountId": _UUID}, nsiDescription={"type": ["string", "null"]}
    ),
    "template": _schema(
        {"id": _TEXT, "name": _TEXT}
        | {"netslice-subnet": {"type": "array", "items": _schema({"id": _TEXT, "nsd-ref": _TEXT})}}
    ),
    "heal": _schema({"healVnfData": {"type": "array", "items": _schema({"vnfInstanceId": _UUID})}}),
}
"""Types of fields that OSM checks, by the kind of record."""
JSON_STRING_PARAMS = ("primitive_params", "additionalParamsForVnf")
"""Parameters that newer releases store and return as JSON strings."""

Fault = int | str | None
Faults = Callable[[str, str], Fault]
"""Returns the fault of a request by its method and path; None: no fault."""


class Raw(bytes):
    """A whole response, status line and header included, as `OsmState.answer` may return it."""


class ErrorResponse(Exception):
    """An error response."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(detail)
        self.status, self.detail = status, detail


@dataclass
class OsmState:
    """Everything that the fake stores.

    Attributes:
        seconds: duration of an operation.
        outcome: final state of an operation by its kind and its instance's name: "COMPLETED", "FAILED", "never".
        as_json: return an operation's `primitive_params` or `additionalParamsForVnf` as a JSON string, like current
            releases; False: as the objects that were sent, like Release 8.
        sol006: accept descriptors of SOL006; False: refuse them like Release 8.
        answer: replaces the body of a response, by its method, its path and its body.
        releases: values of the Helm release of each instance, by its id, as the cluster has them.
        resources: ids of instances with running resources; one without its instance is an orphan.
        requests: time, method and path of all requests.
        running_counts: number of running operations at each request.
    """

    seconds: float = 0.3
    outcome: Callable[[str, str], str] = lambda kind, name: "COMPLETED"
    as_json: bool = True
    sol006: bool = True
    answer: Callable[[str, str, Any], Any] = lambda method, path, content: content
    token_lifetime_s: float = TOKEN_LIFETIME_S
    faults: Faults = lambda method, path: None
    tokens: dict[str, float] = field(default_factory=dict)
    functions: dict[str, Record] = field(default_factory=dict)
    services: dict[str, Record] = field(default_factory=dict)
    instances: dict[str, Record] = field(default_factory=dict)
    operations: dict[str, Record] = field(default_factory=dict)
    vims: dict[str, Record] = field(default_factory=dict)
    clusters: dict[str, Record] = field(default_factory=dict)
    repositories: dict[str, Record] = field(default_factory=dict)
    templates: dict[str, Record] = field(default_factory=dict)
    slices: dict[str, Record] = field(default_factory=dict)
    slice_operations: dict[str, Record] = field(default_factory=dict)
    releases: dict[str, Record] = field(default_factory=dict)
    resources: set[str] = field(default_factory=set)
    requests: list[tuple[float, str, str]] = field(default_factory=list)
    running_counts: list[int] = field(default_factory=list)
    lock: threading.RLock = field(default_factory=threading.RLock)

    def __post_init__(self) -> None:
        """Create a VIM account and a cluster on it."""
        vim, cluster = (str(uuid.uuid5(uuid.NAMESPACE_DNS, name)) for name in ("edge-site", "edge-cluster"))
        self.vims[vim] = {"_id": vim, "name": "edge-site", "vim_type": "openstack", "_admin": _site_state()}
        self.clusters[cluster] = {"_id": cluster, "name": "edge-cluster", "vim_account": vim, "_admin": _site_state()}

    def orphans(self) -> list[str]:
        """Running resources and empty package records that belong to nothing."""
        self.complete_due()
        empty = [key for group in (self.functions, self.services) for key, one in group.items() if not one["id"]]
        return [*(self.resources - set(self.instances)), *empty]

    def summary(self) -> dict[str, Any]:
        """Content without what differs between runs."""
        self.complete_due()
        instances = sorted(
            (one["name"], one["nsd-ref"], one["nsState"], key in self.resources, one["description"])
            for key, one in self.instances.items()
        )
        names = [sorted(str(one.get("id")) for one in group.values()) for group in (self.functions, self.services)]
        return {"instances": instances, "functions": names[0], "services": names[1]}

    def returned_operations(self) -> dict[str, Record]:
        """Operations as returned; at most one parameter of each is encoded as JSON, like in OSM's own code (`elif`)."""
        return {key: self._encoded(one) if self.as_json else one for key, one in self.operations.items()}

    def _encoded(self, operation: Record) -> Record:
        given = operation["operationParams"]
        name = next((name for name in JSON_STRING_PARAMS if given.get(name)), None)
        return operation if name is None else operation | {"operationParams": given | {name: json.dumps(given[name])}}

    def complete_due(self, at: float | None = None) -> None:
        """Complete the operations whose time has come at `at` (default: now)."""
        now = time.time() if at is None else at
        with self.lock:
            for one in self.operations.values():
                if one["operationState"] == "PROCESSING" and now >= one["_ends"]:
                    self._end(one)
            for one in self.slice_operations.values():
                if one["operationState"] == "PROCESSING" and now >= one["_ends"]:
                    self._end_slice(one)

    def _end(self, operation: Record) -> None:
        kind, key = operation["lcmOperationType"], operation["nsInstanceId"]
        instance = self.instances.get(key)
        outcome = self.outcome(kind, instance["name"] if instance else "")
        if outcome == "never":
            return
        operation |= {"operationState": outcome, "detailed-status": "Done" if outcome == "COMPLETED" else "no quota"}
        if kind == "instantiate":
            self.resources.add(key)  # if the instance was deleted meanwhile, this is an orphan
        elif kind == "terminate" and outcome == "COMPLETED":
            self.resources.discard(key)
        if instance is None:
            return
        if outcome == "COMPLETED":
            self._change_release(operation)
        if kind == "instantiate":
            instance["_admin"]["nsState"] = "INSTANTIATED"
            instance["nsState"] = "READY" if outcome == "COMPLETED" else "BROKEN"
        elif kind == "terminate":
            instance["_admin"]["nsState"] = "NOT_INSTANTIATED" if outcome == "COMPLETED" else "INSTANTIATED"
            instance["nsState"] = "NOT_INSTANTIATED" if outcome == "COMPLETED" else "BROKEN"

    def _end_slice(self, operation: Record) -> None:
        kind, key = operation["lcmOperationType"], operation["netsliceInstanceId"]
        outcome = self.outcome(kind, self.slices[key]["name"])
        if outcome == "never":
            return
        detail = "done" if outcome == "COMPLETED" else "no quota"
        operation |= {"operationState": outcome, "detailed-status": detail}
        if kind == "terminate" and outcome == "COMPLETED":
            del self.slices[key]
            return
        status = "running" if outcome == "COMPLETED" else "failed"
        self.slices[key] |= {"operational-status": status, "config-status": "configured", "detailed-status": detail}
        self.slices[key]["_admin"]["nsiState"] = "INSTANTIATED"

    def _change_release(self, operation: Record) -> None:
        """Values of a chart after an operation: an upgrade merges them unless it says `kdu_reset_values`."""
        key, params = operation["nsInstanceId"], operation["operationParams"]
        if operation["lcmOperationType"] == "instantiate":
            charts = [one for vnf in params.get("additionalParamsForVnf", ()) for one in vnf.get(CHARTS, ())]
            self.releases[key] = charts[0].get("additionalParams", {}) if charts else {}
            self.instances[key]["_first_values"] = self.releases[key]
        elif operation["lcmOperationType"] == "action" and params["primitive"] == "upgrade":
            given = dict(params["primitive_params"])
            reset = given.pop("kdu_reset_values", "").lower() in ("yes", "true", "1")
            first = self.instances[key].get("_first_values", {})
            self.releases[key] = given if reset else _merge(self.releases.get(key, {}), first | given)


def _merge(old: Record, new: Record) -> Record:
    """`helm upgrade --reuse-values`."""
    both = {k: _merge(old[k], v) if isinstance(v, dict) and isinstance(old.get(k), dict) else v for k, v in new.items()}
    return {k: v for k, v in (old | both).items() if v is not None}


def _site_state(state: str = "ENABLED") -> Record:
    return {"operationalState": state, "operations": [{"lcmOperationType": "create"}], "detailed-status": "Done"}


class _Interface:
    """Handlers of the interface's resources."""

    def __init__(self, state: OsmState) -> None:
        self.state = state

    def answer(self, method: str, path: str, query: Mapping[str, str], body: bytes, headers: Mapping[str, str]) -> Any:
        """Status, location and content of the response."""
        parts = [part for part in path.split("/") if part]
        if parts[:1] != ["osm"]:
            raise ErrorResponse(404, f"there is no {path}")
        if parts[1:] == ["admin", "v1", "tokens"]:
            return self._tokens(method, body)
        self._check(headers.get("Authorization", ""))
        match parts[1:]:
            case ["vnfpkgm", "v1", "vnf_packages", *rest]:
                return self._packages(self.state.functions, "package_content", method, rest, body, headers)
            case ["nsd", "v1", "ns_descriptors", *rest]:
                return self._packages(self.state.services, "nsd_content", method, rest, body, headers)
            case ["nslcm", "v1", "ns_instances", *rest]:
                return self._instances(method, rest, body)
            case ["nslcm", "v1", "ns_lcm_op_occs", *rest]:
                return self._read(self.state.returned_operations(), method, rest, query)
            case ["nst", "v1", ("netslice_templates" | "netslice_templates_content"), *rest]:
                return self._templates(method, rest, body, headers)
            case ["nsilcm", "v1", ("netslice_instances" | "netslice_instances_content"), *rest]:
                return self._slices(method, rest, query, body)
            case ["nsilcm", "v1", "nsi_lcm_op_occs", *rest]:
                return self._read(self.state.slice_operations, method, rest, query)
            case ["admin", "v1", ("vim_accounts" | "k8sclusters" | "k8srepos") as kind, *rest]:
                return self._sites(kind, method, rest, query, body)
        raise ErrorResponse(404, f"there is no {path}")

    def _created(self, key: str) -> Record:
        """Answer to a request that has created something."""
        return {"_id": key, "id": key} if self.state.as_json else {"id": key}

    def _tokens(self, method: str, body: bytes) -> Any:
        if method != "POST":
            raise ErrorResponse(405, f"{method} isn't allowed here")
        given = _json(body)
        if (given.get("username"), given.get("password")) != ("admin", "admin"):
            raise ErrorResponse(401, "Invalid username/password")
        if (project := given.get("project_id", "admin")) != "admin":
            raise ErrorResponse(404, f"database exception Not found entry with filter='{{'name': '{project}'}}'")
        token, ends = _id(), time.time() + self.state.token_lifetime_s
        self.state.tokens[token] = ends
        return 200, f"/osm/admin/v1/tokens/{token}", {"_id": token, "id": token, "expires": ends, "username": "admin"}

    def _check(self, authorization: str) -> None:
        token = authorization.removeprefix("Bearer ")
        if not authorization:
            raise ErrorResponse(401, "Needed a token or Authorization http header")
        if self.state.tokens.get(token, 0.0) < time.time():
            raise ErrorResponse(401, "Invalid Token or Authorization HTTP header")

    def _packages(
        self,
        records: dict[str, Record],
        content: str,
        method: str,
        rest: list[str],
        body: bytes,
        headers: Mapping[str, str],
    ) -> Any:
        match method, rest:
            case "GET", []:
                return 200, None, list(records.values())
            case "GET", [key]:
                return 200, None, _of(records, key)
            case "POST", []:
                given = _json(body) if body else {}
                key = _id()
                kept = {"onboardingState": "CREATED", "operationalState": "DISABLED", "usageState": "NOT_IN_USE"}
                kept["userDefinedData"] = given.get("userDefinedData", {})
                records[key] = {"_id": key, "id": "", "_admin": kept}
                return 201, f"{_path(records, self.state)}/{key}", self._created(key)
            case "PUT", [key, name] if name == content:
                self._fill(records, _of(records, key), body, headers)
                return 204, None, None
            case "DELETE", [key]:
                self._forget(records, _of(records, key))
                return 204, None, None
        raise ErrorResponse(405, f"{method} isn't allowed here")

    def _fill(self, records: dict[str, Record], record: Record, body: bytes, headers: Mapping[str, str]) -> None:
        asked = headers.get("Content-File-MD5")
        if asked and asked != hashlib.md5(body, usedforsecurity=False).hexdigest():
            raise ErrorResponse(409, "Invalid Content-File-MD5 header")
        try:
            found = parse(body, "package").descriptor
        except ScanError as error:
            raise ErrorResponse(400 if "tar.gz" in error.cause or "ZIP" in error.cause else 422, str(error)) from None
        if (found.type == "vnfd") != (records is self.state.functions):
            raise ErrorResponse(422, "the descriptor is of the other kind")
        if any(one.get("id") == found.id and one is not record for one in records.values()):
            raise ErrorResponse(409, f"{found.type} with id '{found.id}' already exists for this project")
        known = {one.get("id") for one in self.state.functions.values()}
        for name in found.functions:
            if name not in known:
                raise ErrorResponse(409, f"Descriptor error at 'vnfd-id'='{name}' references a non existing vnfd")
        if not self.state.sol006:
            raise ErrorResponse(400, f"'{found.type}' must be a list of only one element")
        expected: Record = found.body["vnfd"] if found.type == "vnfd" else found.body["nsd"]["nsd"][0]
        record |= expected | {"name": found.id}
        record["_admin"] |= {"onboardingState": "ONBOARDED", "operationalState": "ENABLED"}

    def _forget(self, records: dict[str, Record], record: Record) -> None:
        state, name = self.state, record.get("id")
        used = [one for one in state.services.values() if name and name in one.get("vnfd-id", ())]
        if records is state.functions and used:
            raise ErrorResponse(409, "There is at least one NS package using this descriptor")
        if records is state.services and any(one["nsd-id"] == record["_id"] for one in state.instances.values()):
            raise ErrorResponse(409, "There is at least one NS instance using this descriptor")
        del records[record["_id"]]

    def _instances(self, method: str, rest: list[str], body: bytes) -> Any:
        state = self.state
        state.complete_due()
        match method, rest:
            case "GET", []:
                return 200, None, list(state.instances.values())
            case "GET", [key]:
                return 200, None, _of(state.instances, key)
            case "POST", []:
                key = self._create(_json(body))
                return 201, f"/osm/nslcm/v1/ns_instances/{key}", self._created(key)
            case "DELETE", [key]:
                if _of(state.instances, key)["_admin"]["nsState"] == "INSTANTIATED":
                    raise ErrorResponse(409, "nsState is INSTANTIATED, it must be terminated first")
                del state.instances[key]
                for one in [k for k, op in state.operations.items() if op["nsInstanceId"] == key]:
                    gone = state.operations.pop(one)
                    if gone["operationState"] == "PROCESSING" and gone["lcmOperationType"] == "instantiate":
                        state.resources.add(key)  # orphan
                return 204, None, None
            case "POST", [key, kind] if kind in ("instantiate", "terminate", "scale", "action", "heal"):
                instance = _of(state.instances, key)
                operation = self._begin(instance, kind, _json(body) if body else {})
                return (
                    202,
                    f"/osm/nslcm/v1/ns_lcm_op_occs/{operation}",
                    {"id": operation} | ({"nsName": instance["name"]} if state.as_json else {}),
                )
        raise ErrorResponse(405, f"{method} isn't allowed here")

    def _create(self, given: Record) -> str:
        state = self.state
        _validate(given, "instance")
        if given["nsdId"] not in state.services:
            raise ErrorResponse(404, f"nsd {given['nsdId']} not found")
        if given["vimAccountId"] not in state.vims:
            raise ErrorResponse(404, f"Invalid vimAccountId='{given['vimAccountId']}' not present for the project")
        key = _id()
        state.instances[key] = {
            "_id": key,
            "id": key,
            "name": given["nsName"],
            "description": given.get("nsDescription") or "",
            "nsd-id": given["nsdId"],
            "nsd-ref": state.services[given["nsdId"]].get("id"),
            "nsState": "NOT_INSTANTIATED",
            "constituent-vnfr-ref": [_id()],
            "instantiate_params": {k: v for k, v in given.items() if k != "additionalParamsForVnf"},
            "currentOperation": "IDLE",
            "errorDescription": None,
            "create-time": time.time(),
            "_admin": {"nsState": "NOT_INSTANTIATED"},
        }
        return key

    def _begin(self, instance: Record, kind: str, given: Record) -> str:
        state = self.state
        instantiated = instance["_admin"]["nsState"] == "INSTANTIATED"
        running = [op for op in state.operations.values() if op["nsInstanceId"] == instance["_id"]]
        free = max((op["_ends"] for op in running if op["operationState"] == "PROCESSING"), default=0.0)
        if kind == "instantiate" and instantiated:
            raise ErrorResponse(409, f"ns_instance '{instance['_id']}' is already instantiated")
        if kind != "instantiate" and not instantiated:
            raise ErrorResponse(
                409, f"ns_instance '{instance['_id']}' cannot be '{kind}' because it is not instantiated"
            )
        if kind == "action" and not isinstance(given.get("primitive"), str):
            raise ErrorResponse(422, "Format error  ''primitive' is a required property'")
        if kind == "action" and not isinstance(given.get("primitive_params"), dict):
            raise ErrorResponse(422, "Format error  ''primitive_params' is a required property'")
        if kind == "heal":
            _validate(given, "heal")
        if kind == "scale" and not (given.get("scaleType") == "SCALE_VNF" and "scaleVnfData" in given):
            raise ErrorResponse(422, "Format error at 'scaleType'")
        key, now = _id(), time.time()
        state.operations[key] = {
            "_id": key,
            "id": key,
            "lcmOperationType": kind,
            "nsInstanceId": instance["_id"],
            "operationState": "PROCESSING",
            "operationParams": given,
            "queuePosition": None,
            "stage": None,
            "errorMessage": None,
            "detailedStatus": None,
            "startTime": now,
            "_ends": max(free, now) + state.seconds,
        }
        if kind == "instantiate":
            instance["nsState"] = "BUILDING"
        return key

    def _templates(self, method: str, rest: list[str], body: bytes, headers: Mapping[str, str]) -> Any:
        """Network slice templates; a template is uploaded whole, as YAML or a package."""
        state = self.state
        if method == "POST" and not rest:
            given = _template(body, headers.get("Content-Type", ""))
            _validate(given, "template")
            known = {one.get("id") for one in state.services.values()}
            for subnet in given["netslice-subnet"]:
                if subnet["nsd-ref"] not in known:
                    detail = f"Descriptor error at nst 'nsd-ref'='{subnet['nsd-ref']}' references a non existing nsd"
                    raise ErrorResponse(409, detail)
            if any(one["id"] == given["id"] for one in state.templates.values()):
                raise ErrorResponse(409, f"nst with id '{given['id']}' already exists for this project")
            key = _id()
            kept = {"onboardingState": "ONBOARDED", "operationalState": "ENABLED", "usageState": "NOT_IN_USE"}
            state.templates[key] = given | {"_id": key, "_admin": kept}
            return 201, f"/osm/nst/v1/netslice_templates/{key}", self._created(key)
        if method == "DELETE" and rest:
            _of(state.templates, rest[0])
            if any(one["instantiation_parameters"]["nstId"] == rest[0] for one in state.slices.values()):
                raise ErrorResponse(409, "there is at least one Netslice Instance using this descriptor")
            del state.templates[rest[0]]
            return 204, None, None
        return self._read(state.templates, method, rest, {})

    def _slices(self, method: str, rest: list[str], query: Mapping[str, str], body: bytes) -> Any:
        """Network slice instances, by the interface that creates and instantiates, terminates and removes at once."""
        state = self.state
        if method == "POST" and not rest:
            given = _json(body)
            _validate(given, "slice")
            template = _of(state.templates, given["nstId"])
            if given["vimAccountId"] not in state.vims:
                detail = f"Invalid vimAccountId='{given['vimAccountId']}' not present for the project"
                raise ErrorResponse(404, detail)
            key = _id()
            state.slices[key] = {
                "_id": key,
                "id": key,
                "name": given["nsiName"],
                "description": given.get("nsiDescription") or "",
                "datacenter": given["vimAccountId"],
                "nst-ref": template["id"],
                "instantiation_parameters": given,
                "nsr-ref-list": [],
                "_admin": {"nsiState": "NOT_INSTANTIATED"},
            }
            location = f"/osm/nsilcm/v1/netslice_instances/{key}"
            return 201, location, {"id": key, "nsilcmop_id": self._slice_operation(key, "instantiate")}
        if method == "DELETE" and rest:
            running = [one for one in state.slice_operations.values() if one["netsliceInstanceId"] == rest[0]]
            if any(one["operationState"] == "PROCESSING" for one in running):
                raise ErrorResponse(409, f"netslice_instance '{rest[0]}' has an operation in progress")
            _of(state.slices, rest[0])
            return 202, None, {"_id": self._slice_operation(rest[0], "terminate")}
        return self._read(state.slices, method, rest, query)

    def _slice_operation(self, key: str, kind: str) -> str:
        operation, now = _id(), time.time()
        self.state.slice_operations[operation] = {
            "_id": operation,
            "id": operation,
            "lcmOperationType": kind,
            "netsliceInstanceId": key,
            "operationState": "PROCESSING",
            "operationParams": {"netsliceInstanceId": key, "lcmOperationType": kind},
            "startTime": now,
            "_ends": now + self.state.seconds,
        }
        return operation

    def _sites(self, kind: str, method: str, rest: list[str], query: Mapping[str, str], body: bytes) -> Any:
        state = self.state
        records = {"vim_accounts": state.vims, "k8sclusters": state.clusters, "k8srepos": state.repositories}[kind]
        if method == "POST" and not rest:
            given = _json(body)
            _validate(given, kind)
            if any(one["name"] == given["name"] for one in records.values()):
                raise ErrorResponse(409, f"name '{given['name']}' already exists for {kind}")
            key = _id()
            wrong = "unreachable" in str(given["name"])
            records[key] = given | {"_id": key, "_admin": _site_state("ERROR" if wrong else "ENABLED")}
            if wrong:
                records[key]["_admin"]["detailed-status"] = "ERROR no route to host"
            operation = {"op_id": f"{key}:0"} if state.as_json else {}
            return 202, f"/osm/admin/v1/{kind}/{key}", self._created(key) | operation
        if method == "DELETE" and rest:
            used = {one["instantiate_params"]["vimAccountId"] for one in state.instances.values()}
            if _of(records, rest[0])["_id"] in used:
                raise ErrorResponse(409, "There is at least one VNF using this VIM account")
            del records[rest[0]]
            return 202, None, {"_id": f"{rest[0]}:1"}
        return self._read(records, method, rest, query)

    def _read(self, records: dict[str, Record], method: str, rest: list[str], query: Mapping[str, str]) -> Any:
        self.state.complete_due()
        if method != "GET":
            raise ErrorResponse(405, f"{method} isn't allowed here")
        if rest:
            return 200, None, _of(records, rest[0])
        return 200, None, [one for one in records.values() if all(str(one.get(k)) == v for k, v in query.items())]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # else each answer waits 40 ms for its header's acknowledgement
    interface: _Interface

    def _serve(self) -> None:
        state, parts = self.interface.state, urlsplit(self.path)
        length = int(self.headers.get("Content-Length") or 0)
        body = self.rfile.read(min(length, MAX_BYTES))
        with state.lock:
            state.complete_due()
            state.requests.append((time.monotonic(), self.command, parts.path))
            state.running_counts.append(sum(op["operationState"] == "PROCESSING" for op in state.operations.values()))
            fault = state.faults(self.command, parts.path)
            if fault == CUT_BEFORE:
                return self._cut()
            if isinstance(fault, int):
                return self._send(fault, None, _problem(fault, "as asked for"))
            query = dict(parse_qsl(parts.query))
            try:
                found = self.interface.answer(self.command, parts.path, query, body, dict(self.headers.items()))
            except ErrorResponse as refusal:
                found = refusal.status, None, _problem(refusal.status, refusal.detail)
            given = state.answer(self.command, parts.path, found[2])
            content = given if isinstance(given, bytes) else b"" if found[2] is None else json.dumps(given).encode()
        if isinstance(given, Raw):
            self.wfile.write(given)
            return self._cut()
        if fault == CUT_AFTER:
            return self._cut()
        self._send_bytes(found[0], found[1], content)
        return None

    def __getattr__(self, name: str) -> Any:
        """`do_GET` and its like, for every method."""
        if name.startswith("do_"):
            return self._serve
        raise AttributeError(name)

    def _send(self, status: int, location: str | None, content: Any) -> None:
        self._send_bytes(status, location, json.dumps(content).encode())

    def _send_bytes(self, status: int, location: str | None, content: bytes) -> None:
        self.send_response(status)
        if location:
            self.send_header("Location", location)
        if status != 204:
            self.send_header("Content-Type", "application/json; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if status != 204 and self.command != "HEAD":
            self.wfile.write(content)

    def _cut(self) -> None:
        self.close_connection = True
        self.connection.close()

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""


class FakeOsm:
    """A fake OSM that listens on this machine; `with FakeOsm() as fake: fake.address`."""

    def __init__(self, state: OsmState | None = None, *, port: int = 0, tls: ssl.SSLContext | None = None) -> None:
        self.state = state or OsmState()
        handler = type("Handler", (_Handler,), {"interface": _Interface(self.state)})
        self._server = ThreadingHTTPServer(("127.0.0.1", port), handler)
        self._server.daemon_threads = True
        if tls:
            self._server.socket = tls.wrap_socket(self._server.socket, server_side=True)
        self.address = f"http{'s' if tls else ''}://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)

    def __enter__(self) -> FakeOsm:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()


def _json(body: bytes) -> Record:
    try:
        given = json.loads(body)
    except ValueError:
        raise ErrorResponse(400, "error loading the body as JSON") from None
    if not isinstance(given, dict):
        raise ErrorResponse(422, "Format error: an object is wanted")
    return given


def _template(body: bytes, media_type: str) -> Record:
    """The one template in a YAML file, or in a package."""
    if "gzip" in media_type:
        with tarfile.open(fileobj=io.BytesIO(body)) as package:
            files = [one for one in package.getmembers() if one.name.endswith((".yaml", ".yml"))]
            body = (package.extractfile(files[0]) or io.BytesIO()).read() if files else b""
    try:
        (template,) = yaml.safe_load(body)["nst"]
    except (yaml.YAMLError, ValueError, TypeError, KeyError):
        raise ErrorResponse(422, "Error in pyangbind: 'nst' must be a list of only one element") from None
    if not isinstance(template, dict):
        raise ErrorResponse(422, "Format error: an object is wanted")
    return template


def _validate(given: Record, kind: str) -> None:
    """Refuse a body that violates its schema, with OSM's words."""
    error = next(Draft202012Validator(SCHEMAS[kind]).iter_errors(given), None)
    if error is not None:
        where = f" at '{'.'.join(map(str, error.absolute_path))}'" if error.absolute_path else " "
        raise ErrorResponse(422, f"Format error{where} '{error.message}'")


def _problem(status: int, detail: str) -> Record:
    return {"code": f"STATUS_{status}", "status": status, "detail": detail}


def _of(records: Mapping[str, Record], key: str) -> Record:
    if key not in records:
        raise ErrorResponse(404, f"there is nothing with id '{key}'")
    return records[key]


def _path(records: object, state: OsmState) -> str:
    return "/osm/vnfpkgm/v1/vnf_packages" if records is state.functions else "/osm/nsd/v1/ns_descriptors"


def _id() -> str:
    return str(uuid.uuid4())


def main() -> None:
    """Serve until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=9999)
    parser.add_argument("--seconds", type=float, default=2.0, help="duration of an operation")
    arguments = parser.parse_args()
    with FakeOsm(OsmState(seconds=arguments.seconds), port=arguments.port) as fake:
        print(f"fake OSM at {fake.address}; sites: edge-site, edge-cluster", flush=True)
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            pass


if __name__ == "__main__":
    main()
