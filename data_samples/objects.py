"""Meshes of a street's objects, each in its own coordinates (z = 0 is the ground)."""

from __future__ import annotations

import numpy as np

from scan2sim.data_samples import paints, signs
from scan2sim.data_samples.layout import Boundary, House, Tree
from scan2sim.data_samples.paints import RGB, Material, Paint, linear
from scan2sim.data_samples.shapes import Opening, Part, blob, box, join, leaves, part, quads, sheet, tube, wall, waves
from scan2sim.pipeline.core.types import F64

GROUND_STOREY_M, STOREY_M = 3.35, 2.95
FOUNDATION_M = 1.2  # depth of walls below the ground at their origin
STEEL_RGB = linear("#8d9093")
DARK_STEEL_RGB = linear("#3c4245")


def house(plan: House) -> Part:
    """A house: x along its front (0 .. width), y into the plot (0 .. depth); the front faces -y."""
    rng = np.random.default_rng(plan.seed)
    body = Paint(Material.BRICK if plan.brick else Material.PLASTER, plan.colour, paints.BUILDING, plan.seed)
    trim = Paint(Material.PLAIN, plan.trim, paints.BUILDING, plan.seed)
    plinth = (0.55, Paint(Material.STONE, linear("#8f897f"), paints.BUILDING, plan.seed))
    height = eaves(plan)
    front, extras = _front(plan, rng, trim)
    parts = [*extras, wall(plan.width, height, front, body, foot=FOUNDATION_M, plinth=plinth)]
    for width, turn, at in (
        (plan.depth, np.pi / 2, (plan.width, 0, 0)),
        (plan.width, np.pi, (plan.width, plan.depth, 0)),
        (plan.depth, -np.pi / 2, (0, plan.depth, 0)),
    ):
        rows = _windows(plan, width, rng, columns=max(1, int(width / 3.6)))
        parts.append(wall(width, height, rows, body, foot=FOUNDATION_M, plinth=plinth).moved(turn, at))
    parts += _flat_roof(plan, height, trim) if plan.roof == "flat" else _gable_roof(plan, height, body, trim, rng)
    return join(parts)


def eaves(plan: House) -> float:
    """Height of the top of the walls, metres."""
    return GROUND_STOREY_M + (plan.storeys - 1) * STOREY_M + (0.75 if plan.roof == "flat" else 0.15)


def _window_paint(plan: House, rng: np.random.Generator) -> Paint:
    return Paint(Material.WINDOW, tuple(np.array(plan.trim) * 1.05), paints.BUILDING, int(rng.integers(1 << 20)))


def _windows(plan: House, width: float, rng: np.random.Generator, columns: int, first: int = 0) -> list[Opening]:
    pitch = width / columns
    w, h = min(1.15, 0.55 * pitch), 1.5
    openings = []
    for storey in range(first, plan.storeys):
        z = 0.95 + (GROUND_STOREY_M - STOREY_M + storey * STOREY_M if storey else 0.1)
        for c in range(columns):
            x = (c + 0.5) * pitch - w / 2
            openings.append(Opening(x, z, x + w, z + h, _window_paint(plan, rng)))
    return openings


