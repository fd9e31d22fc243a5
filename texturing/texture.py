"""Texture: every triangle painted from several photos, warped to its place on the page (D3.2, section 4.2).

Low frequencies are blended from all candidates of a face, weighted by distance (nearer counts more) and angle;
what is finer comes from the one chosen photo, faded into its neighbour's over the triangles along a seam. Colour
is a function of the place on the surface alone, so charts meet without seams. What no photo saw is coloured from
the cloud's points; where they don't tell either, the ground goes on in its pattern (`plan.py`) and all else takes the
mean colour around; both are marked. Pages are painted in bands of rows and photos read when needed,
so memory is bounded by a band and a few photos.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from scan2sim.pipeline.extras import missing, need
from scan2sim.pipeline.ranges import Cosine, Depth, Device
from scan2sim.pipeline.step import Done, Inputs, Params, Report, Step

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from scan2sim.pipeline.types import F32, I32, U8, Mesh, PointCloud, View
    from scan2sim.texturing.agreement import Agreement
    from scan2sim.texturing.blend import Hides, Laid, Rows
    from scan2sim.texturing.choose import Choice
    from scan2sim.texturing.fill import Colours, Page
    from scan2sim.texturing.photos import Exposures
    from scan2sim.texturing.plan import Plan

NEIGHBOUR_STEP = 8
"""Where points have no colour, every so many seen texels (each way) lend theirs to the unseen ones."""
BAND = 6_000_000
"""Texels of a page that are painted at a time, in whole rows."""

KEPT = 8
"""Depth maps kept in memory."""


class TextureParams(Params):
    """How photos become texture.

    Attributes:
        power: a photo's weight in the low frequencies is (cos(angle) / distance^2) to this.
        band: pixels of a photo; what is coarser is blended from many photos, what is finer from one. 0: no bands,
            the chosen photo gives all; -1: all photos give all (a plain blend).
        fade: let photos fade into each other over the triangles along a seam.
        min_cos: of the angle between surface normal and ray, below which a photo is not used.
        bias: metres that a surface may lie behind what the depth map shows and still count as seen.
        feather: share of a photo's width over which its weight fades towards its border.
        padding: texels that colours are carried on outside of charts, for mip-maps.
        continued: where neither photo nor coloured point tells anything, the surface goes on as around, patterns kept;
            for what lies flat, as the ground does.
        device: what paints: "numba" the processors, "cuda" (or another device of torch) a GPU, to within one grey
            level the same; "auto": a GPU where torch and one are there.
    """

    power: float = Field(1.5, ge=0.01, le=20)
    band: int = Field(2, ge=-1, le=64)
    fade: bool = True
    min_cos: Cosine = 0.02
    bias: Depth = 0.04
    feather: float = Field(0.04, ge=0.0001, le=0.5)
    padding: int = Field(16, ge=2, le=256)
    continued: bool = False
    device: Device = "auto"


def texture(inputs: Inputs, params: TextureParams, out: Path, report: Report) -> Done:
    """Paint the pages of an unwrapped mesh.

    Inputs: `mesh` (with uv and page), `pages` (their sizes), `choice`, `views`, `depth` (folder of a depth map for
    every view), `exposures`, `agreement`, `cloud.*` (coloured points; that of the classes left out, `cloud.rest`,
    lends no colours), `made.*` (points that were made up, if any), `things` (GeoJSON of those
    that were taken out, if any).
    File: `textured`, a folder with `mesh.npz`, `page_<i>.png` and `page_<i>_seen.png` (255 seen by a photo,
    128 coloured from points, 64 filled from neighbours or by class, 0 no surface).
    """
    import numpy as np

    from scan2sim.pipeline.io import views as views_io
    from scan2sim.pipeline.types import Mesh
    from scan2sim.texturing import fill
    from scan2sim.texturing.agreement import Agreement
    from scan2sim.texturing.choose import Choice
    from scan2sim.texturing.photos import Exposures

    folder = out / "textured"
    folder.mkdir()
    mesh = Mesh.load(inputs["mesh"])
    mesh.save(folder / "mesh.npz")
    if not len(mesh):
        return Done({"textured": folder}, {"area_m2": 0.0, "seen_m2": 0.0, "coverage": 0.0, "pages": 0})
    assert mesh.page is not None
    sizes = json.loads(inputs["pages"].read_text(encoding="utf-8"))
    views = views_io.load(inputs["views"])
    painter = Painter(
        mesh, views, Choice.load(inputs["choice"]), lambda i: inputs["depth"] / f"{i}.npy",
        Exposures.load(inputs["exposures"]), Agreement.load(inputs["agreement"]), params,
    )  # fmt: skip
    plan = _plan(mesh, sizes, inputs) if params.continued else None
    (colours, own), made = _colours_of(inputs, plan), _made_colours(inputs)
    texels = np.zeros((len(mesh), 4), np.int64)
    writer = Writer()
    for k, size in enumerate(sizes):
        faces = np.flatnonzero(mesh.page == k)
        page = painter.paint(
            faces, size["width"], size["height"],
            lambda f, m="", k=k: report((k + f) / len(sizes), f"page {k + 1} of {len(sizes)} {m}"),
        )  # fmt: skip
        if plan is not None:
            plan.clear(page)
        texels[faces] = _filled(page, faces, mesh, colours, None if own else made)
        if plan is not None:
            plan.add(page)
        waits = plan is not None and bool(texels[faces, 3].any())
        if not waits:
            fill.pad(page.rgb, page.seen, params.padding)
        writer.write(folder / f"page_{k}", page, compression=0 if waits else 2)
        del page
    writer.finish()
    if plan is not None and texels[:, 3].any():
        report(1.0, "ground goes on")
        _go_on(plan, folder, mesh, texels[:, 3] > 0, params)
    skipped = sorted(painter.photos.skipped.values())
    warnings = [f"{reason}: not used for texture, other photos stand in" for reason in skipped]
    return Done({"textured": folder}, _facts(mesh, texels, sizes, painter), warnings)


def _plan(mesh: Mesh, sizes: Sequence[dict[str, int]], inputs: Inputs) -> Plan:
    """The picture from above of an unwrapped mesh, with the classes of the ground's points."""
    from scan2sim.pipeline.remains import outlines
    from scan2sim.pipeline.types import PointCloud
    from scan2sim.texturing.plan import Plan

    cloud = PointCloud.load(inputs["cloud.terrain"])
    stood = outlines(inputs["things"], mesh.frame) if "things" in inputs else []
    return Plan(mesh, _texel(mesh, sizes), cloud.xyz, _labels(cloud), stood)


