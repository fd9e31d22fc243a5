"""Shapes of actors as files: GLB with the origin of OpenSCENARIO, OBJ with that of the track's box."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import from_os_error
from scan2sim.pipeline.io.scenario_formats.openscenario import rear_axle
from scan2sim.pipeline.scenario.scenario import Actor
from scan2sim.pipeline.scenario.shapes import Part, parts

ROUGHNESS = {"glass": 0.1, "paint": 0.4}
"""Roughness by material; others 0.9."""


def write_glb(path: Path, actor: Actor) -> None:
    """Write an actor's shape, y up (x forward); its origin is the middle of the rear axle on the ground.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    import trimesh

    scene = trimesh.Scene()
    for material, found in _by_material(actor).items():
        vertices, faces = _joined(found)
        vertices = vertices - (rear_axle(actor), 0.0, 0.0)
        colour = [*found[0].colour, 255]
        pbr = trimesh.visual.material.PBRMaterial(
            name=material, baseColorFactor=colour, metallicFactor=0.0, roughnessFactor=ROUGHNESS.get(material, 0.9)
        )
        flat = vertices[faces].reshape(-1, 3)  # unshared corners: flat shading
        mesh = trimesh.Trimesh(
            np.stack([flat[:, 0], flat[:, 2], -flat[:, 1]], axis=1), np.arange(len(flat)).reshape(-1, 3), process=False,
            visual=trimesh.visual.TextureVisuals(material=pbr),
        )  # fmt: skip
        scene.add_geometry(mesh, node_name=material, geom_name=material)
    _write(path, bytes(scene.export(file_type="glb")))


def write_obj(path: Path, actor: Actor) -> int:
    """Write an actor's shape, z up, with its materials beside it; returns its number of triangles.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    lines, materials, count, triangles = [f"mtllib {path.stem}.mtl"], [], 0, 0
    for material, found in _by_material(actor).items():
        red, green, blue = (f"{(channel / 255) ** 2.2:.4f}" for channel in found[0].colour)
        materials.append(
            f"newmtl {material}\nKa {red} {green} {blue}\nKd {red} {green} {blue}\nKs 0 0 0\nd 1\nillum 1\n"
            f"Pr {ROUGHNESS.get(material, 0.9)}\nPm 0\n"
        )
        vertices, faces = _joined(found)
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        lines += ["v {:.4f} {:.4f} {:.4f}".format(*place) for place in corners.reshape(-1, 3)]
        lines += ["vn {:.3f} {:.3f} {:.3f}".format(*normal) for normal in normals]
        lines.append(f"usemtl {material}")
        for k in range(len(faces)):
            first, normal = count + 3 * k + 1, triangles + k + 1
            lines.append(f"f {first}//{normal} {first + 1}//{normal} {first + 2}//{normal}")
        count, triangles = count + 3 * len(faces), triangles + len(faces)
    _write(path, ("\n".join(lines) + "\n").encode())
    _write(path.with_suffix(".mtl"), "".join(materials).encode())
    return triangles


def _by_material(actor: Actor) -> dict[str, list[Part]]:
    found: dict[str, list[Part]] = {}
    for part in parts(actor.track):
        found.setdefault(part.name, []).append(part)
    return found


def _joined(found: list[Part]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *(len(part.vertices) for part in found)])
    faces = [part.faces + start for part, start in zip(found, starts, strict=False)]
    return np.concatenate([part.vertices for part in found]), np.concatenate(faces)


def _write(path: Path, content: bytes) -> None:
    try:
        path.write_bytes(content)
    except OSError as error:
        raise from_os_error(error, path) from None