def _front(plan: House, rng: np.random.Generator, trim: Paint) -> tuple[list[Opening], list[Part]]:
    """Openings of the front wall, and meshes protruding from it: sills, surrounds, cornice, sign, downpipe, steps."""
    columns = max(2, int(plan.width / rng.uniform(2.3, 2.9)))
    pitch = plan.width / columns
    upper = _windows(plan, plan.width, rng, columns, first=1)
    door_column = int(rng.integers(columns))
    door_x = (door_column + 0.5) * pitch - 0.525
    door_paint = Paint(Material.DOOR, plan.door, paints.BUILDING, plan.seed)
    door = Opening(door_x, 0.12, door_x + 1.05, 2.45, door_paint)
    parts: list[Part] = [
        box((door_x - 0.15, -0.42, -0.6), (door_x + 1.2, 0.0, 0.12), trim._replace(material=Material.KERB))
    ]
    ground: list[Opening] = []
    if plan.shop is not None:
        pane = Paint(Material.SHOP, plan.door, paints.BUILDING, plan.seed)
        spans = [(0.45, door_x - 0.4), (door_x + 1.45, plan.width - 0.45)]
        spans = [(a, b) for a, b in spans if b - a > 1.0]
        ground = [Opening(a, 0.5, b, 2.55, pane) for a, b in spans]
        a, b = max(spans, key=lambda s: s[1] - s[0])
        middle, half = (a + b) / 2, min((b - a) / 2, 2.1)
        board = Paint(Material.SIGN, (1, 1, 1), paints.BUILDING, signs.FIRST_SHOP + plan.shop)
        x0, x1, z0, z1, y = middle - half, middle + half, 2.68, 2.68 + half * 0.305, -0.10
        parts.append(box((x0, y, z0), (x1, 0.0, z1), Paint(Material.PLAIN, plan.door, paints.BUILDING), bottom=True))
        face = [
            [
                (x0 + 0.01, y - 0.01, z0 + 0.01),
                (x1 - 0.01, y - 0.01, z0 + 0.01),
                (x1 - 0.01, y - 0.01, z1),
                (x0 + 0.01, y - 0.01, z1),
            ]
        ]
        parts.append(quads(face, [[(0, 0), (1, 0), (1, 1), (0, 1)]], board))
    else:
        for o in _windows(plan, plan.width, rng, columns)[:columns]:
            if o.x1 < door_x - 0.15 or o.x0 > door_x + 1.2:
                ground.append(o)
    windows = upper + [o for o in ground if o.paint.material == Material.WINDOW]
    for o in windows:
        parts.append(box((o.x0 - 0.09, -0.10, o.z0 - 0.07), (o.x1 + 0.09, 0.02, o.z0), trim, bottom=True))
    if rng.random() < 0.7:  # surrounds
        for o in [*windows, door]:
            for x in (o.x0 - 0.12, o.x1):
                parts.append(box((x, -0.035, o.z0), (x + 0.12, 0.0, o.z1 + 0.14), trim))
            parts.append(box((o.x0, -0.035, o.z1), (o.x1, 0.0, o.z1 + 0.14), trim, bottom=True))
    top = GROUND_STOREY_M - (0.12 if plan.shop is not None else 0.25)
    if plan.storeys > 1 and (plan.shop is not None or rng.random() < 0.75):
        parts.append(box((0.0, -0.09, top), (plan.width, 0.02, top + 0.16), trim, bottom=True))
    height = eaves(plan)
    parts.append(box((0.0, -0.12, height - 0.24), (plan.width, 0.02, height - 0.06), trim, bottom=True))
    pipe = Paint(Material.PLAIN, linear("#6f7476"), paints.BUILDING)
    x = plan.width - 0.16 if door_column < columns / 2 else 0.16
    parts.append(tube([(x, -0.09, -0.4), (x, -0.09, height - 0.2)], [0.05, 0.05], pipe, sides=8))
    if plan.storeys > 2 and rng.random() < 0.6:
        parts += _balconies(upper, columns, rng, trim)
    return [*upper, *ground, door], parts


def _balconies(upper: list[Opening], columns: int, rng: np.random.Generator, trim: Paint) -> list[Part]:
    iron = Paint(Material.PLAIN, DARK_STEEL_RGB, paints.BUILDING)
    column = int(rng.integers(columns))
    parts = []
    for o in upper[column::columns]:
        x0, x1, z, y = o.x0 - 0.35, o.x1 + 0.35, o.z0 - 0.55, -0.85
        parts.append(box((x0, y, z - 0.14), (x1, 0.0, z), trim, bottom=True))
        parts += [box((x0, y, z + 0.95), (x1, y + 0.04, z + 1.0), iron, bottom=True)]
        parts += [box((x, y, z + 0.95), (x + 0.04, 0.0, z + 1.0), iron, bottom=True) for x in (x0, x1 - 0.04)]
        for x in np.arange(x0, x1, 0.12):
            parts.append(box((x, y + 0.01, z), (x + 0.025, y + 0.035, z + 0.95), iron))
        for v in np.arange(y + 0.12, 0, 0.12):
            parts += [box((x, v, z), (x + 0.025, v + 0.025, z + 0.95), iron) for x in (x0 + 0.01, x1 - 0.035)]
    return parts


