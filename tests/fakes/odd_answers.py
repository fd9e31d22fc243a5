"""Answers of a server that is not OSM, is broken, or is hostile: each must end in a message for the user.

`KINDS` are values of `OsmState.answer`: they replace the body of the answers to some requests, or, as `Raw`, the whole
response.
"""

from __future__ import annotations

import copy
import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scan2sim.services.orchestration import apply, deployment, operations
from scan2sim.services.orchestration.lifecycle import WaitPolicy
from scan2sim.services.orchestration.osm import SITE_KINDS, Osm
from scan2sim.services.orchestration.settings import ApplyParams
from tests.fakes.osm import OsmState, Raw

Answer = Callable[[str, str, Any], Any]

TOKENS, PACKAGES, NSDS, INSTANCES, OPERATIONS, CLUSTERS = (
    "tokens",
    "vnf_packages",
    "ns_descriptors",
    "ns_instances",
    "ns_lcm_op_occs",
    "k8sclusters",
)
DEEP = b"[" * 100_000 + b"]" * 100_000


def _replace(method: str, part: str, body: Any) -> Answer:
    """Another body for the answers to a method on paths that contain `part`."""
    return lambda m, path, content: body if m == method and part in path else content


def _change(part: str, **fields: Any) -> Answer:
    """Other fields (None: null, `...`: missing) in the records that are read from paths that contain `part`."""

    def one(record: Any) -> Any:
        changed = dict(record) | {name.replace("__", "-"): value for name, value in fields.items()}
        return {name: value for name, value in changed.items() if value is not ...}

    def answer(method: str, path: str, content: Any) -> Any:
        if method not in ("GET", "POST") or part not in path or not content or "code" in content:
            return content
        return [one(each) for each in content] if isinstance(content, list) else one(content)

    return answer


def _raw(status: str, body: bytes = b"", *headers: str) -> Answer:
    """A whole response to every request after the login."""
    lines = [f"HTTP/1.1 {status}", *headers, f"Content-Length: {len(body)}", "Connection: close", "", ""]
    data = Raw("\r\n".join(lines).encode("latin-1") + body)
    return lambda method, path, content: content if TOKENS in path else data


def _bytes(data: bytes) -> Answer:
    return lambda method, path, content: content if TOKENS in path else Raw(data)


BODIES: dict[str, Any] = {
    "null": None,
    "an empty object": {},
    "a number": 3,
    "a text": "OSM",
    "[3, null]": [3, None],
    "a list in a list": [[{}]],
    "a page in HTML": b"<html><body>Login</body></html>",
    "half of an answer": b'[{"_id": "1", "na',
    "nested 100,000 deep": DEEP,
    "NaN": b"[NaN]",
    "bytes that aren't UTF-8": b'{"id": "\xff\xfe"}',
    "a lone surrogate": b'[{"_id": "1", "name": "\\ud800"}]',
    "a number of 10,000 digits": b"[" + b"9" * 10_000 + b"]",
}

KINDS: dict[str, Answer] = {}
for _part in (TOKENS, INSTANCES):
    for _name, _body in BODIES.items():
        KINDS[f"{_part}: {_name}"] = _replace("POST" if _part == TOKENS else "GET", _part, _body)
for _part in (PACKAGES, NSDS, OPERATIONS, CLUSTERS):
    KINDS[f"{_part}: [3, null]"] = _replace("GET", _part, [3, None])
    KINDS[f"{_part}: an object, not a list"] = _replace("GET", _part, {"items": []})
    KINDS[f"{_part}: a record without _id"] = _replace("GET", _part, [{"id": "x", "name": "edge-cluster"}])