def _texel(mesh: Mesh, sizes: Sequence[dict[str, int]]) -> float:
    """Metres that a texel spans where they are fine: of the first quarter of the faces."""
    import numpy as np

    assert mesh.uv is not None and mesh.page is not None
    pixels = np.array([size["width"] * size["height"] for size in sizes], np.float64)[mesh.page]
    u, v = mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]
    texels = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2 * pixels
    return float(np.percentile(np.sqrt(mesh.face_area / np.maximum(texels, 1e-9)), 25))


def _go_on(plan: Plan, folder: Path, mesh: Mesh, wanting: npt.NDArray[np.bool_], params: TextureParams) -> None:
    """Paint the pages of the faces that are `wanting` (F,), where the ground goes on, and pad their charts."""
    import numpy as np

    from scan2sim.pipeline.io import image
    from scan2sim.texturing import blend, fill

    ground = plan.go_on()
    assert mesh.page is not None and mesh.uv is not None
    writer = Writer()
    for k in np.unique(mesh.page[wanting]).tolist():
        faces, path = np.flatnonzero(mesh.page == k), folder / f"page_{k}"
        rgb, seen = (
            image.read_rgb(path.with_name(f"{path.name}.png")),
            image.read_levels(path.with_name(f"{path.name}_seen.png")),
        )
        assert rgb is not None and seen is not None  # both have just been written
        flat = blend.texels(mesh.uv[faces], seen.shape[1], seen.shape[0])
        page = fill.Page(rgb, seen, blend.owners(flat, seen.shape[1], seen.shape[0]), flat, mesh.corners[faces])
        if ground is not None:
            ground.paint(page)
        fill.pad(page.rgb, page.seen, params.padding)
        writer.write(path, page)
    writer.finish()


