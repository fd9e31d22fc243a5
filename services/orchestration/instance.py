"""Instance of a network service, desired and as reported by OSM, and the next action to reconcile them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeVar

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from scan2sim.pipeline.core.errors import StepError
from scan2sim.services.orchestration.chart import REPLICA_COUNT_KEY
from scan2sim.services.orchestration.records import InstanceRecord, OperationRecord
from scan2sim.services.orchestration.sol006 import MEMBER_INDEX, SCALING_ASPECT, FunctionKind

OWNER_TAG = "scan2sim"
"""First word of the description of everything created by this package; deployment and digest follow."""
RUNNING = ("PROCESSING", "ROLLING_BACK", "STARTING", "FAILED_TEMP")
"""States of a running operation."""
DONE = ("COMPLETED", "PARTIALLY_COMPLETED")
"""States of a successful operation."""
RESET_VALUES_KEY = "kdu_reset_values"
"""Option of an upgrade: replace all values. Without it OSM merges the new values into those of the release
(`helm upgrade --reuse-values`), so that a value that was removed would stay."""
UPGRADE_OPTIONS = (
    RESET_VALUES_KEY,
    "kdu_reuse_values",
    "kdu_reset_then_reuse_values",
    "kdu_model",
    "kdu_atomic_upgrade",
)
"""Parameters of an upgrade that OSM's lifecycle manager takes for itself; all others are values of the chart."""


class Action(StrEnum):
    """Next action on an instance."""

    CREATE = "create"
    INSTANTIATE = "instantiate"
    WAIT = "wait"
    UPGRADE = "upgrade"
    SCALE_OUT = "scale out"
    SCALE_IN = "scale in"
    TERMINATE = "terminate"
    DELETE = "delete"


@dataclass(frozen=True)
class DesiredInstance:
    """Desired state of an instance.

    Attributes:
        name: unique name of the instance.
        deployment: name of the deployment that it belongs to.
        service: name of the function's chart or machine.
        kind: whether the function is a container or a machine.
        nsd: id of the network service's descriptor.
        vim: id of the VIM account.
        replicas: number of replicas of the function.
        keys: public SSH keys that may log in to machines.
        values: Helm values of the chart, or parameters of the machine at instantiation.
        namespace: Kubernetes namespace; empty: the project's.
    """

    name: str
    deployment: str
    service: str
    kind: FunctionKind
    nsd: str
    vim: str
    replicas: int = 1
    keys: tuple[str, ...] = ()
    values: Mapping[str, Any] | None = None
    namespace: str = ""

    @property
    def tag(self) -> str:
        """Description in OSM: owner, deployment and a digest of all that can't be changed while the instance runs."""
        fixed: list[Any] = [self.service, self.kind, self.nsd, self.vim, self.keys, self.namespace]
        if self.kind == "machine":
            fixed.append(self.function_values)
        digest = hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:12]
        return f"{OWNER_TAG} {self.deployment} {digest}"

    @property
    def function_values(self) -> dict[str, Any]:
        """All values passed to the function."""
        values = dict(self.values or {})
        return values | ({REPLICA_COUNT_KEY: self.replicas} if self.kind == "container" else {})

    def request(self, nsd_record: str) -> dict[str, Any]:
        """Body of the requests that create and instantiate it; `nsd_record`: id of its descriptor's record in OSM."""
        function: dict[str, Any] = {"member-vnf-index": MEMBER_INDEX}
        if self.namespace:
            function["k8s-namespace"] = self.namespace
        if self.kind == "container":
            function["additionalParamsForKdu"] = [{"kdu_name": self.service, "additionalParams": self.function_values}]
        elif self.function_values:
            function["additionalParams"] = self.function_values
        body: dict[str, Any] = {
            "nsName": self.name,
            "nsdId": nsd_record,
            "vimAccountId": self.vim,
            "nsDescription": self.tag,
        }
        if len(function) > 1:
            body["additionalParamsForVnf"] = [function]
        if self.keys:
            body["ssh_keys"] = list(self.keys)
        return body

    def change_request(self, action: Action) -> tuple[str, dict[str, Any]]:
        """Path and body of the request that upgrades or scales it."""
        if action == Action.UPGRADE:
            return "action", upgrade_request(self.service, self.function_values)
        return "scale", scale_request(1 if action == Action.SCALE_OUT else -1)