def _gable_roof(plan: House, height: float, body: Paint, trim: Paint, rng: np.random.Generator) -> list[Part]:
    """Two slopes with overhang, gables, gutters and a chimney; the ridge along x, or along y for a front gable."""
    across = plan.roof == "front_gable"
    w, d = (plan.depth, plan.width) if across else (plan.width, plan.depth)
    rise = np.tan(plan.pitch) * d / 2
    tiles = Paint(Material.ROOF_TILES, plan.tiles, paints.BUILDING, plan.seed)
    lip, side, thick = 0.35, 0.18, 0.14
    drop = lip * np.tan(plan.pitch)
    slope = (d / 2 + lip) / np.cos(plan.pitch)
    parts = []
    for turn in (False, True):
        # the slope that faces -y; the other one is rotated by half a turn
        a, b = (-side, -lip, height - drop), (w + side, -lip, height - drop)
        c, e = (w + side, d / 2, height + rise), (-side, d / 2, height + rise)
        up = np.array([0, 0, thick])
        top = np.array([a, b, c, e]) + up
        uv = [(0, 0), (w + 2 * side, 0), (w + 2 * side, slope), (0, slope)]
        under = np.array([e, c, b, a])
        rim = np.array([[a, b, b + up, a + up], [b, c, c + up, b + up], [e, a, a + up, e + up]])
        flat = np.array([[(0, 0), (1, 0), (1, 0.1), (0, 0.1)]] * 4)
        one = [quads([top], [uv], tiles), quads(np.concatenate([[under], rim]), flat, trim)]
        gutter = Paint(Material.PLAIN, linear("#777b7c"), paints.BUILDING)
        one.append(
            tube(
                [(-side, -lip - 0.05, height - drop + 0.03), (w + side, -lip - 0.05, height - drop + 0.03)],
                [0.065, 0.065],
                gutter,
                8,
            )
        )
        parts += [p.moved(np.pi, (w, d, 0)) if turn else p for p in one]
    gable = [(0, 0, height), (0, d, height), (0, d / 2, height + rise)]
    for turn in (False, True):
        g = part(gable, [(0, 2, 1)], [(-y, z) for _, y, z in gable], body)
        parts.append(g.moved(np.pi, (w, d, 0)) if turn else g)
    x, y = rng.uniform(0.2, 0.8) * w, d / 2 + 0.8
    z = height + rise
    brick = Paint(Material.BRICK, linear("#8a5242"), paints.BUILDING, plan.seed)
    parts += [box((x - 0.4, y - 0.3, z - 1.6), (x + 0.4, y + 0.3, z + 0.9), brick)]
    parts += [box((x - 0.46, y - 0.36, z + 0.9), (x + 0.46, y + 0.36, z + 1.0), trim, bottom=True)]
    if across:
        return [p.moved(np.pi / 2, (plan.width, 0, 0)) for p in parts]
    return parts


def _flat_roof(plan: House, height: float, trim: Paint) -> list[Part]:
    w, d, z = plan.width, plan.depth, height - 0.45
    gravel = Paint(Material.PLAIN, linear("#8b8880"), paints.BUILDING, plan.seed)
    parts = [quads([[(0, 0, z), (w, 0, z), (w, d, z), (0, d, z)]], [[(0, 0), (w, 0), (w, d), (0, d)]], gravel)]
    a, b, c = -0.06, 0.24, 0.08
    for low, high in (
        ((a, a), (w - a, b)), ((a, d - b), (w - a, d - a)), ((a, b), (b, d - b)), ((w - b, b), (w - a, d - b)),
    ):  # fmt: skip
        parts.append(box((*low, height), (*high, height + c), trim, bottom=True))
        e = 0.01  # inset, to avoid coplanar faces with the walls
        inner = ((max(low[0], e), max(low[1], e), z), (min(high[0], w - e), min(high[1], d - e), height))
        parts.append(box(*inner, trim))
    return parts


def tree(plan: Tree) -> Part:
    """A tree: trunk and branches, a crown of bumpy blobs covered with leaves."""
    rng = np.random.default_rng(plan.seed)
    bark = Paint(Material.BARK, linear("#6f5d4b"), paints.TREE, plan.seed)
    clear = max(2.1, 0.34 * plan.height)
    crown = np.array([*rng.normal(0, 0.12, 2), (clear + plan.height) / 2])
    spread = np.array([plan.radius, plan.radius, (plan.height - clear) / 2])
    r = 0.035 * plan.height * 0.62
    bend = rng.normal(0, 0.08, 2)
    trunk = [(0, 0, -0.4), (0, 0, 0), (*bend, clear * 0.55), (*(crown[:2] * 0.8), clear), (*crown[:2], crown[2])]
    parts = [tube(trunk, np.array([1.5, 1.25, 0.95, 0.85, 0.4]) * r, bark, sides=12)]
    count = 14
    direction = _scattered(count, rng)
    centres = crown + direction * spread * rng.uniform(0.42, 0.82, (count, 1))
    centres = np.concatenate([centres, [crown]])
    radii = np.append(rng.uniform(0.30, 0.50, count), 0.62) * spread.min()
    for centre in centres[:count:2]:
        fork = np.array([*crown[:2], clear + 0.1 * plan.height])
        parts.append(
            tube([fork, (fork + centre) / 2 + [0, 0, -0.05], centre], np.array([0.45, 0.3, 0.15]) * r, bark, sides=7)
        )
    return join([*parts, *_foliage(centres, radii, crown, spread, plan, paints.TREE, rng, leaf=0.205, per_m2=62)])


