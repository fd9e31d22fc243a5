"""A network service's instance, as wanted and as OSM tells of it, and what to do next about it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeVar

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from scan2sim.pipeline.core.errors import StepError
from scan2sim.services.orchestration.chart import REPLICAS
from scan2sim.services.orchestration.sol006 import ASPECT, MEMBER, Kind

MARK = "scan2sim"
"""How a description of what was made here begins; deployment and digest follow."""
RUNNING = ("PROCESSING", "ROLLING_BACK", "STARTING", "FAILED_TEMP")
DONE = ("COMPLETED", "PARTIALLY_COMPLETED")
"""States of operations."""


class Action(StrEnum):
    """What to do next about an instance."""

    CREATE = "create"
    INSTANTIATE = "instantiate"
    FOLLOW = "follow"
    UPGRADE = "upgrade"
    SCALE_OUT = "scale out"
    SCALE_IN = "scale in"
    TERMINATE = "terminate"
    DELETE = "delete"


@dataclass(frozen=True)
class Wanted:
    """An instance as it is to be.

    Attributes:
        name: of the instance, which no other has.
        deployment: that it is of.
        service: of what kind of function it is; kind: what that runs as.
        nsd: its network service's descriptor, by id.
        vim: VIM account, by id.
        replicas: how many of its function.
        keys: public SSH keys of who may log in to machines.
        values: what is given to its chart, or to its machine when it starts.
        namespace: of Kubernetes; "": the project's.
    """

    name: str
    deployment: str
    service: str
    kind: Kind
    nsd: str
    vim: str
    replicas: int = 1
    keys: tuple[str, ...] = ()
    values: Mapping[str, Any] | None = None
    namespace: str = ""

    @property
    def mark(self) -> str:
        """Its description in OSM: whose it is, and a digest of what can't be changed while it runs."""
        fixed: list[Any] = [self.service, self.kind, self.nsd, self.vim, self.keys, self.namespace]
        if self.kind == "machine":
            fixed.append(self.given)
        digest = hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:12]
        return f"{MARK} {self.deployment} {digest}"

    @property
    def given(self) -> dict[str, Any]:
        """All values that its function is given."""
        values = dict(self.values or {})
        return values | ({REPLICAS: self.replicas} if self.kind == "container" else {})

    def request(self, nsd_record: str) -> dict[str, Any]:
        """What it is created and instantiated by; `nsd_record` is the descriptor's record in OSM."""
        function: dict[str, Any] = {"member-vnf-index": MEMBER}
        if self.namespace:
            function["k8s-namespace"] = self.namespace
        if self.kind == "container":
            function["additionalParamsForKdu"] = [{"kdu_name": self.service, "additionalParams": self.given}]
        elif self.given:
            function["additionalParams"] = self.given
        body: dict[str, Any] = {
            "nsName": self.name,
            "nsdId": nsd_record,
            "vimAccountId": self.vim,
            "nsDescription": self.mark,
        }
        if len(function) > 1:
            body["additionalParamsForVnf"] = [function]
        if self.keys:
            body["ssh_keys"] = list(self.keys)
        return body

    def change(self, action: Action) -> tuple[str, dict[str, Any]]:
        """Path and body of the request that makes it as wanted."""
        if action == Action.UPGRADE:
            return "action", upgrade(self.service, self.given)
        return "scale", scale(1 if action == Action.SCALE_OUT else -1)


