"""Settings of a run: the mission's defaults, a TOML file, and `--set step.param=value`, in that order.

`--set decimate.target=50000` holds for every class, `--set decimate.building.target=50000` for one.
In a file: `[decimate]` and `[decimate.building]`.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.step import Params, Step
from scan2sim.pipeline.io import toml

P = TypeVar("P", bound=Params)


class Settings:
    """What the user set, by step and class; `params` merges it with a step's defaults."""

    def __init__(self, values: Mapping[str, Mapping[str, Any]] | None = None) -> None:
        self.values = dict(values or {})

    @classmethod
    def read(cls, file: Path | None = None, assignments: Iterable[str] = ()) -> Settings:
        """From a TOML file and `step[.class].param=value` texts; later ones win.

        Raises:
            SettingError: the file can't be read, or an assignment isn't one.
        """
        values: dict[str, Any] = {}
        if file is not None:
            try:
                values = toml.table(file)
            except InputError as error:
                raise SettingError(file, error.cause, "Mend it, or leave --config out") from None
        for text in assignments:
            path, equals, value = text.partition("=")
            parts = path.strip().split(".")
            if not equals or len(parts) not in (2, 3):
                raise SettingError(f"--set {text}", "is no assignment", "Write --set step.param=value")
            table: Any = values
            for part in parts[:-1]:
                table = table.setdefault(part, {})
                if not isinstance(table, dict):
                    raise SettingError(f"--set {text}", f"`{part}` was given a value before", "Make it a table there")
            table[parts[-1]] = parsed(value.strip())
        return cls(values)

    def check(self, steps: Iterable[Step]) -> None:
        """Refuse names that no step knows, and classes where a step is not run per class.

        Raises:
            SettingError: naming the nearest name that exists.
        """
        known = {step.name: step for step in steps}
        for name, table in self.values.items():
            if name not in known:
                raise SettingError(name, "there is no such step", _nearest(name, known))
            if not isinstance(table, Mapping):
                raise SettingError(name, "must be a table of parameters", f"Write [{name}] or --set {name}.param=value")
            fields = known[name].params.model_fields
            for key, value in table.items():
                special = key in SURFACES and isinstance(value, Mapping)
                if special and not known[name].per_class:
                    raise SettingError(f"{name}.{key}", "this step is not run per class", f"Set {name}.param instead")
                for param in value if special else (key,):
                    if param not in fields:
                        raise SettingError(f"{name}.{param}", "there is no such parameter", _nearest(param, fields))

    def params(self, step: Step, group: str = "", **given: Any) -> Any:
        """The step's parameters: `given` by the recipe, defaults of the class, what the user set.

        Raises:
            SettingError: a value out of range or of the wrong kind, or one that only the recipe sets.
        """
        table = self.values.get(step.name, {})
        classes: dict[str, Mapping[str, Any]] = {
            k: v for k, v in table.items() if k in SURFACES and isinstance(v, Mapping)
        }
        general = {k: v for k, v in table.items() if k not in classes}
        special = classes.get(group, {})
        for name in {*general, *special} & set(given):
            raise SettingError(f"{step.name}.{name}", "follows from the tile or other settings", "Leave it out")
        merged = {**given, **step.class_defaults.get(group, {}), **general, **special}
        return step.params.of(step.name, merged)


def parsed(text: str) -> Any:
    """A TOML value where it is one, else the text itself."""
    try:
        return toml.parse(f"value = {text}")["value"]
    except ValueError:
        return text


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, known, 1)
    return f"Did you mean `{close[0]}`?" if close else f"There are: {', '.join(sorted(known))}"
