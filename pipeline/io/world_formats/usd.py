"""OpenUSD: crate files, z up, metres; one payload per tile, so that large worlds can be loaded in parts.

Layout: `<name>.usdc` places the tiles; `usd/<tile>.usdc` is a tile (`Looks`, `Visual`, `Backdrop`, `Collision`); its
texture pages are in `usd/<tile>/`. If a scene has levels of detail, coarser levels of a tile are variants of it
(`levelOfDetail`): `usd/level<n>/<tile>.usdc`, with the same collision shapes. Labels are `UsdSemanticsLabelsAPI:class`.
`Backdrop` is what only cameras see: deactivate it for sensors that measure distances; the sky of a survey is a tile
of its own, `<name>_sky`, with nothing else. The georeference
is in the custom data of the root layer and of `/World`, as USD has no schema for it.
"""

from __future__ import annotations

import os
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
from scan2sim.pipeline.io.worlds import provenance, sdf, usd_splats
from scan2sim.pipeline.io.worlds.scene import BACKDROP, Scene, SceneTile, Surface, by_class
from scan2sim.pipeline.io.worlds.textured_mesh import unique_uv, vertex_normals
from scan2sim.pipeline.simulation.collision_shapes import Solid, solids

NEEDS = ("pxr",)
# Version of crate files, read when `pxr` is first imported. Some releases (24.11, 25.02) write 0.10.0 by default, which
# programs with OpenUSD before 23.11 can't open (Isaac Sim up to 4.5). Nothing in these files needs more than 0.8.0.
os.environ.setdefault("USD_WRITE_NEW_USDC_FILES_AS_VERSION", "0.8.0")
FOLDER = "usd"
VARIANT_SET, FINEST_VARIANT = "levelOfDetail", "finest"
SKY_INTENSITY_NITS = 1000.0
"""Intensity of a uniform sky, as the textures contain the daylight of the photos."""


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the root layer and a layer for each tile."""
    from pxr import Gf, Kind, Usd, UsdGeom, UsdLux, UsdPhysics

    make_folder(folder / FOLDER)
    triangles = {}
    stage = _stage(folder / f"{scene.name}.usdc")
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    Usd.ModelAPI(world).SetKind(Kind.Tokens.assembly)
    georeference = _georeference(scene)
    stage.GetRootLayer().customLayerData = {"scan2sim": georeference}
    world.GetPrim().SetCustomDataByKey("scan2sim", georeference)
    UsdPhysics.Scene.Define(stage, "/World/Physics").CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
    UsdLux.DomeLight.Define(stage, "/World/Sky").CreateIntensityAttr(SKY_INTENSITY_NITS)
    for i, tile in enumerate(scene.with_dome):
        report(i / len(scene.with_dome), tile.name)
        placed = UsdGeom.Xform.Define(stage, f"/World/{_prim(tile.name)}")
        placed.AddTranslateOp().Set(Gf.Vec3d(*tile.offset))
        files = {}
        for level in scene.levels(tile):
            file = f"{FOLDER}/{f'level{level.height}/' if level.height else ''}{tile.name}.usdc"
            make_folder((folder / file).parent)
            triangles[file] = _write_tile(folder / file, level.tile, tile, params, len(scene.tiles) == 1)
            files[f"level{level.height}" if level.height else FINEST_VARIANT] = f"./{file}"
        _add_payloads(placed.GetPrim(), files)
    stage.GetRootLayer().Save()
    return triangles


def _add_payloads(prim: Any, files: dict[str, str]) -> None:
    """Add a tile's payload; several payloads are variants, of which the first is selected."""
    if len(files) == 1:
        prim.GetPayloads().AddPayload(*files.values())
        return
    variants = prim.GetVariantSets().AddVariantSet(VARIANT_SET)
    for name, file in files.items():
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            prim.GetPayloads().AddPayload(file)
    variants.SetVariantSelection(next(iter(files)))


def _write_tile(path: Path, tile: SceneTile, source: SceneTile, params: SceneParams, alone: bool) -> int:
    """Write a tile's layer in local metres; returns its number of visual triangles.

    Args:
        path: file of the layer.
        tile: the tile at one of its levels of detail, for the visuals.
        source: the scene's own tile, for the collision shapes.
        params: settings.
        alone: it is the only tile; splats of several have no background, which would hide each other's streets.
    """
    from pxr import Kind, Usd, UsdGeom

    stage = _stage(path)
    root = UsdGeom.Xform.Define(stage, f"/{_prim(tile.name)}")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    for scope in ("Looks", "Visual", "Backdrop", "Collision"):
        UsdGeom.Scope.Define(stage, root.GetPath().AppendChild(scope))
    triangles, views = 0, tile.views()
    _list_photos(UsdGeom.PrimvarsAPI(root), views)
    shown = {group: (shape, by_class(group, shape)) for group, shape in tile.textured().items()}
    shown |= {surface.name: (surface.shape, [surface]) for surface in tile.backdrop()}
    for group, (shape, surfaces) in shown.items():
        pages = world_formats.write_pages(path.with_suffix(""), group, shape, params)
        materials = {
            page: _add_material(stage, root, pages.materials[page], f"./{tile.name}/{pages.images[page]}")
            for page in pages.used
        }
        for surface in surfaces:
            for part in surface.parts(params.max_visual_triangles):
                _add_visual(stage, root, part, materials, views, params)
                triangles += len(part.shape)
    layer = source.splats()
    if layer is not None:
        usd_splats.add(stage, root, layer.with_shell() if alone else layer.splats, ("Visual", "Backdrop"))
    for solid in solids(source.solid(), source.friction):
        _add_collision(stage, root, solid)
    stage.GetRootLayer().Save()
    return triangles


