"""Definition of a step: a pure function on files with frozen parameters, a name and a version.

To add one, write a function, its `Params`, connect it in `flows/pipelines/tile.py` (docs/contributing.md), and a test.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from scan2sim.pipeline.core.errors import ScanError, SettingError
from scan2sim.pipeline.core.parameters import described


class Context(BaseModel):
    """Base class of what the pipeline passes to a step besides files: data of the tile, and other steps' settings.

    Parameters with a context have it as their field `context`; users can't set it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Params(BaseModel):
    """Base class of every step's parameters, the user's settings: frozen, unknown names are rejected."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def settings(cls) -> dict[str, FieldInfo]:
        """Fields that the user can set, by name: all but `context`."""
        return {name: field for name, field in cls.model_fields.items() if name != "context"}

    @classmethod
    def of(
        cls, where: str, values: Mapping[str, Any], *, remedy: str = "docs/reference/settings.md lists all settings"
    ) -> Self:
        """Validate values from the user.

        Args:
            where: prefix of the names in messages, such as "poisson"; "" for options of a command.
            values: values by name.
            remedy: last sentence of the error message.

        Raises:
            SettingError: names the first unknown, missing or invalid value, and the range.
        """
        try:
            return cls(**values)
        except ValidationError as error:
            first = error.errors()[0]
            name = str(first["loc"][0]) if first["loc"] else ""
            if name not in cls.model_fields:
                raise SettingError(f"{where}.{name}", "unknown setting", remedy) from None
            if name not in values:
                raise SettingError(f"{where}.{name}", "is missing", remedy) from None
            value = f"{values[name]!r:.60}"
            cause = f"must be {described(cls.model_fields[name])} (got {value})"
            raise SettingError(f"{where}.{name}" if where else f"--{name.replace('_', '-')}", cause, remedy) from None


class Report(Protocol):
    """Progress callback: a bar in the command, an artifact in Prefect, nothing in tests."""

    def __call__(self, fraction: float, message: str = "") -> None:
        """Report that `fraction` (0 to 1) of the step is done, and what it is working on."""


def silent(fraction: float, message: str = "") -> None:
    """A `Report` that discards progress."""


Inputs = Mapping[str, Path]


@dataclass(frozen=True)
class Done:
    """Result of a step.

    Attributes:
        files: name to path of a file or folder inside the step's output folder.
        metrics: for the report, JSON-serializable (counts in and out, errors, ...).
        warnings: sentences for the user, printed and stored with the result.
        failed: errors of optional parts of the result, by name: the result is used, and the next run retries the step.
    """

    files: dict[str, Path]
    metrics: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    failed: dict[str, ScanError] = field(default_factory=dict)


Run = Callable[..., Done]
"""The function of a step, `run(inputs, params, out, report)`: reads `inputs`, writes only below the folder `out`. If
the step `resumes`, it also gets a folder `checkpoint`, whose contents survive when the step is killed; if it has
`parts`, also `parts`."""


@dataclass(frozen=True)
class Step:
    """A step of the pipeline.

    Attributes:
        name: as on the command line (`--from NAME`, `--set NAME.param=value`).
        version: increased whenever results change for the same inputs and parameters.
        run: the function; must be importable by name, as it may run in another process, and import heavy modules
            only when called.
        params: class of its parameters; defaults are those of D3.2.
        class_defaults: defaults that differ between terrain, building and vegetation, by class.
        check: optional function of the parameters (which then all need defaults), called before any step runs; raises
            a ScanError if the step can't run with them on this machine, for a missing package, for example. Fast.
        per_class: whether it runs once for each class.
        resumes: whether it can resume from a checkpoint after it was killed.
        parts: whether it reuses parts of its earlier results (`pipeline.core.parts`).
        memory: base memory in GB, and GB per GB of input (without photos), measured on generated streets
            (docs/surveys.md).
    """

    name: str
    version: int
    run: Run
    params: type[Params] = Params
    class_defaults: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    check: Callable[[Any], None] | None = None
    per_class: bool = False
    resumes: bool = False
    parts: bool = False
    memory: tuple[float, float] = (0.5, 6)
