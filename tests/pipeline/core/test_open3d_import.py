"""Open3D in processes of steps: complete but for its plots, whose libraries take as long to import as all the rest."""

from __future__ import annotations

import sys

from scan2sim.pipeline.core import sandbox


def modules_and_triangles() -> tuple[set[str], int]:
    """Modules that Open3D has brought, and the number of triangles of a box."""
    import open3d as o3d

    return set(sys.modules), len(o3d.geometry.TriangleMesh.create_box().triangles)


def test_open3d_is_loaded_without_dash_and_plotly() -> None:
    modules, triangles = sandbox.call("tests.pipeline.core.test_open3d_import:modules_and_triangles", timeout=120)
    assert triangles == 12 and "open3d.visualization" in modules
    assert not {"dash", "plotly"} & modules