def bush(plan: Tree) -> Part:
    """A shrub: a few blobs on the ground, covered with leaves."""
    rng = np.random.default_rng(plan.seed)
    count = 5
    centres = np.column_stack(
        [rng.normal(0, 0.4 * plan.radius, (count, 2)), rng.uniform(0.35, 0.75, count) * plan.radius]
    )
    radii = rng.uniform(0.5, 0.72, count) * plan.radius
    middle = np.array([0, 0, 0.5 * plan.radius])
    return join(
        _foliage(centres, radii, middle, np.full(3, plan.radius), plan, paints.BUSH, rng, leaf=0.115, per_m2=130)
    )


def _foliage(
    centres: F64,
    radii: F64,
    middle: F64,
    spread: F64,
    plan: Tree,
    classification: int,
    rng: np.random.Generator,
    leaf: float,
    per_m2: float,
) -> list[Part]:
    """Dark blobs, and leaves on their surface where it isn't inside another blob."""
    inner = Paint(Material.FOLIAGE, tuple(0.75 * np.array(plan.colour)), classification, plan.seed)
    parts, points, outward = [], [], []
    for i, (centre, radius) in enumerate(zip(centres, radii, strict=True)):
        parts.append(
            blob(
                centre,
                0.86 * radius,
                rng,
                inner,
                bump=0.16,
                wavelength=max(0.5 * radius, 0.15),
                rounds=2,
                shade=(0.18, 0.42),
            )
        )
        n = int(4 * np.pi * radius**2 * per_m2)
        direction = _scattered(n, rng)
        skin = centre + direction * radius * rng.triangular(0.82, 0.95, 1.32, (n, 1))
        deep = np.zeros(n, bool)
        for j, (other, r) in enumerate(zip(centres, radii, strict=True)):
            if j != i:
                deep |= np.linalg.norm(skin - other, axis=1) < 0.84 * r
        deep |= skin[:, 2] < 0.03
        points.append(skin[~deep])
        outward.append(direction[~deep])
    at, away = np.concatenate(points), np.concatenate(outward)
    from_middle = (at - middle) / spread
    reach = np.linalg.norm(from_middle, axis=1)
    away = away + from_middle / np.maximum(reach, 1e-6)[:, None]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    sky = np.clip(0.22 + 0.5 * reach**2, 0, 0.95) * (0.78 + 0.22 * away[:, 2])
    parts.append(leaves(at, away, sky, rng, Paint(Material.FOLIAGE, plan.colour, classification, plan.seed), leaf))
    return parts


