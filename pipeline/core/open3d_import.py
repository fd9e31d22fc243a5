"""Import Open3D without its plots for notebooks, which import dash and plotly: these take as long as all the rest."""

from __future__ import annotations

import sys
from types import ModuleType

PLOTS = "open3d.visualization.draw_plotly"
"""Its module that imports them."""
FUNCTIONS = ("draw_plotly", "draw_plotly_server", "get_plotly_fig")


def leave_out_plots() -> None:
    """Let later imports of Open3D in this process leave out its plots; for processes that run steps only."""
    if "open3d" not in sys.modules:
        stand_in = ModuleType(PLOTS)
        for name in FUNCTIONS:
            setattr(stand_in, name, _unavailable)
        sys.modules[PLOTS] = stand_in


def _unavailable(*_: object, **__: object) -> None:
    raise ImportError("Open3D's plots aren't loaded in processes that run steps")
