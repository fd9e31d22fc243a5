"""Textured meshes as photogrammetry and SLAM programs export them, of a synthetic building with known colours.

`python -m scan2sim.data_samples.mesh_model OUT [--seed 0] [--format obj|glb|ply] [--up z|y] [--unit m|mm]
[--edge 0.15]` writes OUT/mesh.obj with its MTL and images (or mesh.glb; mesh.ply has vertex colours). The colour at a
position is `Paint.at`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from scan2sim.data_samples.building import Building, Style, Surface, build
from scan2sim.pipeline.core.types import F32, F64, I64, U8

PERIOD_M, PIXELS = 4.0, 1024
"""Size of a repeating image on the surface, and its width."""
SOFTNESS_PX = (6, 40)
"""Standard deviations of the blurs that make the pattern."""
NOISE_M = 0.002
"""Standard deviation of the vertices' position."""
TO_FILE = {"z": np.eye(3), "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}
"""World axes to those of the file."""


class Paint(NamedTuple):
    """Repeating images (3, H, W, 3), of surfaces whose normal is along x, y and z."""

    images: U8

    def at(self, xyz: F64, axis: I64) -> F64:
        """Colours (N, 3), 0 to 255, at positions (N, 3) on surfaces with normals along `axis` (N,)."""
        from scipy.ndimage import map_coordinates

        uv = plane(xyz, axis) * PIXELS
        out = np.zeros((len(xyz), 3))
        for k in range(3):
            on = axis == k
            at = [PIXELS - uv[on, 1] - 0.5, uv[on, 0] - 0.5]
            for c in range(3):
                image = self.images[k, ..., c].astype(np.float64)
                out[on, c] = map_coordinates(image, at, order=1, mode="grid-wrap")
        return out


def paint(seed: int) -> Paint:
    """Images of a seed: soft coloured noise and joints every half metre."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng([seed, 7])
    images = []
    for base in ((190, 170, 140), (140, 170, 190), (120, 110, 105)):
        image = np.array(base, np.float64) + np.zeros((PIXELS, PIXELS, 3))
        for softness in SOFTNESS_PX:
            noise = gaussian_filter(rng.normal(size=(PIXELS, PIXELS, 3)), (softness, softness, 0), mode="wrap")
            image += 22 * noise / noise.std()
        joint = np.abs((np.arange(PIXELS) % 128) - 64) > 60
        image[joint] *= 0.6
        image[:, joint] *= 0.6
        images.append(np.clip(gaussian_filter(image, (1.5, 1.5, 0), mode="wrap"), 0, 255).astype(np.uint8))
    return Paint(np.array(images))


def plane(xyz: F64, axis: I64) -> F64:
    """Texture coordinates (N, 2), which repeat, of positions (N, 3) on surfaces with normals along `axis` (N,)."""
    pick = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    return np.asarray(np.take_along_axis(np.asarray(xyz, np.float64), pick, axis=1) / PERIOD_M)


class Sample(NamedTuple):
    """A mesh: positions (V, 3) in metres, z up, without noise and as exported, faces (F, 3), and axis (F,)."""

    exact: F64
    vertices: F64
    faces: I64
    axis: I64
    building: Building


def sample(seed: int, edge: float, style: Style | None = None) -> Sample:
    """The inside of a building with edges up to `edge` metres; surfaces nobody sees inside are left out."""
    import trimesh

    building = build(seed, style)
    mesh = building.mesh.keep(~np.isin(building.surface, (Surface.ROOF, Surface.FOUNDATION)))
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices.astype(np.float64), mesh.faces, edge, max_iter=30)
    _, first, index = np.unique(vertices.round(5), axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[first], index.ravel()[faces]
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    noise = np.random.default_rng([seed, 8]).normal(0, NOISE_M, vertices.shape)
    return Sample(vertices, vertices + noise, faces, np.abs(normal).argmax(axis=1), building)


def write(
    out: Path,
    seed: int = 0,
    *,
    file_format: Literal["obj", "glb", "ply"] = "obj",
    up: Literal["z", "y"] = "z",
    unit: Literal["m", "mm"] = "m",
    edge: float = 0.15,
    style: Style | None = None,
) -> tuple[Path, Sample, Paint]:
    """Write a mesh; returns its path and the truth.

    Args:
        out: folder.
        seed: of building and colours.
        file_format: with images (obj, glb) or with vertex colours (ply).
        up: up axis in the file; glTF is y up.
        unit: of the coordinates in the file; glTF is in metres.
        edge: longest edge, metres.
        style: of the building.
    """
    import cv2
    import trimesh

    made, colours = sample(seed, edge, style), paint(seed)
    out.mkdir(parents=True, exist_ok=True)
    T = TO_FILE["y" if file_format == "glb" else up] * (1000 if unit == "mm" and file_format != "glb" else 1)
    path = out / f"mesh.{file_format}"
    if file_format == "ply":
        per_vertex = np.zeros(len(made.vertices), np.int64)
        per_vertex[made.faces] = made.axis[:, None]
        rgb = colours.at(made.exact, per_vertex).round().astype(np.uint8)
        trimesh.Trimesh(made.vertices @ T.T, made.faces, vertex_colors=rgb, process=False).export(path)
        return path, made, colours
    if file_format == "obj":
        for k in range(3):
            cv2.imwrite(str(out / f"image {k}.png"), colours.images[k][..., ::-1])
        _write_obj(path, made, (made.vertices @ T.T).astype(np.float64))
        return path, made, colours
    from PIL import Image

    scene = trimesh.Scene()
    turn = np.eye(4)
    turn[:3, :3] = TO_FILE["y"]
    for k in range(3):
        faces = made.faces[made.axis == k]
        flat = made.exact[faces].reshape(-1, 3)
        uv = plane(flat, np.full(len(flat), k))
        image = Image.fromarray(colours.images[k])
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
        visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        corners = made.vertices[faces].reshape(-1, 3)
        part = trimesh.Trimesh(corners, np.arange(len(flat)).reshape(-1, 3), visual=visual, process=False)
        scene.add_geometry(part, transform=turn)  # the node's transform makes it y up
    scene.export(path)
    return path, made, colours


def _write_obj(path: Path, made: Sample, vertices: F64 | F32) -> None:
    """OBJ with one material per image."""
    lines = [f"mtllib {path.stem}.mtl"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    body, count = [], 0
    for k in range(3):
        faces = made.faces[made.axis == k]
        flat = made.exact[faces].reshape(-1, 3)
        lines += [f"vt {u:.6f} {v:.6f}" for u, v in plane(flat, np.full(len(flat), k))]
        body.append(f"usemtl surface_{k}")
        index = count + 1 + np.arange(len(flat)).reshape(-1, 3)
        body += [
            f"f {a}/{ta} {b}/{tb} {c}/{tc}"
            for (a, b, c), (ta, tb, tc) in zip((faces + 1).tolist(), index.tolist(), strict=True)
        ]
        count += len(flat)
    path.write_text("\n".join(lines + body) + "\n", encoding="utf-8")
    materials = [f"newmtl surface_{k}\nKd 1 1 1\nmap_Kd image {k}.png\n" for k in range(3)]
    path.with_suffix(".mtl").write_text("\n".join(materials), encoding="utf-8")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", choices=("obj", "glb", "ply"), default="obj")
    parser.add_argument("--up", choices=("z", "y"), default="z")
    parser.add_argument("--unit", choices=("m", "mm"), default="m")
    parser.add_argument("--edge", type=float, default=0.15)
    args = parser.parse_args()
    write(args.out, args.seed, file_format=args.format, up=args.up, unit=args.unit, edge=args.edge)


if __name__ == "__main__":
    main()