def upgrade(function: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Body of the request that gives a chart other values."""
    return {
        "member_vnf_index": MEMBER,
        "kdu_name": function,
        "primitive": "upgrade",
        "primitive_params": dict(values),
    }


def scale(by: int) -> dict[str, Any]:
    """Body of the request for a machine more, or one fewer."""
    step = {"scaling-group-descriptor": ASPECT, "member-vnf-index": MEMBER}
    kind = "SCALE_OUT" if by > 0 else "SCALE_IN"
    return {"scaleType": "SCALE_VNF", "scaleVnfData": {"scaleVnfType": kind, "scaleByStepData": step}}


class _Chart(BaseModel):
    """An item of a function's `additionalParamsForKdu`."""

    values: dict[str, Any] | None = Field(None, alias="additionalParams")


class _Function(BaseModel):
    """An item of `additionalParamsForVnf`."""

    charts: list[_Chart] | None = Field(None, alias="additionalParamsForKdu")


T = TypeVar("T")
_VALUES, _FUNCTIONS = TypeAdapter(dict[str, Any]), TypeAdapter(list[_Function])


@dataclass(frozen=True)
class Instance:
    """As OSM tells of it.

    Attributes:
        id: of its record; name: that it was given.
        nsd: its descriptor's id.
        mark: its description.
        state: "READY", "BROKEN", ... as OSM says.
        instantiated: whether there is something to terminate.
        operations: in the order in which they began.
    """

    id: str
    name: str
    nsd: str
    mark: str
    state: str
    instantiated: bool
    operations: tuple[Mapping[str, Any], ...]

    @classmethod
    def of(cls, record: Mapping[str, Any], operations: Sequence[Mapping[str, Any]]) -> Instance:
        """Of OSM's record."""
        return cls(
            id=str(record["_id"]),
            name=str(record.get("name", "")),
            nsd=str(record.get("nsd-ref") or (record.get("nsd") or {}).get("id", "")),
            mark=str(record.get("description") or ""),
            state=str(record.get("nsState", "")),
            instantiated=(record.get("_admin") or {}).get("nsState") == "INSTANTIATED",
            operations=tuple(operations),
        )

    @property
    def running(self) -> Mapping[str, Any] | None:
        """The operation that isn't over; None: all are."""
        return next((one for one in reversed(self.operations) if one.get("operationState") in RUNNING), None)

    def is_of(self, deployment: str) -> bool:
        """Whether a deployment made it."""
        return self.mark.split(" ")[:2] == [MARK, deployment]

    @property
    def values(self) -> dict[str, Any]:
        """Values that its chart was last given.

        Raises:
            StepError: OSM returns parameters of that operation that can't be read.
        """
        for one in reversed(self.operations):
            if one.get("operationState") not in DONE:
                continue
            params = one.get("operationParams") or {}
            if one.get("lcmOperationType") == "action" and params.get("primitive") == "upgrade":
                return self._read(params, "primitive_params", _VALUES) or {}
            if one.get("lcmOperationType") == "instantiate":
                functions = self._read(params, "additionalParamsForVnf", _FUNCTIONS)
                charts = functions[0].charts if functions else None
                return (charts[0].values if charts else None) or {}
        return {}

    def _read(self, params: Mapping[str, Any], name: str, kind: TypeAdapter[T]) -> T | None:
        """A parameter of an operation; current releases return a string of JSON, Release 8 the object that was sent."""
        value = params.get(name)
        if not value:
            return None
        try:
            return kind.validate_json(value) if isinstance(value, str) else kind.validate_python(value)
        except ValidationError as error:
            cause = f"OSM returns an operation whose {name} can't be read ({error.errors()[0]['msg']})"
            remedy = "Remove it (scan2sim orchestrate delete) and instantiate it again"
            raise StepError(self.name, cause, remedy) from None

    @property
    def machines(self) -> int:
        """How many there are of its function, where that is a machine."""
        count = 1
        for one in self.operations:
            data = (one.get("operationParams") or {}).get("scaleVnfData") or {}
            if one.get("lcmOperationType") == "scale" and one.get("operationState") in DONE:
                count += 1 if data.get("scaleVnfType") == "SCALE_OUT" else -1
        return count


def next_action(wanted: Wanted | None, there: Instance | None) -> Action | None:
    """What to do about an instance, so that it is as wanted; None: it is.

    Args:
        wanted: None: it isn't to be.
        there: None: it isn't.

    Raises:
        StepError: as `Instance.values`.
    """
    if there is None:
        return Action.CREATE if wanted else None
    if there.running:
        return Action.FOLLOW  # deleting it now would forget the operation, and leave what it makes behind
    if wanted is None or there.mark != wanted.mark or (there.instantiated and there.state == "BROKEN"):
        return Action.TERMINATE if there.instantiated else Action.DELETE
    if not there.instantiated:
        return Action.INSTANTIATE
    if wanted.kind == "container":
        return Action.UPGRADE if there.values != wanted.given else None
    if there.machines != wanted.replicas:
        return Action.SCALE_OUT if there.machines < wanted.replicas else Action.SCALE_IN
    return None
