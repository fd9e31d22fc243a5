"""Options of a command that are the fields of parameters: their names, defaults, ranges and help are said once."""

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
    """Decorator of a command: its first parameter, a `model`, is given as arguments and options.

    Args:
        model: field by field an option, or an argument where it has no default; what is given is checked against its
            ranges, and fields that aren't given aren't set. A parameter of the command's by a field's name declares it.
        named: what an argument is called in the help, or an option on the command line, by its field.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
        fields = model.model_fields
        declared = {one.name for one in own}
        taken = [_parameter(name, field, named.get(name)) for name, field in fields.items() if name not in declared]
        taken.sort(key=lambda one: fields[one.name].is_required(), reverse=True)

        def called(**given: Any) -> None:
            values = {name: given[name] for name in fields}
            changed = {name: value for name, value in values.items() if value != fields[name].get_default()}
            rest = {name: value for name, value in given.items() if name in declared}
            command(model.of("", changed, remedy="`--help` says what it means"), **rest)

        # arguments, then what the command itself must be given, then options
        order = [*taken, *own]
        signature = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in order]
        called.__name__, called.__doc__ = command.__name__, command.__doc__
        called.__signature__ = inspect.Signature(signature)  # type: ignore[attr-defined]
        called.__annotations__ = {one.name: one.annotation for one in signature}
        return called

    return decorate


def assigned(assignments: Sequence[str], example: str) -> dict[str, Any]:
    """Settings by their names, of texts as "threshold=0.4", that a command was given by --set.

    Args:
        example: what to write instead, where one isn't.

    Raises:
        SettingError: a text assigns nothing.
    """
    given: dict[str, Any] = {}
    for text in assignments:
        name, equals, value = text.partition("=")
        if not equals:
            raise SettingError("--set", f"{text!r} assigns nothing", f"Write --set {example}")
        given[name.strip()] = parsed(value.strip())
    return given


def _parameter(name: str, field: FieldInfo, named: str | None) -> inspect.Parameter:
    """The field as Typer wants it: without its ranges, which the model checks."""
    kind = _plain(field.annotation)
    if field.is_required():
        about: Any = typer.Argument(help=field.description, metavar=named or name.upper())
        default = inspect.Parameter.empty
    else:
        about = typer.Option(named or f"--{name.replace('_', '-')}", help=field.description)
        default = field.get_default()
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, about])


def _plain(kind: Any) -> Any:
    """A type without the ranges of its numbers."""
    if get_origin(kind) is Annotated:
        return _plain(get_args(kind)[0])
    parts = get_args(kind)
    if get_origin(kind) is list:
        return list[_plain(parts[0])]  # type: ignore[misc]
    if get_origin(kind) is tuple and parts[-1] is Ellipsis:
        return list[_plain(parts[0])]  # type: ignore[misc]
    if get_origin(kind) is tuple:
        return tuple[tuple(_plain(part) for part in parts)]  # type: ignore[misc]
    if parts and type(None) in parts:
        return _plain(next(part for part in parts if part is not type(None))) | None
    return kind