def _scattered(n: int, rng: np.random.Generator) -> F64:
    """(n, 3) unit vectors, evenly distributed and jittered."""
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / max(n, 1)
    angle = np.pi * (1 + 5**0.5) * k + rng.uniform(0, 6)
    r = np.sqrt(1 - z * z)
    v = np.column_stack([r * np.cos(angle), r * np.sin(angle), z]) + rng.normal(0, 0.6 / np.sqrt(max(n, 1)), (n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def boundary(plan: Boundary, length: float) -> Part:
    """Border of a garden, `length` metres along x, its outside towards -y: hedge, wall or fence."""
    rng = np.random.default_rng(plan.seed)
    if plan.kind == "hedge":
        return _hedge(plan, length, rng)
    if plan.kind == "brick_wall":
        brick = Paint(Material.BRICK, plan.colour, paints.WALL, plan.seed)
        cap = Paint(Material.KERB, linear("#b5aea1"), paints.WALL, plan.seed)
        h = 0.75 + 0.5 * rng.random()
        parts = [
            box((0, -0.12, -0.8), (length, 0.12, h), brick),
            box((-0.03, -0.17, h), (length + 0.03, 0.17, h + 0.07), cap, bottom=True),
        ]
        for x in (0.0, length):
            parts += [box((x - 0.19, -0.19, -0.8), (x + 0.19, 0.19, h + 0.22), brick)]
            parts += [box((x - 0.23, -0.23, h + 0.22), (x + 0.23, 0.23, h + 0.30), cap, bottom=True)]
        return join(parts)
    if plan.kind == "picket_fence":
        wood = Paint(Material.WOOD, plan.colour, paints.WALL, plan.seed)
        parts = [box((0, 0.0, z), (length, 0.04, z + 0.08), wood, bottom=True) for z in (0.28, 0.78)]
        for i, x in enumerate(np.arange(0.02, length - 0.07, 0.135)):
            parts.append(_picket(x, wood._replace(seed=plan.seed + i)))
        for x in np.append(np.arange(0, length, 2.0), length - 0.1):
            parts.append(box((x, 0.02, -0.6), (x + 0.1, 0.12, 1.12), wood))
        return join(parts)
    iron = Paint(Material.PLAIN, tuple(0.6 * np.array(plan.colour)), paints.WALL, plan.seed)
    stone = Paint(Material.STONE, linear("#9c958a"), paints.WALL, plan.seed)
    parts = [box((0, -0.14, -0.8), (length, 0.14, 0.35), stone)]
    parts += [box((0, -0.02, z), (length, 0.02, z + 0.04), iron, bottom=True) for z in (0.48, 1.15)]
    parts += [box((x, -0.013, 0.35), (x + 0.026, 0.013, 1.32), iron) for x in np.arange(0.06, length, 0.13)]
    return join(parts)


def _picket(x: float, wood: Paint) -> Part:
    """A pointed board of a picket fence."""
    y, w, h, tip = -0.025, 0.085, 0.98, 1.06
    outline = [(x, 0.06), (x + w, 0.06), (x + w, h), (x + w / 2, tip), (x, h)]
    front = np.array([(a, y, b) for a, b in outline])
    back = front + np.array([0, 0.022, 0])
    fan = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4)])
    i = np.arange(5)
    rim = np.stack([front, back, np.roll(back, -1, axis=0), np.roll(front, -1, axis=0)], axis=1)[i]
    flat = front[:, [0, 2]]
    return join(
        [part(front, fan, flat, wood), part(back, fan[:, ::-1], flat, wood), quads(rim, rim[..., [0, 2]], wood)]
    )


def _hedge(plan: Boundary, length: float, rng: np.random.Generator) -> Part:
    """A clipped hedge: a bumpy bar covered with small leaves."""
    h, half = rng.uniform(0.8, 1.25), 0.27
    profile = np.array(
        [(-half, -0.3), (-half, 0.0), *((-half, z) for z in np.linspace(0.15, h - 0.15, 6)), (-half + 0.08, h - 0.03),
         (0, h), (half - 0.08, h - 0.03),
         *((half, z) for z in np.linspace(h - 0.15, 0.15, 6)), (half, 0.0), (half, -0.3)]
    )  # fmt: skip
    x = np.linspace(0, length, max(2, int(length / 0.14)))
    xyz = np.empty((len(profile), len(x), 3))
    xyz[..., 0], xyz[..., 1], xyz[..., 2] = x, profile[:, :1], profile[:, 1:]
    wobble = waves(rng, 0.4)(xyz)[..., None]
    xyz[..., 1:] += wobble * 0.035 * np.sign(np.array([profile[:, 0], profile[:, 1] - 0.3]).T)[:, None]
    inner = Paint(Material.FOLIAGE, tuple(0.7 * np.array(plan.colour)), paints.BUSH, plan.seed)
    side = sheet(xyz, np.stack([xyz[..., 0], xyz[..., 1] + xyz[..., 2]], axis=-1), inner)
    parts = [side]
    for end, way in ((0, 1), (-1, -1)):
        ring = xyz[:, end]
        fan = np.column_stack([np.zeros(len(ring) - 2), np.arange(1, len(ring) - 1), np.arange(2, len(ring))]).astype(
            int
        )
        parts.append(part(ring, fan[:, ::way], ring[:, 1:], inner))
    n = int(length * 2 * (h + half) * 150)
    a, b = rng.uniform(0, 1, n) * (len(profile) - 3) + 1, rng.uniform(0, length, n)
    i = a.astype(int)
    f = (a - i)[:, None]
    at = profile[i] * (1 - f) + profile[i + 1] * f
    edge = profile[i + 1] - profile[i]
    away = np.column_stack([np.zeros(n), -edge[:, 1], edge[:, 0]])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    points = np.column_stack([b, at]) + away * rng.uniform(-0.02, 0.07, (n, 1))
    for x_end, away_x in ((0.0, -1.0), (length, 1.0)):
        m = int(2 * half * h * 150)
        flat = np.column_stack(
            [x_end + away_x * rng.uniform(-0.02, 0.06, m), rng.uniform(-half, half, m), rng.uniform(0, h, m)]
        )
        points, away = np.concatenate([points, flat]), np.concatenate([away, np.tile([away_x, 0.0, 0.0], (m, 1))])
    sky = np.clip(0.3 + 0.45 * points[:, 2] / h, 0, 0.85)
    paint = Paint(Material.FOLIAGE, plan.colour, paints.BUSH, plan.seed)
    return join([*parts, leaves(points, away, sky, rng, paint, 0.115)])