class Writer:
    """Writes a page while the next one is painted: one at a time, so that memory holds two pages at most."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1)
        self._last: Future[None] | None = None

    def write(self, path: Path, page: Page, compression: int = 2) -> None:
        """Begin `path`.png and `path`_seen.png, once the page before is written."""
        self.finish()
        self._last = self._pool.submit(_write, path, page.rgb, page.seen, compression)

    def finish(self) -> None:
        """Wait; raises what went wrong."""
        if self._last is not None:
            self._last.result()


def _write(path: Path, rgb: U8, seen: U8, compression: int) -> None:
    from scan2sim.pipeline.io import image

    image.write(path.with_name(f"{path.name}.png"), rgb, compression=compression)
    image.write(path.with_name(f"{path.name}_seen.png"), seen, compression=min(1, compression))


class Painter:
    """Photos onto pages, band by band.

    Args:
        mesh: with uv and page.
        views: all, by index.
        choice: the photos of every face of the mesh.
        depth_file: index of a view to the file of its depth map.
        exposures: of the photos.
        agreement: where photos may be used, and how they are displaced.
        params: of the step.

    Attributes:
        used: index of a view to the number of texels that it contributed to.
        photos: the source of photos, which knows those that can't be read.
    """

    def __init__(
        self,
        mesh: Mesh,
        views: Sequence[View],
        choice: Choice,
        depth_file: Callable[[int], Path],
        exposures: Exposures,
        agreement: Agreement,
        params: TextureParams,
    ) -> None:
        import numpy as np

        from scan2sim.pipeline.classes import CODE
        from scan2sim.texturing.photos import Photos

        self._mesh, self._views, self._params = mesh, views, params
        self._corners, self._normals = mesh.corners, mesh.face_normal
        self._choice, self._depth_file, self._exposures = choice, depth_file, exposures
        self._mask, self._warp = agreement.mask, agreement.warp
        self._share = shares(mesh.faces, choice.label, len(mesh.vertices), len(views))
        label = mesh.label
        self._sign = np.zeros(len(mesh), bool) if label is None else label == CODE["road_sign"]
        self._backwards, self._device = True, params.device if params.device != "auto" else best_device()
        self._hides = lru_cache(maxsize=KEPT)(self._read_hides)
        self.photos = Photos(views, max(1, params.band))
        self.used: dict[int, int] = {}

    def paint(self, faces: npt.NDArray[np.int64], width: int, height: int, report: Report) -> Page:
        """A page painted from photos alone; texels that none saw stay black and unmarked.

        Args:
            faces: (N,) those on the page.
            width, height: of the page, texels.
            report: progress.
        """
        import numpy as np

        from scan2sim.texturing import blend
        from scan2sim.texturing.fill import Page

        assert self._mesh.uv is not None
        flat = blend.texels(self._mesh.uv[faces], width, height)
        owner = blend.owners(flat, width, height)
        page = Page(
            np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8), owner, flat,
            self._corners[faces],
        )  # fmt: skip
        low, high = flat[..., 1].min(axis=1), flat[..., 1].max(axis=1)
        band = max(1, BAND // width)
        for first in range(0, height, band):
            report(first / height)
            rows = slice(first, min(height, first + band))
            here = np.flatnonzero((high >= rows.start) & (low <= rows.stop))
            if len(here):
                self._paint_rows(page, rows, here, faces)
        return page

    def _paint_rows(self, page: Page, rows: slice, here: npt.NDArray[np.int64], faces: npt.NDArray[np.int64]) -> None:
        """Paint the rows of a page; `here` are its faces (indices into `faces`) that reach into them."""
        import numpy as np

        from scan2sim.texturing.blend import Laid

        flat = page.flat - np.array([0, rows.start], np.float32)
        band = self._rows(Laid(page.owner[rows], flat, page.corners, self._normals[faces]))
        candidates = self._choice.view[faces[here]]
        order = np.unique(candidates[candidates >= 0]).tolist()
        self._backwards = not self._backwards  # what the last rows read last is still in memory
        for i in reversed(order) if self._backwards else order:
            mine = here[(candidates == i).any(axis=1)]
            texels = self._look(i, band, mine, faces[mine])
            if texels:
                self.used[i] = self.used.get(i, 0) + texels
        band.resolve(page.rgb[rows], page.seen[rows])

    def _rows(self, laid: Laid) -> Rows:
        """What paints, on this machine's GPU or its processors."""
        if self._device == "numba":
            from scan2sim.texturing.blend import NumbaRows

            return NumbaRows(laid)
        from scan2sim.texturing.blend_torch import TorchRows

        return TorchRows(laid, self._device)

    def _look(self, i: int, rows: Rows, mine: npt.NDArray[np.int64], faces: npt.NDArray[np.int64]) -> int:
        """Add what photo `i` says of the page's faces `mine`, the mesh's `faces`; returns the texels it sees."""
        import numpy as np

        from scan2sim.pipeline.looking import eye
        from scan2sim.texturing.blend import Look, Shown, Weighing

        photo = self.photos.get(i)
        if photo is None:
            return 0
        p, view = self._params, self._views[i]
        share = self._share(i)[self._mesh.faces[faces]] if p.fade else self._alone(i, faces)
        share[self._sign[faces]] = 1.0  # photos of a plate have been chosen to agree: all give its detail
        shown = Shown(*photo.levels, photo.low, self._mask(i, view), self._warp(i), self._exposures.of(view))
        look = Look(shown, eye(view.camera, view.T_world_cam), self._hides(i))
        weighing = Weighing(p.bias, p.power, p.feather * view.camera.width, p.min_cos, p.band)
        return rows.add(mine, np.ascontiguousarray(share, np.float32), look, weighing)

    def name(self, i: int) -> str:
        """Of view `i`."""
        return self._views[i].name

    def _alone(self, i: int, faces: npt.NDArray[np.int64]) -> F32:
        import numpy as np

        return np.repeat((self._choice.label[faces] == i).astype(np.float32)[:, None], 3, axis=1)

    def _read_hides(self, i: int) -> Hides:
        """A view's depth map, and the least ranges around its pixels."""
        import cv2
        import numpy as np

        from scan2sim.pipeline.visibility import load_depth_map
        from scan2sim.texturing.blend import Hides

        view, band = self._views[i], self._params.band
        depth = load_depth_map(self._depth_file(i), view.camera, view.T_world_cam)
        reach = round(band * depth.camera.width / view.camera.width) if band > 0 else 1

        def least(pixels: int) -> F32:
            return np.asarray(cv2.erode(depth.range, np.ones((2 * pixels + 1, 2 * pixels + 1))), np.float32)

        near = least(1)
        return Hides(*depth.ranges, near, near if reach == 1 else least(reach), reach)


