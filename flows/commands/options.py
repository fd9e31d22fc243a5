"""Command options generated from the fields of a `Params` model: names, defaults, ranges and help."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Annotated, Any, TypeVar, get_args, get_origin

import typer
from pydantic.fields import FieldInfo

from scan2sim.flows.pipelines.settings import parsed
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Params

P = TypeVar("P", bound=Params)


def options(model: type[P], **named: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator of a command: generates arguments and options for its first parameter, a `model`.

    Args:
        model: a required field becomes an argument, any other an option. Values are validated by the model, and fields
            that keep their defaults stay unset. A parameter of the command with a field's name overrides its option.
        named: field name to the metavar of its argument, or to the name of its option ("--out").
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own_parameters = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
        fields = model.model_fields
        declared = {parameter.name for parameter in own_parameters}
        generated = [_parameter(name, field, named.get(name)) for name, field in fields.items() if name not in declared]
        generated.sort(key=lambda parameter: fields[parameter.name].is_required(), reverse=True)

        def wrapper(**given: Any) -> None:
            values = {name: given[name] for name in fields}
            changed = {name: value for name, value in values.items() if value != fields[name].get_default()}
            rest = {name: value for name, value in given.items() if name in declared}
            try:
                params = model.of("", changed, remedy="`--help` describes it")
            except SettingError as error:
                field = str(error.where).removeprefix("--").replace("-", "_")
                raise SettingError(named.get(field, error.where), error.cause, error.remedy) from None
            command(params, **rest)

        parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (*generated, *own_parameters)]
        wrapper.__name__, wrapper.__doc__ = command.__name__, command.__doc__
        wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return wrapper

    return decorate


def assigned(assignments: Sequence[str], example: str) -> dict[str, Any]:
    """Settings by name from the texts of option --set, such as "threshold=0.4".

    Args:
        example: a valid assignment, for the error message.

    Raises:
        SettingError: a text has no `=`.
    """
    given: dict[str, Any] = {}
    for text in assignments:
        name, equals, value = text.partition("=")
        if not equals:
            raise SettingError("--set", f"{text!r} has no `=`", f"Write for example --set {example}")
        given[name.strip()] = parsed(value.strip())
    return given


def _parameter(name: str, field: FieldInfo, named: str | None) -> inspect.Parameter:
    """A field as a parameter of a Typer command, without its range, which the model checks."""
    kind = _without_ranges(field.annotation)
    if field.is_required():
        declaration: Any = typer.Argument(help=field.description, metavar=named or name.upper())
        default = inspect.Parameter.empty
    else:
        default = field.get_default()
        option = name.replace("_", "-")
        switch = f"--{option}/--no-{option}" if default is True else f"--{option}"
        declaration = typer.Option(named or switch, help=field.description)
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, declaration]
    )


def _without_ranges(kind: Any) -> Any:
    """A type without the annotated ranges of its numbers."""
    if get_origin(kind) is Annotated:
        return _without_ranges(get_args(kind)[0])
    parts = get_args(kind)
    if get_origin(kind) is list:
        return list[_without_ranges(parts[0])]  # type: ignore[misc]
    if get_origin(kind) is tuple and parts[-1] is Ellipsis:
        return list[_without_ranges(parts[0])]  # type: ignore[misc]
    if get_origin(kind) is tuple:
        return tuple[tuple(_without_ranges(part) for part in parts)]  # type: ignore[misc]
    if parts and type(None) in parts:
        return _without_ranges(next(part for part in parts if part is not type(None))) | None
    return kind