def upgrade_request(function: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Body of the request that replaces a chart's values."""
    return {
        "member_vnf_index": MEMBER_INDEX,
        "kdu_name": function,
        "primitive": "upgrade",
        "primitive_params": dict(values) | {RESET_VALUES_KEY: "true"},  # OSM expects a string here
    }


def scale_request(by: int) -> dict[str, Any]:
    """Body of the request that adds a machine (`by` > 0) or removes one."""
    step = {"scaling-group-descriptor": SCALING_ASPECT, "member-vnf-index": MEMBER_INDEX}
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
    """State of an instance as reported by OSM.

    Attributes:
        id, name: id and name of its record.
        nsd: id of its descriptor.
        tag: its description, see `DesiredInstance.tag`.
        state: state such as "READY" or "BROKEN".
        instantiated: whether there is something to terminate.
        operations: its operations in the order of their start.
    """

    id: str
    name: str
    nsd: str
    tag: str
    state: str
    instantiated: bool
    operations: tuple[OperationRecord, ...]

    @classmethod
    def of(cls, record: InstanceRecord, operations: Sequence[OperationRecord]) -> Instance:
        """Instance from OSM's record."""
        return cls(
            id=record.record,
            name=record.name,
            nsd=record.descriptor,
            tag=record.description,
            state=record.state,
            instantiated=record.admin.state == "INSTANTIATED",
            operations=tuple(operations),
        )

    @property
    def running_operation(self) -> OperationRecord | None:
        """The operation in progress; None if there is none."""
        return next((one for one in reversed(self.operations) if one.state in RUNNING), None)

    @property
    def condition(self) -> tuple[object, ...]:
        """What a successful action changes, except the values of a chart."""
        running = self.running_operation
        return self.id, self.state, self.instantiated, running and running.record, self.machine_count

    def belongs_to(self, deployment: str) -> bool:
        """Whether a deployment created it."""
        return self.tag.split(" ")[:2] == [OWNER_TAG, deployment]

    @property
    def _completed(self) -> list[OperationRecord]:
        """Successful operations since it was last instantiated."""
        done = [one for one in self.operations if one.state in DONE]
        starts = [i for i, one in enumerate(done) if one.kind == "instantiate"]
        return done[starts[-1] :] if starts else done

    @property
    def values(self) -> dict[str, Any]:
        """Values of its chart that run: those at instantiation, changed by each upgrade as OSM does.

        Raises:
            StepError: the parameters that OSM returns can't be read.
        """
        first: dict[str, Any] = {}
        running: dict[str, Any] = {}
        for one in self._completed:
            if one.params is None:
                continue
            if one.kind == "instantiate":
                functions = self._parameter(one.params.functions, "additionalParamsForVnf", _FUNCTIONS)
                charts = functions[0].charts if functions else None
                first = running = (charts[0].values if charts else None) or {}
            elif one.kind == "action" and one.params.primitive == "upgrade":
                given = self._parameter(one.params.primitive_params, "primitive_params", _VALUES) or {}
                values = {name: value for name, value in given.items() if name not in UPGRADE_OPTIONS}
                reset = str(given.get(RESET_VALUES_KEY, "")).lower() in ("yes", "true", "1")
                running = values if reset else _merged(running, first | values)
        return running

    def _parameter(self, value: Any, name: str, kind: TypeAdapter[T]) -> T | None:
        """A parameter of an operation; newer releases return a JSON string, Release 8 the object that was sent."""
        if not value:
            return None
        try:
            return kind.validate_json(value) if isinstance(value, str) else kind.validate_python(value)
        except ValidationError as error:
            cause = f"OSM returned an operation whose {name} can't be read ({error.errors()[0]['msg']})"
            remedy = "Remove it (scan2sim orchestrate delete) and instantiate it again"
            raise StepError(self.name, cause, remedy) from None

    @property
    def machine_count(self) -> int:
        """Number of machines of its function."""
        count = 1
        for one in self._completed:
            if one.kind == "scale" and one.params and one.params.scaling:
                count += 1 if one.params.scaling.direction == "SCALE_OUT" else -1
        return count


def _merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Values after `helm upgrade --reuse-values`: objects are merged, null removes."""
    result = dict(old)
    for name, value in new.items():
        if value is None:
            result.pop(name, None)
        elif isinstance(value, Mapping):
            before = result.get(name)
            result[name] = _merged(before if isinstance(before, Mapping) else {}, value)
        else:
            result[name] = value
    return result


def next_action(desired: DesiredInstance | None, observed: Instance | None) -> Action | None:
    """Next action to bring an instance to its desired state; None if there is nothing to do.

    Args:
        desired: None if the instance is to be removed.
        observed: None if it doesn't exist.

    Raises:
        StepError: see `Instance.values`.
    """
    if observed is None:
        return Action.CREATE if desired else None
    if observed.running_operation:
        return Action.WAIT  # if it were deleted now, OSM would forget the operation and leave its resources behind
    if desired is None or observed.tag != desired.tag or (observed.instantiated and observed.state == "BROKEN"):
        return Action.TERMINATE if observed.instantiated else Action.DELETE
    if not observed.instantiated:
        return Action.INSTANTIATE
    if desired.kind == "container":
        return Action.UPGRADE if observed.values != desired.function_values else None
    if observed.machine_count != desired.replicas:
        return Action.SCALE_OUT if observed.machine_count < desired.replicas else Action.SCALE_IN
    return None
