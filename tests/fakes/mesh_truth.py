"""Compares a world made from a synthetic mesh (`data_samples.mesh_model`) with the building and its colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.data_samples.building import Surface
from scan2sim.data_samples.mesh_model import TO_FILE, Paint, Sample
from scan2sim.pipeline.camera.models import unproject
from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.types import F32, F64, Camera, Frame, Mesh
from scan2sim.pipeline.geometry.surface_distance import distances, sample_surface
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.worlds.scene import read_scene
from tests.present import present

CAMERA = Camera("pinhole", 320, 240, 200.0, 200.0, 159.5, 119.5)
CAMERA_HEIGHT_M = 1.3
CAMERAS = 8
POINTS = 40_000


def surfaces(run: Path, up: str) -> tuple[list[Body], list[str]]:
    """The world's textured surfaces in the axes of the building, and their groups."""
    tile = read_tile(run / "map" / "tile")
    T = np.eye(4)
    T[:3, :3] = TO_FILE[up].T
    T = T @ np.linalg.inv(present(tile.robot_map).T_world_map)
    scene = read_scene(run)
    bodies, groups = [], []
    for part in scene.tiles:
        for group, shape in part.textured().items():
            world = shape.mesh.vertices.astype(np.float64) + part.frame.origin
            vertices = world @ T[:3, :3].T + T[:3, 3]
            bodies.append(Body(replace(shape.mesh, vertices=vertices.astype(np.float32)), shape.pages))
            groups.append(group)
    return bodies, groups


def poses(made: Sample) -> list[F64]:
    """Cameras in the building, looking along its routes and to their sides."""
    route = np.concatenate(made.building.routes)
    at = route[np.linspace(0, len(route) - 1, CAMERAS).astype(int)]
    found = []
    for i, position in enumerate(at):
        turn = 2 * np.pi * i / CAMERAS + 0.3
        forward = np.array([np.cos(turn), np.sin(turn), -0.25])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0, 0, 1))
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
        T[:3, 3] = position + (0, 0, CAMERA_HEIGHT_M)
        found.append(T)
    return found


def measure(run: Path, made: Sample, paint: Paint, up: str) -> dict[str, Any]:
    """PSNR (dB) of the rendered world, distances in metres in both directions, and shares of classes that are right."""
    bodies, groups = surfaces(run, up)
    truth = Mesh(Frame(), made.exact.astype(np.float32), made.faces.astype(np.int32))
    world, true = Renderer(bodies), Renderer([Body(truth)])
    errors, holes = [], []
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = unproject(CAMERA, np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    for T in poses(made):
        image, exact = world.view(CAMERA, T), true.view(CAMERA, T)
        hit = exact.hit.ravel()
        at = T[:3, 3] + (rays[hit] @ T[:3, :3].T) * exact.range.ravel()[hit, None]
        colour = paint.at(at, made.axis[exact.face.ravel()[hit]])
        both = image.hit.ravel()[hit]
        errors.append(((image.rgb.reshape(-1, 3)[hit] - colour) ** 2)[both])
        holes.append(~both)
    psnr = 10 * np.log10(255**2 / np.concatenate(errors).mean())
    joined = joined_mesh([body.mesh for body in bodies])
    building = made.building
    to_world = distances(sample_surface(truth, POINTS), joined)
    to_truth = distances(sample_surface(joined, POINTS), truth)
    shares = {}
    for kind, group in ((Surface.FLOOR, "terrain"), (Surface.WALL, "building"), (Surface.CEILING, "ceiling")):
        points = sample_surface(building.only(kind), POINTS // 4)
        near = np.array([distances(points, body.mesh) for body in bodies]).argmin(axis=0)
        shares[kind.name.lower()] = round(float((np.array(groups)[near] == group).mean()), 4)
    return {
        "psnr_db": round(float(psnr), 2),
        "holes": round(float(np.concatenate(holes).mean()), 5),
        "to_world_p95_m": round(float(np.percentile(to_world, 95)), 4),
        "to_world_max_m": round(float(to_world.max()), 4),
        "to_truth_p95_m": round(float(np.percentile(to_truth, 95)), 4),
        "right_class": shares,
        "triangles": {group: len(body.mesh) for group, body in zip(groups, bodies, strict=True)},
    }


def joined_mesh(meshes: list[Mesh]) -> Mesh:
    """Geometry of several meshes as one."""
    start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices: F32 = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([mesh.faces + s for mesh, s in zip(meshes, start[:-1], strict=True)])
    return Mesh(meshes[0].frame, vertices, faces.astype(np.int32))
