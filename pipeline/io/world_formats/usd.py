"""OpenUSD: crate files, Z-up, metres; a payload a tile, so that large worlds load by parts.

Layout: `<name>.usdc` places the tiles; `usd/<tile>.usdc` is a tile (`Looks`, `Visual`, `Collision`), with its texture
pages in `usd/<tile>/`. Where a scene has levels of detail, coarser ones of a tile are variants of it (`levelOfDetail`):
`usd/level<n>/<tile>.usdc`, with the same that bodies collide with. Labels are `UsdSemanticsLabelsAPI:class`. Where the
world is on the map stands in the custom data of the root layer and of `/World`: USD has no schema for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F32, Mesh, View
from scan2sim.pipeline.geometry.cylinders import Cylinder
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import provenance, sdf
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile, Surface, by_class
from scan2sim.pipeline.io.worlds.textured_mesh import unique_uv, vertex_normals
from scan2sim.pipeline.simulation.collision_shapes import Solid, solids

NEEDS = ("pxr",)
FOLDER = "usd"
VARIANTS, FINEST = "levelOfDetail", "finest"
SKY = 1000.0
"""Nits of an even sky: the photos hold the light of their day."""


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the root layer and a layer for each tile."""
    from pxr import Gf, Kind, Usd, UsdGeom, UsdLux, UsdPhysics

    make_folder(folder / FOLDER)
    triangles = {}
    stage = _stage(folder / f"{scene.name}.usdc")
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    Usd.ModelAPI(world).SetKind(Kind.Tokens.assembly)
    place = _georeference(scene)
    stage.GetRootLayer().customLayerData = {"scan2sim": place}
    world.GetPrim().SetCustomDataByKey("scan2sim", place)
    UsdPhysics.Scene.Define(stage, "/World/Physics").CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
    UsdLux.DomeLight.Define(stage, "/World/Sky").CreateIntensityAttr(SKY)
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        placed = UsdGeom.Xform.Define(stage, f"/World/{_prim(tile.name)}")
        placed.AddTranslateOp().Set(Gf.Vec3d(*tile.offset))
        files = {}
        for level in scene.levels(tile):
            file = f"{FOLDER}/{f'level{level.height}/' if level.height else ''}{tile.name}.usdc"
            make_folder((folder / file).parent)
            triangles[file] = _write_tile(folder / file, level.tile, tile, params)
            files[f"level{level.height}" if level.height else FINEST] = f"./{file}"
        _load(placed.GetPrim(), files)
    stage.GetRootLayer().Save()
    return triangles


def _load(prim: Any, files: dict[str, str]) -> None:
    """Give a tile its payload; several are variants, of which the first is chosen."""
    if len(files) == 1:
        prim.GetPayloads().AddPayload(*files.values())
        return
    variants = prim.GetVariantSets().AddVariantSet(VARIANTS)
    for name, file in files.items():
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            prim.GetPayloads().AddPayload(file)
    variants.SetVariantSelection(next(iter(files)))


def _write_tile(path: Path, tile: SceneTile, own: SceneTile, params: SceneParams) -> int:
    """Write a tile's layer, local metres; how many triangles it shows.

    Args:
        path: of the layer.
        tile: what is shown, at one of its levels.
        own: the scene's own, which bodies collide with.
        params: how it is written.
    """
    from pxr import Kind, Usd, UsdGeom

    stage = _stage(path)
    root = UsdGeom.Xform.Define(stage, f"/{_prim(tile.name)}")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    for scope in ("Looks", "Visual", "Collision"):
        UsdGeom.Scope.Define(stage, root.GetPath().AppendChild(scope))
    triangles, views = 0, tile.views()
    _list_photos(UsdGeom.PrimvarsAPI(root), views)
    for group, shape in tile.textured().items():
        pages = world_formats.write_pages(path.with_suffix(""), group, shape, params)
        looks = {
            page: _look(stage, root, pages.materials[page], f"./{tile.name}/{pages.images[page]}")
            for page in pages.used
        }
        for surface in by_class(group, shape):
            for part in surface.parts(params.max_visual_triangles):
                _show(stage, root, part, looks, views)
                triangles += len(part.shape)
    for solid in solids(own.solid(), own.friction):
        _collide(stage, root, solid)
    stage.GetRootLayer().Save()
    return triangles


def _show(stage: Any, root: Any, surface: Surface, looks: dict[int, Any], views: Sequence[View]) -> None:
    """A surface, a subset of its faces for each page, with its labels."""
    from pxr import Sdf, UsdGeom, UsdSemantics, UsdShade, Vt

    shape = surface.shape
    assert shape.mesh.uv is not None and shape.mesh.page is not None
    mesh = _mesh(stage, root.GetPath().AppendPath(f"Visual/{surface.name}"), shape.mesh, shape.normal)
    uv, corner_uv = unique_uv(shape.mesh.uv)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(uv))
    st.SetIndices(Vt.IntArray.FromNumpy(corner_uv.ravel()))
    _origin(primvars, surface, views)
    prim = mesh.GetPrim()
    for taxonomy, label in {"class": surface.label, "las_code": str(surface.code)}.items():
        UsdSemantics.LabelsAPI.Apply(prim, taxonomy).CreateLabelsAttr([label])
    UsdShade.MaterialBindingAPI.Apply(prim)
    for page in shape.used_pages:
        faces = np.flatnonzero(shape.mesh.page == page).astype(np.int32)
        subset = UsdGeom.Subset.CreateGeomSubset(
            mesh, f"page_{page}", UsdGeom.Tokens.face, Vt.IntArray.FromNumpy(faces),
            UsdShade.Tokens.materialBind, UsdGeom.Tokens.partition,
        )  # fmt: skip
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(looks[page])