def best_device() -> str:
    """The device that "auto" stands for here."""
    if shutil.which("nvidia-smi") is None or missing("torch"):
        return "numba"
    import torch

    return "cuda" if torch.cuda.is_available() else "numba"


def shares(faces: I32, label: I32, vertices: int, views: int) -> Callable[[int], F32]:
    """How much of the detail a view is to give at every vertex: its share of the labelled faces around.

    Returns:
        view index to (V,) float32.
    """
    import numpy as np
    import scipy.sparse as sp

    labelled = np.flatnonzero(label >= 0)
    at, of = faces[labelled].ravel(), np.repeat(label[labelled], 3)
    count = sp.csc_array((np.ones(len(at), np.float32), (at, of)), shape=(vertices, views))
    valence = np.maximum(np.bincount(at, minlength=vertices), 1).astype(np.float32)

    def share(i: int) -> F32:
        out = np.zeros(vertices, np.float32)
        column = slice(count.indptr[i], count.indptr[i + 1])
        out[count.indices[column]] = count.data[column]
        return out / valence

    return share


def _colours_of(inputs: Inputs, plan: Plan | None) -> tuple[Colours | None, bool]:
    """The points' colours, and whether they are their own (else their classes'); None where there are no points.

    What is coloured by points that were made up (`made.*`) is marked as filled. Points lend none where something stood
    on the `plan` that was taken out, or beside it: theirs is its shade, or its own.
    """
    import numpy as np

    from scan2sim.pipeline.types import PointCloud
    from scan2sim.texturing.fill import FILLED, FROM_POINTS, Colours, shaded

    names = sorted(name for name in inputs if name.startswith("cloud") and name != "cloud.rest")
    made = sorted(name for name in inputs if name.startswith("made."))
    clouds = [cloud for name in names + made if len(cloud := PointCloud.load(inputs[name]))]
    if not clouds:
        return None, False
    cloud = PointCloud.join(clouds)
    if cloud.rgb is None:
        return Colours(cloud.xyz, shaded(_labels(cloud), cloud.normal), FILLED), False
    real = np.arange(len(cloud)) < len(cloud) - sum(len(PointCloud.load(inputs[name])) for name in made)
    known = cloud.coloured
    if plan is not None:
        known &= ~plan.beside(cloud.xyz)
    if not known.any():
        return None, False
    return Colours(
        cloud.xyz[known], cloud.rgb[known], np.where(real, FROM_POINTS, FILLED)[known].astype(np.uint8)
    ), True


