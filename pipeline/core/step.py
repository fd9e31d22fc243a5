"""What a step is: a pure function on files with frozen parameters, a name and a version.

To add one: a function, its `Params`, one line in `flows/pipelines/tile.py`, one test.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import described


class Params(BaseModel):
    """Base of every step's parameters: frozen, and unknown names are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def of(cls, where: str, values: Mapping[str, Any], *, remedy: str = "docs/settings.md lists them") -> Self:
        """Of what a user has set.

        Args:
            where: what its names stand below, as "poisson", in messages; "" for options of a command.

        Raises:
            SettingError: naming the first value out of its range, and the range.
        """
        try:
            return cls(**values)
        except ValidationError as error:
            first = error.errors()[0]
            name = str(first["loc"][0]) if first["loc"] else ""
            if name not in cls.model_fields:
                raise SettingError(f"{where}.{name}", "there is no such setting", remedy) from None
            if name not in values:
                raise SettingError(f"{where}.{name}", "is missing", remedy) from None
            value = f"{values[name]!r:.60}"
            cause = f"must be {described(cls.model_fields[name])} (got {value})"
            raise SettingError(f"{where}.{name}" if where else f"--{name.replace('_', '-')}", cause, remedy) from None


class Report(Protocol):
    """Progress callback: a bar in the command, an artifact in Prefect, nothing in tests."""

    def __call__(self, fraction: float, message: str = "") -> None:
        """Say that `fraction` (0 to 1) of the step is done, and what it is at."""


def silent(fraction: float, message: str = "") -> None:
    """A `Report` that says nothing."""


Inputs = Mapping[str, Path]


@dataclass(frozen=True)
class Done:
    """What a step made.

    Attributes:
        files: name to path of a file or folder inside the step's output folder.
        facts: JSON-able figures for the report (counts in and out, errors, ...).
        warnings: sentences that the user should read; shown and kept with the result.
    """

    files: dict[str, Path]
    facts: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


Run = Callable[..., Done]
"""The function of a step, `run(inputs, params, out, report)`: reads `inputs`, writes below the folder `out` only. Of a
step that `resumes` it gets a folder `checkpoint`, too: what it leaves there is there again after it was killed."""


@dataclass(frozen=True)
class Step:
    """A step of the mission.

    Attributes:
        name: as on the command line (`--from NAME`, `--set NAME.param=value`).
        version: raised whenever its results change for the same input and parameters.
        run: the function; must be importable by name (it may run in another process), and
            import what is heavy inside.
        params: its parameters; defaults are the mission's numbers.
        class_defaults: by class, defaults that differ between terrain, building and vegetation.
        check: given parameters, which then need defaults, raises a ScanError if the step can't run with them on this
            machine (a package is missing, say); called before any step runs, and quick. None: it always can.
        per_class: whether it is run for each class apart.
        resumes: whether it goes on where it was killed.
        side_product: whether the world is made without its results where it fails (`flows.pipelines.tile`).
        memory: GB at least, and GB for every GB that it reads (photos not counted), as measured on generated streets
            (docs/scale.md).
    """

    name: str
    version: int
    run: Run
    params: type[Params] = Params
    class_defaults: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    check: Callable[[Any], None] | None = None
    per_class: bool = False
    resumes: bool = False
    side_product: bool = False
    memory: tuple[float, float] = (0.5, 6)