def _list_photos(primvars: Any, views: Sequence[View]) -> None:
    """The photos that faces name by their numbers, and when each was taken, on all that is below a prim."""
    from pxr import Sdf, UsdGeom, Vt

    rows = provenance.table(views)[provenance.FIRST :]
    for name, values in (("photos", [row.photo for row in rows]), ("taken", [row.taken for row in rows])):
        if any(values):
            listed = primvars.CreatePrimvar(f"scan2sim:{name}", Sdf.ValueTypeNames.StringArray, UsdGeom.Tokens.constant)
            listed.Set(Vt.StringArray(values))


def _origin(primvars: Any, surface: Surface, views: Sequence[View]) -> None:
    """Where each face has its colour from, which photo gives its detail, and how far that was from its middle."""
    from pxr import Sdf, UsdGeom, Vt

    seen, row = surface.seen(), provenance.rows(surface)
    if seen is None or row is None:
        return
    far = provenance.distance(surface.shape.mesh.corners.mean(axis=1), row, views)
    photo = np.maximum(row - provenance.FIRST, -1)
    for name, values in (("seen", seen.astype(np.int32)), ("photo", photo.astype(np.int32))):
        given = primvars.CreatePrimvar(f"scan2sim:{name}", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.uniform)
        given.Set(Vt.IntArray.FromNumpy(values))
    given = primvars.CreatePrimvar("scan2sim:distance", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.uniform)
    given.Set(Vt.FloatArray.FromNumpy(far))


def _collide(stage: Any, root: Any, solid: Solid) -> None:
    """What bodies collide with: static, as it is, with its friction, and not drawn."""
    from pxr import Gf, UsdGeom, UsdPhysics, UsdShade

    path, shape = root.GetPath().AppendPath(f"Collision/{solid.name}"), solid.shape
    if isinstance(shape, Cylinder):
        body = UsdGeom.Cylinder.Define(stage, path)
        body.CreateAxisAttr(UsdGeom.Tokens.z)
        body.CreateRadiusAttr(shape.radius)
        body.CreateHeightAttr(shape.length)
        body.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(body, 0))
        body.AddTranslateOp().Set(Gf.Vec3d(*shape.centre))
        body.AddOrientOp().Set(Gf.Quatf(Gf.Rotation(Gf.Vec3d(0, 0, 1), Gf.Vec3d(*shape.axis)).GetQuat()))
    else:
        body = _mesh(stage, path, shape, vertex_normals(shape))
        UsdPhysics.MeshCollisionAPI.Apply(body.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.none)
    body.CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdPhysics.CollisionAPI.Apply(body.GetPrim())
    material = UsdShade.Material.Define(stage, root.GetPath().AppendPath(f"Looks/Friction_{solid.name}"))
    physics = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    physics.CreateStaticFrictionAttr(solid.friction)
    physics.CreateDynamicFrictionAttr(solid.friction)
    binding = UsdShade.MaterialBindingAPI.Apply(body.GetPrim())
    binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")


def _mesh(stage: Any, path: Any, mesh: Mesh, normal: F32) -> Any:
    """Triangles as they are: no subdivision."""
    from pxr import UsdGeom, Vt

    made = UsdGeom.Mesh.Define(stage, path)
    made.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    made.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.vertices))
    made.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normal))
    made.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    made.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.ravel()))
    made.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh), 3, np.int32)))
    made.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(made.GetPointsAttr().Get()))
    return made


def _look(stage: Any, root: Any, name: str, image: str) -> Any:
    """A matt material of a texture page."""
    from pxr import Sdf, UsdShade

    path = root.GetPath().AppendPath(f"Looks/{name}")
    material = UsdShade.Material.Define(stage, path)
    places = UsdShade.Shader.Define(stage, path.AppendChild("st"))
    places.CreateIdAttr("UsdPrimvarReader_float2")
    places.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    page = UsdShade.Shader.Define(stage, path.AppendChild("page"))
    page.CreateIdAttr("UsdUVTexture")
    page.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(image)
    page.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    page.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set("clamp")
    page.CreateInput("wrapT", Sdf.ValueTypeNames.Token).Set("clamp")
    st = places.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    page.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(st)
    surface = UsdShade.Shader.Define(stage, path.AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    colour = page.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(colour)
    shown = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(shown)
    return material


def _georeference(scene: Scene) -> dict[str, Any]:
    """Where the world is on the map, as numbers and text that USD keeps."""
    from pxr import Gf

    place = sdf.Georeference.of(scene.frame)
    own = {"crs": scene.frame.crs, "worldOriginMetres": Gf.Vec3d(*scene.origin), "unitMetres": scene.frame.unit}
    return own if place is None else {**own, "wgs84": place.facts()}


def _stage(path: Path) -> Any:
    from pxr import Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    return stage


def _prim(name: str) -> str:
    """A tile's name for a prim, which begins with no digit."""
    return f"tile_{name}" if name[0].isdigit() else name
