"""Settings of a run: defaults, overridden by a TOML file, overridden by `--set step.param=value`.

`--set decimate.target=50000` applies to all surface classes, `--set decimate.building.target=50000` to one.
In a file: `[decimate]` and `[decimate.building]`.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.step import Params, Step
from scan2sim.pipeline.io import toml

P = TypeVar("P", bound=Params)


class Settings:
    """The user's settings by step and class; `params` merges them with the defaults of a step."""

    def __init__(
        self,
        values: Mapping[str, Mapping[str, Any]] | None = None,
        defaults: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self.values, self.defaults = dict(values or {}), dict(defaults or {})

    def with_defaults(self, defaults: Mapping[str, Mapping[str, Any]]) -> Settings:
        """The same settings, with defaults of the tile that replace those of the steps."""
        return Settings(self.values, defaults)

    @classmethod
    def read(cls, file: Path | None = None, assignments: Iterable[str] = ()) -> Settings:
        """Read a TOML file and `step[.class].param=value` texts; later ones override earlier ones.

        Raises:
            SettingError: the file can't be read, or an assignment has a wrong form.
        """
        values: dict[str, Any] = {}
        if file is not None:
            try:
                values = toml.table(file)
            except InputError as error:
                raise SettingError(file, error.cause, "Fix it, or leave --config out") from None
        for text in assignments:
            path, equals, value = text.partition("=")
            if not equals:
                raise SettingError(f"--set {text}", "is not an assignment", "Write --set step.param=value")
            _assign(values, path.strip(), parsed(value.strip()), f"--set {text}")
        return cls(values)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Settings:
        """From `{"decimate": {"target": 50000}}` or `{"decimate.target": 50000}`, in Python; later ones override.

        Values may be paths, tuples, and numbers and arrays of numpy, too.

        Raises:
            SettingError: a name has a wrong form.
        """
        tables: dict[str, Any] = {}
        for name, value in values.items():
            if "." in name:
                _assign(tables, name, _as_in_toml(value), name)
            else:
                tables[name] = _merged(tables.get(name), _as_in_toml(value))
        return cls(tables)

    def check(self, steps: Iterable[Step]) -> None:
        """Reject unknown steps and parameters, and classes for steps that are not run per class.

        Raises:
            SettingError: suggests the closest existing name.
        """
        known = {step.name: step for step in steps}
        for name, table in self.values.items():
            if name not in known:
                raise SettingError(name, "there is no such step", _nearest(name, known))
            if not isinstance(table, Mapping):
                raise SettingError(name, "must be a table of parameters", f"Write [{name}] or --set {name}.param=value")
            fields = known[name].params.settings()
            for key, value in table.items():
                special = key in SURFACES and isinstance(value, Mapping)
                if special and not known[name].per_class:
                    raise SettingError(f"{name}.{key}", "this step is not run per class", f"Set {name}.param instead")
                for param in value if special else (key,):
                    if param not in fields:
                        classes = SURFACES if known[name].per_class else ()
                        remedy = _nearest(param, [*fields, *classes])
                        raise SettingError(f"{name}.{param}", "there is no such parameter", remedy)

    def params(self, step: Step, group: str = "", context: Mapping[str, Any] | None = None, **given: Any) -> Any:
        """Parameters of a step: options `given` to a command, defaults of the class, then the user's settings.

        Args:
            step: the step.
            group: class that it is run for, else "".
            context: fields of its context, which users can't set.
            given: settings that have an option of their own.

        Raises:
            SettingError: a value out of range or of a wrong type, or one given twice.
        """
        general, special = _split(self.values.get(step.name, {}), group)
        tile_general, tile_special = _split(self.defaults.get(step.name, {}), group)
        for name in {*general, *special} & set(given):
            raise SettingError(f"{step.name}.{name}", "the command's option sets it, too", "Give only one of them")
        defaults = {**given, **tile_general, **step.class_defaults.get(group, {}), **tile_special}
        merged = {**defaults, **general, **special}
        return step.params.of(step.name, merged | ({"context": context} if context else {}))


def _as_in_toml(value: Any) -> Any:
    """A copy of a value in the types that a file would give: settings are logged and stored as JSON."""
    if isinstance(value, Mapping):
        return {name: _as_in_toml(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_in_toml(one) for one in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.tolist() if hasattr(value, "tolist") else value


def _merged(old: Any, new: Any) -> Any:
    """A table with the entries of both, those of `new` where both have one; `new` if one of them is no table."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    return old | {name: _merged(old.get(name), value) for name, value in new.items()}


def _split(table: Mapping[str, Any], group: str) -> tuple[dict[str, Any], Mapping[str, Any]]:
    """A step's settings for all classes, and those for the class `group`."""
    classes: dict[str, Mapping[str, Any]] = {k: v for k, v in table.items() if k in SURFACES and isinstance(v, Mapping)}
    return {k: v for k, v in table.items() if k not in classes}, classes.get(group, {})


def _assign(tables: dict[str, Any], path: str, value: object, where: str) -> None:
    """Put a value at `step.param` or `step.class.param`; `where` names the assignment in errors."""
    parts = path.split(".")
    if len(parts) not in (2, 3):
        raise SettingError(where, "is not an assignment", "Write step.param=value or step.class.param=value")
    table: Any = tables
    for part in parts[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise SettingError(where, f"`{part}` has a value already, it is not a table", "Remove that value")
    table[parts[-1]] = value


def parsed(text: str) -> Any:
    """The text as a TOML value or list of words if it is one, else as it is; shells remove the quotes of words."""
    try:
        return toml.parse(f"value = {text}")["value"]
    except ValueError:
        words = re.fullmatch(r"\[([\w.:/-]+(?:\s*,\s*[\w.:/-]+)*)\]", text.strip())
        return re.split(r"\s*,\s*", words[1]) if words else text


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, known, 1)
    return f"Did you mean `{close[0]}`?" if close else f"Choose one of: {', '.join(sorted(known))}"