def _made_colours(inputs: Inputs) -> tuple[F32, U8]:
    """Places (N, 3) and colours (N, 3), their classes', of points that were made up."""
    import numpy as np

    from scan2sim.pipeline.types import PointCloud
    from scan2sim.texturing.fill import shaded

    clouds = [PointCloud.load(inputs[name]) for name in sorted(inputs) if name.startswith("made.")]
    if not clouds:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    cloud = PointCloud.join(clouds)
    return cloud.xyz, shaded(_labels(cloud), cloud.normal)


def _labels(cloud: PointCloud) -> U8:
    import numpy as np

    return np.ones(len(cloud), np.uint8) if cloud.label is None else cloud.label


def _filled(
    page: Page,
    faces: npt.NDArray[np.int64],
    mesh: Mesh,
    colours: Colours | None,
    made: tuple[F32, U8] | None,
) -> npt.NDArray[np.int64]:
    """Fill what no photo saw; returns (N, 4) texels of the faces, as `blend.count`.

    Where points have no colours of their own, texels that photos saw stand in, but for what was made up (`made`).
    """
    import numpy as np

    from scan2sim.texturing import blend, fill

    area = float(mesh.face_area[faces].sum())
    texel = (area / max(1, int((page.owner >= 0).sum()))) ** 0.5
    if made is not None:  # neighbours that a photo saw are nearer the truth than a class's colour
        places, rgb = fill.seen_points(page, NEIGHBOUR_STEP)
        if len(places):
            xyz, colour = np.concatenate([places, made[0]]), np.concatenate([rgb, made[1]])
            colours = fill.Colours(xyz, colour, fill.FILLED)
    if colours is not None:
        fill.fill(page, colours, max(texel, 1e-6))
    else:
        page.seen[(page.owner >= 0) & (page.seen == 0)] = fill.FILLED
        page.rgb[page.seen == fill.FILLED] = 128
    return np.asarray(blend.count(page.owner, page.seen, page.flat))


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
        "texels_by_photo": {painter.name(i): n for i, n in sorted(painter.used.items())},
        "skipped": sorted(painter.photos.skipped.values()),
    }


def can_texture(params: TextureParams) -> None:
    """Refuse a device of torch where torch isn't installed.

    Raises:
        UnavailableError: as said.
    """
    if params.device not in ("auto", "numba"):
        need(f"texture.device {params.device}", "torch")


TEXTURE = Step(
    "texture",
    7,
    texture,
    TextureParams,
    class_defaults={"terrain": {"continued": True}},
    check=can_texture,
    per_class=True,
    memory=(1.2, 3),
)
