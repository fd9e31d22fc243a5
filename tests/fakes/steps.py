"""Parameters of a step that is called without a pipeline."""

from __future__ import annotations

from typing import Any, get_args

from scan2sim.pipeline.core.step import Context, Params
from scan2sim.pipeline.core.tile_cell import TileCell


def step_params(kind: type[Params], **given: Any) -> Any:
    """Parameters from settings and fields of the context, of which those of a cell may be given without the cell.

    Args:
        kind: class of the parameters.
        given: settings, and fields of the context.
    """
    context = _context(kind)
    if context is None or "context" in given:
        return kind(**given)
    settings = {name: value for name, value in given.items() if name in kind.settings()}
    facts = {name: value for name, value in given.items() if name not in settings}
    if context is not TileCell and "cell" in context.model_fields:
        cell = {name: facts.pop(name) for name in ("seed", "neighbours", "buffer") if name in facts}
        if cell.get("seed") is not None:
            name = facts.get("name", "tile") if "name" in context.model_fields else facts.pop("name", "tile")
            facts["cell"] = {"name": name, **cell}
    elif context is TileCell:
        facts = {"name": "tile", **facts} if facts.get("seed") is not None else {}
    return kind(**settings, **({"context": facts} if facts else {}))


def _context(kind: type[Params]) -> type[Context] | None:
    if "context" not in kind.model_fields:
        return None
    annotation: Any = kind.model_fields["context"].annotation
    kinds = [annotation, *get_args(annotation)]
    return next(one for one in kinds if isinstance(one, type) and issubclass(one, Context))