KINDS |= {
    "a token without id": _change(TOKENS, id=...),
    "a token whose id has a line break": _change(TOKENS, id="a\r\nX-Other: 1"),
    "a token that expires at an ISO time": _change(TOKENS, expires="2026-11-26T00:00:00Z"),
    "a token that expires at a list": _change(TOKENS, expires=[1]),
    "a token whose id is a number": _change(TOKENS, id=17),
    "an instance whose _id leaves the path": _change(INSTANCES, _id="../../admin/v1/users"),
    "an instance whose _id is null": _change(INSTANCES, _id=None),
    "an instance whose name is an object": _change(INSTANCES, name={"a": 1}),
    "an instance whose name clears the terminal": _change(INSTANCES, name="\x1b[2J\x1b]0;x\x07"),
    "an instance whose state is a list": _change(INSTANCES, nsState=["READY"]),
    "an instance whose _admin is a text": _change(INSTANCES, _admin="INSTANTIATED"),
    "an instance whose nsd is a text": _change(INSTANCES, nsd="x", nsd__ref=None),
    "an instance that was created at a text": _change(INSTANCES, create__time="today"),
    "an instance without a description": _change(INSTANCES, description=None),
    "an instance whose functions are numbers": _change(INSTANCES, constituent__vnfr__ref=[1, 2]),
    "a created instance without id": _replace("POST", INSTANCES, {"nsName": "x"}),
    "a created instance whose id is a list": _replace("POST", INSTANCES, {"id": ["1"]}),
    "a created instance that never appears": _replace("GET", "/ns_instances", []),
    "an operation that started at a text": _change(OPERATIONS, startTime="now"),
    "an operation whose state is unknown": _change(OPERATIONS, operationState="MAYBE"),
    "an operation whose state is null": _change(OPERATIONS, operationState=None),
    "an operation whose parameters are a text": _change(OPERATIONS, operationParams="{}"),
    "an operation whose parameters are a list": _change(OPERATIONS, operationParams=[1]),
    "an operation without parameters": _change(OPERATIONS, operationParams=None),
    "an operation whose values aren't JSON": _change(
        OPERATIONS, operationParams={"additionalParamsForVnf": "{", "primitive": "upgrade", "primitive_params": "{"}
    ),
    "an operation whose values are nested 1,000 deep": _change(
        OPERATIONS, operationParams={"additionalParamsForVnf": "[" * 1000 + "]" * 1000}
    ),
    "an operation whose scaling is a list": _change(OPERATIONS, operationParams={"scaleVnfData": [1]}),
    "an operation of another instance": _change(OPERATIONS, nsInstanceId="another"),
    "a package whose functions are an object": _change(NSDS, vnfd__id={"a": 1}),
    "a package whose charts are texts": _change(PACKAGES, kdu=["detect"]),
    "a package whose tags are a list": _change(PACKAGES, _admin={"userDefinedData": ["x"]}),
    "a cluster whose VIM account is a number": _change(CLUSTERS, vim_account=3),
    "two clusters of one name": _replace("GET", CLUSTERS, [{"_id": str(i), "name": "edge-cluster"} for i in (1, 2)]),
    "a redirect to another server": _raw("301 Moved Permanently", b"", "Location: https://user:pw@elsewhere.example/"),
    "a redirect to nowhere": _raw("302 Found"),
    "a redirect to an impossible address": _raw("301 Moved Permanently", b"", "Location: https://[::1:99999999/"),
    "a redirect to itself": _raw("307 Temporary Redirect", b"", "Location: /osm/nslcm/v1/ns_instances"),
    "status 418": _raw("418 I'm a teapot", b"{}"),
    "status 599": _raw("599 Odd", b"[1]"),
    "status 500 whose detail is an object": _raw("500 Error", b'{"detail": {"a": ["\\u001b[2J"]}}'),
    "status 200 without a body": _raw("200 OK"),
    "a bomb of zeros, compressed": _raw("200 OK", gzip.compress(bytes(80 * 2**20)), "Content-Encoding: gzip"),
    "gzip that isn't": _raw("200 OK", b"rubbish", "Content-Encoding: gzip"),
    "an unknown compression": _raw("200 OK", b"[]x", "Content-Encoding: x-odd"),
    "an unknown charset": _raw("200 OK", '["ä"]'.encode("latin-1"), "Content-Type: application/json; charset=odd"),
    "a header of 200 kB": _raw("200 OK", b"[]", "X-Large: " + "x" * 200_000),
    "a cookie that is broken": _raw("200 OK", b"3", "Set-Cookie: =;;; path=\x7f"),
    "no HTTP at all": _bytes(b"SSH-2.0-OpenSSH_9.2\r\n"),
    "a response that ends in its header": _bytes(b"HTTP/1.1 200 OK\r\nContent-Le"),
    "a response that ends in its body": _bytes(b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n[{"),
    "chunks that are broken": _bytes(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nZZ\r\n[]\r\n"),
    "a negative length": _bytes(b"HTTP/1.1 200 OK\r\nContent-Length: -5\r\n\r\n[]"),
    "nothing": _bytes(b""),
}
"""Answers by the kind of their fault."""

HARMLESS = ("an instance whose name clears the terminal", "an instance without a description")
"""Kinds that may also end well: what is wrong is not needed, or is made harmless."""

QUIET: Callable[..., None] = lambda *_: None  # noqa: E731


def calls(osm: Osm, services: Path, container: str, machine: str) -> dict[str, Callable[[], object]]:
    """Operations to try on a server, by their names.

    Args:
        services: a services.toml; container, machine: names of instances of both kinds in it.
    """
    policy = WaitPolicy(5)
    params = ApplyParams(wait=True, timeout=5)

    def state() -> apply.DeploymentState:
        return apply.load_state(osm, deployment.read(services), services.parent)

    def run() -> None:
        if (error := apply.failure(apply.apply(osm, state(), params, QUIET))) is not None:
            raise error

    return {
        "plan": lambda: apply.plan(state()),
        "apply": run,
        "scale": lambda: operations.scale(osm, container, 3, policy, QUIET),
        "heal": lambda: operations.heal(osm, machine, policy, QUIET),
        "sites": lambda: [osm.sites(one) for one in SITE_KINDS],
        "delete": lambda: operations.delete_instance(osm, container, policy, QUIET),
    }


def stored(state: OsmState) -> dict[str, Any]:
    """A copy of what a fake stores, to prepare others in the same way: `vars(other).update(...)`."""
    names = ("functions", "services", "instances", "operations", "resources", "releases")
    return {name: copy.deepcopy(getattr(state, name)) for name in names}