def lamp() -> Part:
    """A street lamp, its arm towards +y."""
    steel = Paint(Material.PLAIN, linear("#59615f"), paints.POLE, 5)
    pole = [(0, 0, -0.4), (0, 0, 1.0), (0, 0, 1.05), (0, 0, 5.6), (0, 0.25, 6.1), (0, 0.75, 6.32), (0, 1.25, 6.36)]
    glass = Paint(Material.PLAIN, linear("#e8e4d4"), paints.POLE, 6)
    return join([
        tube(pole, [0.10, 0.10, 0.065, 0.05, 0.045, 0.04, 0.04], steel, 12),
        box((-0.11, 1.15, 6.33), (0.11, 1.75, 6.44), steel, bottom=True),
        box((-0.08, 1.22, 6.30), (0.08, 1.70, 6.335), glass, bottom=True),
    ])  # fmt: skip


def sign(index: int) -> Part:
    """A traffic sign on a pole, facing -y; `index`: into `signs.NAMES`."""
    steel = Paint(Material.PLAIN, STEEL_RGB, paints.POLE, 9)
    face = Paint(Material.SIGN, (1, 1, 1), paints.SIGN, index)
    grey = Paint(Material.PLAIN, linear("#a0a3a5"), paints.SIGN, 3)
    kind = signs.SHAPES.get(signs.NAMES[index], "square")
    angles = {
        "square": np.array([45, 135, 225, 315]), "triangle": np.array([30, 150, 270]),
        "diamond": np.array([0, 90, 180, 270]),
        "octagon": np.arange(8) * 45 + 22.5, "round": np.arange(28) * 360 / 28,
    }[kind]  # fmt: skip
    radius = {"square": 0.5**0.5, "triangle": 0.577, "diamond": 0.5, "octagon": 0.541, "round": 0.5}[kind]
    flat = radius * np.column_stack([np.cos(np.radians(angles)), np.sin(np.radians(angles))])
    half, z, y = 0.36, 2.45, -0.055
    middle = {"triangle": 0.62}.get(kind, 0.5)
    xyz = np.column_stack([2 * half * flat[:, 0], np.full(len(flat), y), z + 2 * half * flat[:, 1]])
    n = len(flat)
    fan = np.column_stack([np.zeros(n - 2), np.arange(1, n - 1), np.arange(2, n)]).astype(int)
    back = xyz + np.array([0, 0.02, 0])
    rim = np.stack([xyz, np.roll(xyz, -1, axis=0), np.roll(back, -1, axis=0), back], axis=1)[:, ::-1]
    return join([
        tube([(0, 0, -0.4), (0, 0, z + 0.3)], [0.032, 0.032], steel, 10),
        part(xyz, fan, flat + np.array([0.5, middle]), face),
        part(back, fan[:, ::-1], flat, grey),
        quads(rim, rim[..., [0, 2]], grey),
    ])  # fmt: skip


CAR_LENGTH_M = 4.36


