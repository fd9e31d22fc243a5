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
    metrics = {name: value for name, value in given.items() if name not in settings}
    if context is not TileCell and "cell" in context.model_fields:
        cell = {name: metrics.pop(name) for name in ("seed", "neighbours", "buffer") if name in metrics}
        if cell.get("seed") is not None:
            name = metrics.get("name", "tile") if "name" in context.model_fields else metrics.pop("name", "tile")
            metrics["cell"] = {"name": name, **cell}
    elif context is TileCell:
        metrics = {"name": "tile", **metrics} if metrics.get("seed") is not None else {}
    return kind(**settings, **({"context": metrics} if metrics else {}))


def _context(kind: type[Params]) -> type[Context] | None:
    if "context" not in kind.model_fields:
        return None
    annotation: Any = kind.model_fields["context"].annotation
    kinds = [annotation, *get_args(annotation)]
    return next(one for one in kinds if isinstance(one, type) and issubclass(one, Context))