def _add_visual(
    stage: Any, root: Any, surface: Surface, materials: dict[int, Any], views: Sequence[View], params: SceneParams
) -> None:
    """Add a surface with its labels, its `reflectance` if known, and one subset of faces per texture page."""
    from pxr import Sdf, UsdGeom, UsdSemantics, UsdShade, Vt

    shape = surface.shape
    assert shape.mesh.uv is not None and shape.mesh.page is not None
    mesh = _mesh(stage, root.GetPath().AppendPath(f"{_scope(surface)}/{surface.name}"), shape.mesh, shape.normal)
    uv, corner_uv = unique_uv(shape.mesh.uv)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(uv))
    st.SetIndices(Vt.IntArray.FromNumpy(corner_uv.ravel()))
    _add_provenance(primvars, surface, views)
    mesh.CreateDoubleSidedAttr(params.double_sided and surface.group != BACKDROP)
    if params.reflectance and shape.reflectance is not None:
        primvar = primvars.CreatePrimvar("reflectance", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
        primvar.Set(Vt.FloatArray.FromNumpy(shape.reflectance))
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
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(materials[page])


def _scope(surface: Surface) -> str:
    return "Backdrop" if surface.group == BACKDROP else "Visual"


def _list_photos(primvars: Any, views: Sequence[View]) -> None:
    """Add the photos to which faces refer by index, and their capture times, inherited by all prims below."""
    from pxr import Sdf, UsdGeom, Vt

    rows = provenance.table(views)[provenance.FIRST_VIEW_ROW :]
    for name, values in (("photos", [row.photo for row in rows]), ("taken", [row.taken for row in rows])):
        if any(values):
            primvar = primvars.CreatePrimvar(
                f"scan2sim:{name}", Sdf.ValueTypeNames.StringArray, UsdGeom.Tokens.constant
            )
            primvar.Set(Vt.StringArray(values))


def _add_provenance(primvars: Any, surface: Surface, views: Sequence[View]) -> None:
    """Add the provenance of each face's colour: source, photo, and distance of the photo from the face's centre."""
    from pxr import Sdf, UsdGeom, Vt

    seen, row = surface.seen(), provenance.rows(surface)
    if seen is None or row is None:
        return
    distance = provenance.distance(surface.shape.mesh.corners.mean(axis=1), row, views)
    photo = np.maximum(row - provenance.FIRST_VIEW_ROW, -1)
    for name, values in (("seen", seen.astype(np.int32)), ("photo", photo.astype(np.int32))):
        primvar = primvars.CreatePrimvar(f"scan2sim:{name}", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.uniform)
        primvar.Set(Vt.IntArray.FromNumpy(values))
    primvar = primvars.CreatePrimvar("scan2sim:distance", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.uniform)
    primvar.Set(Vt.FloatArray.FromNumpy(distance))


def _add_collision(stage: Any, root: Any, solid: Solid) -> None:
    """Add a collision shape: static, exact (no approximation), with its friction, invisible."""
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
    """Add a triangle mesh without subdivision."""
    from pxr import UsdGeom, Vt

    usd_mesh = UsdGeom.Mesh.Define(stage, path)
    usd_mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    usd_mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.vertices))
    usd_mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normal))
    usd_mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    usd_mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.ravel()))
    usd_mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh), 3, np.int32)))
    usd_mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(usd_mesh.GetPointsAttr().Get()))
    return usd_mesh


def _add_material(stage: Any, root: Any, name: str, image: str) -> Any:
    """Add a matt material with a texture page."""
    from pxr import Sdf, UsdShade

    path = root.GetPath().AppendPath(f"Looks/{name}")
    material = UsdShade.Material.Define(stage, path)
    uv_reader = UsdShade.Shader.Define(stage, path.AppendChild("st"))
    uv_reader.CreateIdAttr("UsdPrimvarReader_float2")
    uv_reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    page = UsdShade.Shader.Define(stage, path.AppendChild("page"))
    page.CreateIdAttr("UsdUVTexture")
    page.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(image)
    page.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    page.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set("clamp")
    page.CreateInput("wrapT", Sdf.ValueTypeNames.Token).Set("clamp")
    st = uv_reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    page.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(st)
    surface = UsdShade.Shader.Define(stage, path.AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    colour = page.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(colour)
    surface_output = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface_output)
    return material


def _georeference(scene: Scene) -> dict[str, Any]:
    """The world's georeference as custom data of USD."""
    from pxr import Gf

    wgs84 = sdf.Georeference.of(scene.frame)
    body = {"crs": scene.frame.crs, "worldOriginMetres": Gf.Vec3d(*scene.origin), "unitMetres": scene.frame.unit}
    return body if wgs84 is None else {**body, "wgs84": wgs84.as_metadata()}


def _stage(path: Path) -> Any:
    from pxr import Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    return stage


def _prim(name: str) -> str:
    """Prim name of a tile; a prim name can't start with a digit."""
    return f"tile_{name}" if name[0].isdigit() else name