def car(colour: RGB) -> Part:
    """A car, x forwards, y to the left: a loft for body and cabin, and four wheels."""
    x = np.unique(np.concatenate([np.linspace(-2.18, 2.18, 45), [0.98, 0.28, -1.05, -1.72]]))
    top = np.interp(
        x, [-2.18, -2.12, -1.95, -1.72, -1.05, -0.5, 0.0, 0.28, 0.98, 1.3, 1.8, 2.05, 2.15, 2.18],
        [0.80, 0.92, 0.97, 1.00, 1.38, 1.44, 1.44, 1.40, 0.96, 0.93, 0.85, 0.79, 0.76, 0.72],
    )  # fmt: skip
    low = np.interp(x, [-2.18, -1.9, -1.6, 1.7, 2.0, 2.18], [0.36, 0.28, 0.22, 0.22, 0.26, 0.34])
    half = 0.87 - 0.16 * np.clip((np.abs(x) - 1.75) / 0.43, 0, 1) ** 2
    belt = np.minimum(top - 0.03, np.interp(x, [-2.2, 1.0, 2.2], [0.93, 0.90, 0.5]))
    cabin = np.clip((top - belt) / 0.5, 0, 1)
    roof = half * 0.94 - 0.20 * cabin
    ring = np.stack([  # right half of the cross section, from the bottom up: (y, z) per station
        np.stack([0 * x, low], axis=1), np.stack([0.93 * half, low], axis=1),
        np.stack([half, low * 0.4 + 0.36], axis=1),
        np.stack([half, np.minimum(0.66, belt - 0.02)], axis=1), np.stack([0.965 * half, belt], axis=1),
        np.stack([roof, top - 0.025 - 0.03 * cabin], axis=1), np.stack([roof * 0.82, top], axis=1),
        np.stack([0 * x, top + 0.02 * cabin], axis=1),
    ], axis=0)  # fmt: skip
    loop = np.concatenate([ring * [-1, 1], ring[-2:0:-1]])  # whole outline, counter-clockwise seen from the front
    k, n = len(loop), len(x)
    xyz = np.empty((k + 1, n, 3))
    xyz[:k, :, 0], xyz[:k, :, 1:] = x, loop
    xyz[k] = xyz[0]
    index = np.arange((k + 1) * n).reshape(k + 1, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    flat = xyz.reshape(-1, 3)
    body = part(flat, faces, flat[:, [0, 2]], Paint(Material.CAR_BODY, colour, paints.VEHICLE, 1))
    row = np.repeat(np.arange(k), 2 * (n - 1))
    row = np.minimum(row, k - 1 - row)  # symmetric
    middle = flat[faces].mean(axis=1)
    side_glass = (row == 4) & (middle[:, 0] < 0.9) & (middle[:, 0] > -1.62) & (np.interp(middle[:, 0], x, cabin) > 0.12)
    slanted = ((middle[:, 0] > 0.30) & (middle[:, 0] < 0.96)) | ((middle[:, 0] < -1.07) & (middle[:, 0] > -1.70))
    shield = (row == 6) & slanted
    material, size = body.material.copy(), body.size.copy()
    material[side_glass | shield] = Material.CAR_GLASS
    size[side_glass, 1], size[shield, 1] = 0.0, 1.0
    on_top = (row >= 5) & ~shield
    material[on_top] = Material.PLAIN
    body = Part(**{**body.__dict__, "material": material, "size": size})
    ends = []
    for e, way, front in ((0, -1, -1.0), (n - 1, 1, 1.0)):
        outline = xyz[:k, e]
        fan = np.column_stack([np.zeros(k - 2), np.arange(1, k - 1), np.arange(2, k)]).astype(int)
        ends.append(
            part(
                outline,
                fan[:, ::way],
                outline[:, 1:],
                Paint(Material.CAR_END, colour, paints.VEHICLE, 2),
                size=(front, 1),
            )
        )
    parts = [body, *ends]
    tyre = Paint(Material.WHEEL, (0.02, 0.02, 0.02), paints.VEHICLE)
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    disc = np.column_stack([np.cos(angle), np.sin(angle)]) * 0.32
    for cx in (-1.32, 1.36):
        for side in (-1, 1):
            outer = np.column_stack([cx + disc[:, 0], np.full(24, side * 0.885), 0.32 + disc[:, 1]])
            inner = outer - [0, side * 0.2, 0]
            fan = np.column_stack([np.zeros(22), np.arange(1, 23), np.arange(2, 24)]).astype(int)
            parts.append(part(outer, fan[:, ::-side], disc, tyre))
            tread = np.stack([outer, np.roll(outer, -1, axis=0), np.roll(inner, -1, axis=0), inner], axis=1)[:, ::side]
            parts.append(quads(tread, np.full((24, 4, 2), 0.3), tyre))
    return join(parts)
