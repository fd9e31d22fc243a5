"""Texture: every triangle painted from several photos, warped to its place on the page (D3.2, section 4.2).

Views are weighted by distance (nearer counts more) and angle, and hidden ones left out. What no photo saw
is coloured from the cloud's points and marked so. Pages are painted one after another and photos read when
needed, so memory is bounded by one page and a few photos.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from pipeline.step import Done, Inputs, Params, Report, Step

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from pipeline.types import U8, Mesh, PointCloud, View
    from pipeline.visibility import DepthMap
    from texturing.fill import Colours, Page
    from texturing.select import Choice

CACHE = 300_000_000
"""Bytes of photos kept in memory between uses."""
NEIGHBOUR_STEP = 8
"""Where points have no colour, every so many seen texels (each way) lend theirs to the unseen ones."""


class TextureParams(Params):
    """How photos become texture.

    Attributes:
        views_per_face: photos that a triangle is painted from, at most.
        power: a photo's weight is (cos(angle) / distance^2) to this; 1 blends softly, more is sharper.
        max_distance: metres beyond which a photo is not used.
        min_cos: of the angle between surface normal and ray, below which a photo is not used.
        bias: metres that a surface may lie behind what the depth map shows and still count as seen.
        feather: share of a photo's width over which its weight fades towards its border.
        padding: texels that colours are carried on outside of charts, for mip-maps.
    """

    views_per_face: int = Field(4, ge=1, le=16)
    power: float = Field(3.0, gt=0)
    max_distance: float = Field(40.0, gt=0)
    min_cos: float = Field(0.08, ge=0, lt=1)
    bias: float = Field(0.04, ge=0)
    feather: float = Field(0.04, gt=0, le=0.5)
    padding: int = Field(16, ge=2)


def texture(inputs: Inputs, params: TextureParams, out: Path, report: Report) -> Done:
    """Paint the pages of an unwrapped mesh.

    Inputs: `mesh` (with uv and page), `pages` (their sizes), `views`, `depth` (folder of a depth map for every
    view), `cloud.*` (coloured points; that of the classes left out, `cloud.rest`, lends no colours).
    File: `textured`, a folder with `mesh.npz`, `page_<i>.png` and `page_<i>_seen.png` (255 seen by a photo,
    128 coloured from points, 64 filled from neighbours or by class, 0 no surface).
    """
    import numpy as np

    from pipeline.io import image
    from pipeline.io import views as views_io
    from pipeline.types import Mesh

    folder = out / "textured"
    folder.mkdir()
    mesh = Mesh.load(inputs["mesh"])
    mesh.save(folder / "mesh.npz")
    if not len(mesh):
        return Done({"textured": folder}, {"area_m2": 0.0, "seen_m2": 0.0, "coverage": 0.0, "pages": 0})
    assert mesh.page is not None
    sizes = json.loads(inputs["pages"].read_text(encoding="utf-8"))
    views = views_io.load(inputs["views"])
    painter = Painter(mesh, views, lambda i: inputs["depth"] / f"{i}.npy", params)
    usable = [i for i, held in enumerate(views_io.load_held_out(inputs["views"])) if not held]
    for done, i in enumerate(usable):
        report(0.3 * done / len(usable), views[i].name)
        painter.offer(i)
    colours, own = _colours_of(inputs)
    texels = np.zeros((len(mesh), 4), np.int64)
    for k, size in enumerate(sizes):
        report(0.3 + 0.7 * k / len(sizes), f"page {k + 1} of {len(sizes)}")
        faces = np.flatnonzero(mesh.page == k)
        page = painter.paint(faces, size["width"], size["height"])
        texels[faces] = _finish(page, faces, mesh, colours, own, params)
        image.write(folder / f"page_{k}.png", page.rgb)
        image.write(folder / f"page_{k}_seen.png", page.seen, compression=1)
    warnings = [f"{name}: not used for texture, other photos stand in" for name in painter.skipped.values()]
    return Done({"textured": folder}, _facts(mesh, texels, sizes, painter), warnings)


class Painter:
    """Photos onto pages: the choice of views for all faces, then page by page.

    Args:
        mesh: with uv and page.
        views: all, by index.
        depth_file: index of a view to the file of its depth map.
        params: of the step.

    Attributes:
        used: index of a view to the number of texels that it contributed to.
        skipped: index of a view to the reason why its photo was left out.
    """

    def __init__(
        self, mesh: Mesh, views: Sequence[View], depth_file: Callable[[int], Path], params: TextureParams
    ) -> None:
        from functools import lru_cache

        from texturing.select import Choice

        self._mesh, self._views, self._params = mesh, views, params
        self._corners, self._normals = mesh.corners, mesh.face_normal
        self._depth_file = depth_file
        self._choice: Choice = Choice(self._corners, self._normals, params.views_per_face)
        largest = max((4 * v.camera.width * v.camera.height for v in views), default=1)
        self._photo = lru_cache(maxsize=max(1, CACHE // largest))(self._read)
        self.used: dict[int, int] = {}
        self.skipped: dict[int, str] = {}

    def _depth(self, i: int) -> DepthMap:
        from pipeline.visibility import load_depth_map

        return load_depth_map(self._depth_file(i), self._views[i].camera, self._views[i].T_world_cam)

    def offer(self, i: int) -> None:
        """Let view `i` compete for the faces that it sees; one whose mask can't be read is left out."""
        p, view = self._params, self._views[i]
        mask = None
        if view.mask is not None:
            mask = read_mask(view)
            if mask is None:
                self.skipped[i] = f"{view.mask}, a mask, can't be read or is not of its photo's size"
                return
        self._choice.offer(i, self._depth(i), bias=p.bias, max_distance=p.max_distance, min_cos=p.min_cos, mask=mask)

    def paint(self, faces: npt.NDArray[np.int64], width: int, height: int) -> Page:
        """A page painted from photos alone; texels that none saw stay black and unmarked.

        Args:
            faces: (N,) those on the page.
            width, height: of the page, texels.
        """
        import cv2
        import numpy as np

        from pipeline.cameras import MODEL_ID, parameters, pixel_angle
        from texturing import blend
        from texturing.fill import Page

        assert self._mesh.uv is not None
        p = self._params
        flat = blend.texels(self._mesh.uv[faces], width, height)
        owner = blend.owners(flat, width, height)
        corners, normals = self._corners[faces], self._normals[faces]
        page = Page(np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8), owner, flat, corners)
        users = self._choice.users(faces)
        if users:
            total = np.zeros((height, width, 4), np.float32)
            for i, chosen in users.items():
                photo = self._photo(i)
                if photo is None:
                    continue
                view, depth = self._views[i], self._depth(i)
                near = np.asarray(cv2.erode(depth.range, np.ones((3, 3))))
                T = np.linalg.inv(view.T_world_cam)
                self.used[i] = self.used.get(i, 0) + int(
                    blend.accumulate(
                        total, owner, np.searchsorted(faces, chosen), flat, corners, normals, *photo,
                        MODEL_ID[view.camera.model], parameters(view.camera), depth.range, near,
                        parameters(depth.camera),
                        np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), pixel_angle(depth.camera),
                        p.bias, p.power, p.feather * view.camera.width, p.min_cos,
                    )
                )  # fmt: skip
            blend.resolve(total, page.rgb, page.seen)
        return page

    def _read(self, i: int) -> tuple[tuple[U8, U8, U8], U8] | None:
        """Photo `i`, halved once and twice, and its mask ((0, 0) where it has none); None if it can't be used."""
        import numpy as np

        from pipeline.io import image

        view = self._views[i]
        size = (view.camera.height, view.camera.width)
        whole = image.read_rgb(view.photo)
        if whole is None:
            self.skipped[i] = f"{view.photo} can't be read"
            return None
        if whole.shape[:2] != size:
            self.skipped[i] = f"{view.photo} is {whole.shape[1]} x {whole.shape[0]} pixels, not {size[1]} x {size[0]}"
            return None
        half = _halved(whole)
        mask = read_mask(view) if view.mask is not None else None
        return (whole, half, _halved(half)), (np.zeros((0, 0), np.uint8) if mask is None else mask)


