"""Records that OSM returns, validated before use: unknown fields are ignored, a missing or odd one is rejected.

Field names and optional fields are those that OSM's northbound interface returns (Release 8 and current), recorded from
its own server; `tests/fakes/osm.py` returns the same.
"""

from __future__ import annotations

from collections.abc import Hashable
from functools import cache
from typing import Annotated, Any, TypeVar, cast

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

from scan2sim.pipeline.core.errors import printable

MAX_TEXT = 10_000
"""Longest text of a field that is shown or compared."""

Key = Annotated[str, Field(pattern=r"^[\w.:-]{1,200}$")]
"""Id of a record, which becomes part of URLs."""
Text = Annotated[str, Field(max_length=MAX_TEXT), AfterValidator(printable), BeforeValidator(lambda v: v or "")]
"""Text without control characters, which would reach the terminal; null is empty."""
Seconds = Annotated[float, Field(allow_inf_nan=False), BeforeValidator(lambda v: v or 0.0)]
"""Seconds since the epoch; null is 0."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, populate_by_name=True)


class Created(_Record):
    """Response to a request that creates something."""

    id: Key


class Token(_Record):
    """Session of a user; `expires` is 0 if OSM doesn't say."""

    id: Key
    expires: Seconds = 0.0


class _Admin(_Record):
    state: Text = Field("", alias="nsState")
    onboarding_state: Text = Field("", alias="onboardingState")
    operational_state: Text = Field("", alias="operationalState")
    tags: dict[str, Any] | None = Field(None, alias="userDefinedData")
    detail: Text = Field("", alias="detailed-status")
    slice_state: Text = Field("", alias="nsiState")


class _Unit(_Record):
    name: Text = ""
    id: Text = ""


class _Administered(_Record):
    record: Key = Field(alias="_id")
    admin: _Admin = Field(default_factory=lambda: _Admin(), alias="_admin")


class PackageRecord(_Administered):
    """Record of a function's or a network service's package.

    Attributes:
        record: id of the record.
        id: id of its descriptor; empty until the package has been uploaded.
        functions: ids of a network service's functions.
        charts, machines: a function's Helm charts (`kdu`) and machines (`vdu`).
    """

    id: Text = ""
    functions: tuple[Text, ...] | None = Field(None, alias="vnfd-id", strict=False)
    charts: tuple[_Unit, ...] | None = Field(None, alias="kdu", strict=False)
    machines: tuple[_Unit, ...] | None = Field(None, alias="vdu", strict=False)

    @property
    def tags(self) -> dict[str, Any]:
        """User-defined data that were stored with the record."""
        return self.admin.tags or {}

    @property
    def name(self) -> str:
        """Name to show: the descriptor's id, or the record's while there is no descriptor."""
        return self.id or self.record


class _Descriptor(_Record):
    id: Text = ""


class InstanceRecord(_Administered):
    """Record of a network service instance.

    Attributes:
        nsd_ref: id of its descriptor.
        functions: ids of its functions' records (VNF instances).
        state: state such as "READY" or "BROKEN".
        created: time of its creation.
    """

    name: Text = ""
    description: Text = ""
    nsd_ref: Text = Field("", alias="nsd-ref")
    nsd: _Descriptor | None = None
    state: Text = Field("", alias="nsState")
    created: Seconds = Field(0.0, alias="create-time")
    functions: tuple[Key, ...] | None = Field(None, alias="constituent-vnfr-ref", strict=False)

    @property
    def descriptor(self) -> str:
        """Id of its network service's descriptor."""
        return self.nsd_ref or (self.nsd.id if self.nsd else "")


class _Scaling(_Record):
    direction: Text = Field("", alias="scaleVnfType")


class _Params(_Record):
    """Parameters of an operation; values of charts are read later, as they are JSON strings or objects."""

    primitive: Text = ""
    primitive_params: Any = None
    functions: Any = Field(None, alias="additionalParamsForVnf")
    scaling: _Scaling | None = Field(None, alias="scaleVnfData")


class OperationRecord(_Record):
    """Record of an operation on an instance.

    Attributes:
        kind: "instantiate", "terminate", "scale", "heal", "action", ...
        state: "PROCESSING", "COMPLETED", "FAILED", ...
        started: time of its start.
    """

    record: Key = Field(alias="_id")
    instance: Text = Field("", alias="nsInstanceId")
    kind: Text = Field("", alias="lcmOperationType")
    state: Text = Field("", alias="operationState")
    started: Seconds = Field(0.0, alias="startTime")
    error: Text = Field("", alias="errorMessage")
    status: Text = Field("", alias="detailed-status")
    params: _Params | None = Field(None, alias="operationParams")


class SiteRecord(_Administered):
    """Record of a VIM account, a Kubernetes cluster or a repository.

    Attributes:
        vim: id of a cluster's VIM account.
        kind: type of a VIM account or a repository.
    """

    name: Text = ""
    vim: Text = Field("", alias="vim_account")
    vim_type: Text = ""
    type: Text = ""
    url: Text = ""
    vim_url: Text = ""


class _Subnet(_Record):
    service: Text = Field("", alias="nsd-ref")


class TemplateRecord(_Administered):
    """Record of a network slice template (NST).

    Attributes:
        id: id in the template.
        subnets: its network services.
    """

    id: Text = ""
    name: Text = ""
    subnets: tuple[_Subnet, ...] = Field((), alias="netslice-subnet", strict=False)


class SliceRecord(_Administered):
    """Record of a network slice instance (NSI).

    Attributes:
        template: id of its template.
        status: of its network services, such as "running" or "failed".
    """

    name: Text = ""
    template: Text = Field("", alias="nst-ref")
    status: Text = Field("", alias="operational-status")
    detail: Text = Field("", alias="detailed-status")

    @property
    def state(self) -> str:
        """State to show: of its services, as far as OSM reports it."""
        return self.status or self.admin.slice_state.lower().replace("_", " ")


class SliceCreated(Created):
    """Response to a request that creates and instantiates a slice."""

    operation: Key = Field(alias="nsilcmop_id")


Read = TypeVar("Read")


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def read(kind: type[Read], answer: Any) -> Read:
    """Validate an answer of OSM.

    Raises:
        ValueError: it doesn't have the form of `kind`; says which field, never its value, which may be secret.
    """
    try:
        found: Read = _adapter(cast(Hashable, kind)).validate_python(answer)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"][:5]) or "the whole"
        raise ValueError(printable(f"{where}: {first['msg']}")[:200]) from None
    return found
