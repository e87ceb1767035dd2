"""Is the rendered camera the fitted one? Joints are rendered, found again, and compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from autoreg.lattice import Lattice
from autoreg.layout import slab_sides
from autoreg.rendering.depth_of_field import Focus, blur_px
from autoreg.rendering.engine import Engine, Plan
from autoreg.rendering.lens import bend, straight_window
from autoreg.view import View, Window

# Marks are this wide in the picture: enough that every pixel they touch has a corner in them, which is
# what adaptive anti-aliasing looks at.
_WIDTH_PX = 3.0
# Shortest slab side to mark, and nearest that another mark may come.
_SHORTEST_PX = 14.0
# Half length of a stripe, unless the slab side is too short for it.
_HALF_LENGTH_PX = 10.0
# Half length of the line of pixels that is read across a mark.
_REACH_PX = 5
# One mark per family and cell of a grid over the picture.
_CELLS = (16, 12)
# A stripe that the lens blurs more than this would not fit into the line that is read.
_MOST_BLUR_PX = 3.0
# The marked picture is rendered smaller than the photo if it has more pixels than this.
_MOST_PIXELS = 4e6


@dataclass(frozen=True)
class RenderCheck:
    """Distance between joints in the rendered layer and where the camera model puts them."""

    rms_px: float
    max_px: float
    samples: int


@dataclass(frozen=True)
class Marks:
    """Short stripes on joints, each read across at several columns or rows of pixels near its middle.

    `edges_px` holds points along each of its two long edges.
    """

    ground: Float[np.ndarray, "n 4 2"]
    edges_px: Float[np.ndarray, "n 2 m 2"]
    middle_px: Float[np.ndarray, "n 2"]


def check_render(engine: Engine, plan: Plan) -> RenderCheck | None:
    """How far joints in the engine's layer lie from their computed place, in pixels of the photo.

    The stripes are drawn by the same engine from the same scene, and bent by the same lens, as the layer.
    None if no slab side is large enough in the picture to be marked.

    Raises:
        RenderError: the engine failed.
    """
    view = plan.view
    pixels = view.camera.width * view.camera.height
    scale = min(1.0, float(np.sqrt(_MOST_PIXELS / pixels)))
    small = view if scale == 1.0 else view.scaled(scale)
    marks = choose_marks(small, plan.lattice, plan.staging.focus)
    if not len(marks.ground):
        return None
    whole = Window(0, 0, view.camera.width, view.camera.height)
    straight = straight_window(view, whole)
    size = (small.camera.width, small.camera.height)
    # Where nothing bends, the engine draws the smaller picture itself.
    bends = view.camera.has_distortion
    drawn_size = (round(straight.width * scale), round(straight.height * scale)) if bends else size
    drawn = engine.draw_marks(plan, marks.ground, straight, *drawn_size)
    coverage = bend(drawn[..., None], view, straight, whole, (0.0,), size)[..., 0]
    away = mark_distances(coverage, marks) / scale
    return RenderCheck(float(np.sqrt(np.mean(away**2))), float(np.abs(away).max()), len(away))


def choose_marks(view: View, lattice: Lattice, focus: Focus | None = None) -> Marks:
    """Stripes on slab sides, spread over the picture, clear of each other, where the lens is sharp."""
    whole = slab_sides(lattice)
    # Whole sides, and quarters of those that are so large that few of them are wholly in the picture.
    cuts = whole[:, :1] + np.linspace(0, 1, 5)[:, None] * (whole[:, 1:] - whole[:, :1])
    sides = np.concatenate([whole, np.stack([cuts[:, :-1], cuts[:, 1:]], 2).reshape(-1, 2, 2)])
    ends = view.project(sides)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    middle = sides.mean(1)
    along = sides[:, 1] - sides[:, 0]
    across = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
    middle_px = view.project(middle)

    # Width on the ground of a stripe that is _WIDTH_PX wide in the picture, by a small step across it.
    step = 1e-3 * lattice.spacing_y
    moved = (view.project(middle + step * across) - view.project(middle - step * across)) / (2 * step)
    way = (ends[:, 1] - ends[:, 0]) / np.where(length > 0, length, np.nan)[:, None]
    px_per_unit = np.abs(moved[:, 0] * way[:, 1] - moved[:, 1] * way[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        half = 0.5 * _WIDTH_PX / px_per_unit
    room = np.array([view.camera.width, view.camera.height]) - 1 - 3 * _REACH_PX
    fits = (length > _SHORTEST_PX) & (half < 0.1 * lattice.spacing_y)
    # Where the way across a joint is seen nearly along it, a stripe's ends would slant far along it.
    fits &= 2 * half * np.linalg.norm(moved, axis=-1) < 2 * _WIDTH_PX
    fits &= ((middle_px > 3 * _REACH_PX) & (middle_px < room)).all(-1)
    if focus is not None:
        fits &= blur_px(view, focus, np.pad(middle, ((0, 0), (0, 1)))) < _MOST_BLUR_PX

    family = (np.abs(along[:, 0]) < np.abs(along[:, 1])).astype(np.int64)
    kept = _spread(view, np.flatnonzero(fits), family, length, middle_px, ends)
    sides, middle, half = sides[kept], middle[kept], half[kept, None, None]
    offset = half * across[kept][:, None]
    part = np.minimum(0.6, 2 * _HALF_LENGTH_PX / length[kept])[:, None, None]
    short = middle[:, None] + part * (sides - middle[:, None])
    ground = np.concatenate([short - offset, (short + offset)[:, ::-1]], 1)
    # Along the stripe's inner half, where it is read, its edges may bend with the lens.
    along_it = np.linspace(-0.5, 0.5, 9)[:, None] * (short[:, None, 1] - short[:, None, 0]) + middle[:, None]
    edges = np.stack([along_it - offset, along_it + offset], 1)
    return Marks(ground, view.project(edges), middle_px[kept])


def mark_distances(coverage: Float[np.ndarray, "h w"], marks: Marks) -> Float[np.ndarray, " n"]:
    """Signed distance in pixels, across each stripe, of its centre of coverage from its computed place.

    The centre along a column of pixels is half-way between the stripe's two edges, which is where the
    computed place is taken too: the far half of a wide stripe looks narrower than the near one. What the
    columns of one stripe say is averaged.
    """
    found = np.empty(len(marks.ground))
    reach = np.arange(-_REACH_PX, _REACH_PX + 1)
    for n, edges in enumerate(marks.edges_px):
        way = edges.mean(0)[-1] - edges.mean(0)[0]
        # Read down columns if the stripe runs more across the picture than up it, else along rows.
        run, rise = (0, 1) if abs(way[0]) >= abs(way[1]) else (1, 0)
        ends = edges[:, [0, -1], run]
        low, high = np.ceil(ends.min(1).max()), np.floor(ends.max(1).min())
        at = np.arange(low, max(high, low) + 1).astype(np.int64)
        expected = np.mean([np.interp(at, *_rising(edge[:, run], edge[:, rise])) for edge in edges], axis=0)
        line = np.round(expected).astype(np.int64)[:, None] + reach
        values = coverage[line, at[:, None]] if run == 0 else coverage[at[:, None], line]
        # A stripe that is not there at all is as wrong as the line that was read is long.
        total = values.sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            centre = np.where(total > 0.5, (values * line).sum(1) / total, expected + 2 * _REACH_PX)
        found[n] = float((centre - expected).mean()) * abs(way[run]) / float(np.hypot(*way))
    return found


def _rising(
    x: Float[np.ndarray, " m"], y: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    return (x, y) if x[-1] >= x[0] else (x[::-1], y[::-1])


def _spread(
    view: View,
    candidates: Int[np.ndarray, " k"],
    family: Int[np.ndarray, " n"],
    length: Float[np.ndarray, " n"],
    middle_px: Float[np.ndarray, "n 2"],
    ends_px: Float[np.ndarray, "n 2 2"],
) -> Int[np.ndarray, " m"]:
    """The longest side of each family in each cell of the picture, less those too near to another."""
    size = np.array([view.camera.width, view.camera.height])
    cell = (middle_px[candidates] / size * _CELLS).astype(np.int64)
    key = (cell[:, 0] * _CELLS[1] + cell[:, 1]) * 2 + family[candidates]
    order = np.lexsort((-length[candidates], key))
    first = order[np.concatenate([[True], np.diff(key[order]) > 0])] if len(order) else order
    kept: list[int] = []
    stripes: list[np.ndarray] = []
    for n in candidates[first]:
        half = min(0.3, _HALF_LENGTH_PX / length[n])
        stripe = middle_px[n] + np.linspace(-half, half, 9)[:, None] * (ends_px[n, 1] - ends_px[n, 0])
        others = np.concatenate([np.full((1, 2), np.inf), *stripes])
        clear = np.linalg.norm(others - middle_px[n], axis=1).min() > _SHORTEST_PX
        if clear and all(np.linalg.norm(stripe - middle_px[k], axis=1).min() > _SHORTEST_PX for k in kept):
            kept.append(int(n))
            stripes.append(stripe)
    return np.array(kept, np.int64)