def _halved(image: U8) -> U8:
    import cv2
    import numpy as np

    size = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def read_mask(view: View) -> U8 | None:
    """The view's mask (H, W), 0 where its photo must not be used; None if it can't be read or is of another size."""
    import cv2

    mask: Any = cv2.imread(str(view.mask), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    return mask if mask is not None and mask.shape == (view.camera.height, view.camera.width) else None


def _colours_of(inputs: Inputs) -> tuple[Colours | None, bool]:
    """The points' colours, and whether they are their own (else their classes'); None where there are no points."""
    from pipeline.types import PointCloud
    from texturing.fill import FILLED, FROM_POINTS, Colours, shaded

    clouds = [PointCloud.load(path) for name, path in sorted(inputs.items()) if name.startswith("cloud")]
    rest = [name == "cloud.rest" for name in sorted(inputs) if name.startswith("cloud")]
    clouds = [cloud for cloud, left_out in zip(clouds, rest, strict=True) if len(cloud) and not left_out]
    if not clouds:
        return None, False
    cloud = PointCloud.join(clouds)
    if cloud.rgb is not None:
        return Colours(cloud.xyz, cloud.rgb, FROM_POINTS), True
    return Colours(cloud.xyz, shaded(_labels(cloud), cloud.normal), FILLED), False


def _labels(cloud: PointCloud) -> U8:
    import numpy as np

    return np.ones(len(cloud), np.uint8) if cloud.label is None else cloud.label


def _finish(
    page: Page, faces: npt.NDArray[np.int64], mesh: Mesh, colours: Colours | None, own: bool, params: TextureParams
) -> npt.NDArray[np.int64]:
    """Fill what no photo saw, pad the charts; returns (N, 4) texels of the faces, as `blend.count`."""
    import numpy as np

    from texturing import blend, fill

    area = float(mesh.face_area[faces].sum())
    texel = (area / max(1, int((page.owner >= 0).sum()))) ** 0.5
    if not own:  # neighbours that a photo saw are nearer the truth than a class's colour
        places, rgb = fill.seen_points(page, NEIGHBOUR_STEP)
        colours = fill.Colours(places, rgb, fill.FILLED) if len(places) else colours
    if colours is not None:
        fill.fill(page, colours, max(texel, 1e-6))
    else:
        page.seen[(page.owner >= 0) & (page.seen == 0)] = fill.FILLED
        page.rgb[page.seen == fill.FILLED] = 128
    counts = blend.count(page.owner, page.seen, page.flat)
    fill.pad(page.rgb, page.seen, params.padding)
    return np.asarray(counts)


def _facts(
    mesh: Mesh, texels: npt.NDArray[np.int64], sizes: Sequence[dict[str, int]], painter: Painter
) -> dict[str, Any]:
    """Figures of a texture: areas (m2) by where their colour came from, photos and what each gave."""
    import numpy as np

    area = mesh.face_area.astype(np.float64)
    share = texels[:, 1:] / np.maximum(texels[:, :1], 1)
    drawn = texels[:, 0] > 0  # a face too small for a texel counts neither way
    total = float(area[drawn].sum())
    seen, coloured, filled = (float(v) for v in (area[drawn, None] * share[drawn]).sum(axis=0))
    return {
        "area_m2": round(total, 2),
        "seen_m2": round(seen, 2),
        "coloured_m2": round(coloured, 2),
        "filled_m2": round(filled, 2),
        "coverage": round(seen / total, 4) if total else 0.0,
        "pages": len(sizes),
        "texels": int(texels[:, 0].sum()),
        "photos": len(painter.used),
        "texels_by_photo": {painter._views[i].name: n for i, n in sorted(painter.used.items())},
        "skipped": sorted(painter.skipped.values()),
    }


TEXTURE = Step("texture", 1, texture, TextureParams)
