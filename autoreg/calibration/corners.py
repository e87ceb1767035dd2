"""Corners of a found board made exact at full resolution, put in the board's order, and checked."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

Gray = UInt8[np.ndarray, "h w"]
Corners = Float[np.ndarray, "n 2"]
Grid = Float[np.ndarray, "rows columns 2"]

# Half the window in which a corner's edges are looked at, as a part of the distance to the next corner:
# larger ones average more pixels but see the neighbour's blur and the lens's bend.
WINDOW = 0.3
_LEAST_WINDOW_PX, _MOST_WINDOW_PX = 2, 24
# A corner that the refinement takes further than this part of a square has left its place.
_MOST_MOVE = 0.4
# A smooth grid has small second differences; a lost corner shows as a kink.
_MOST_KINK = 0.35
# Where, between a corner and the square's far end, the tones of the four squares around it are read.
_PROBE = 0.3


def refine(gray: Gray, corners_px: Corners, spacing_px: Float[np.ndarray, " n"]) -> Corners:
    """The corners where the gradients around each are square to the lines through it (cv2.cornerSubPix).

    Args:
        gray: the picture at full resolution.
        corners_px: where the corners are to within a part of a square.
        spacing_px: distance from each to its nearest neighbour, which sets its window.
    """
    refined = np.empty_like(corners_px)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    for k, (corner, spacing) in enumerate(zip(corners_px, spacing_px, strict=True)):
        half = int(np.clip(round(WINDOW * spacing), _LEAST_WINDOW_PX, _MOST_WINDOW_PX))
        point = corner.astype(np.float32).reshape(1, 1, 2)
        refined[k] = np.asarray(cv2.cornerSubPix(gray, point, (half, half), (-1, -1), criteria)).reshape(2)
    return refined


def nearest_spacing(grid: Grid) -> Float[np.ndarray, "rows columns"]:
    """Distance from each corner of a grid to its nearest neighbour along rows and columns."""
    spacing = np.full(grid.shape[:2], np.inf)
    along_x = np.linalg.norm(np.diff(grid, axis=1), axis=-1)
    along_y = np.linalg.norm(np.diff(grid, axis=0), axis=-1)
    spacing[:, :-1] = np.minimum(spacing[:, :-1], along_x)
    spacing[:, 1:] = np.minimum(spacing[:, 1:], along_x)
    spacing[:-1] = np.minimum(spacing[:-1], along_y)
    spacing[1:] = np.minimum(spacing[1:], along_y)
    return spacing


def trouble(grid: Grid, moved_px: Float[np.ndarray, "rows columns"], width: int, height: int) -> str | None:
    """Why a refined grid cannot be a board's, or None.

    Args:
        grid: the refined corners.
        moved_px: how far the refinement moved each.
        width: of the picture, in pixels.
        height: of the picture, in pixels.
    """
    if not np.isfinite(grid).all() or (grid < 0).any() or (grid > [width - 1, height - 1]).any():
        return "corners lie outside the picture"
    spacing = nearest_spacing(grid)
    if spacing.min() < 3:
        return f"the squares are too small, down to {spacing.min():.1f} px"
    if (moved_px > _MOST_MOVE * spacing).any():
        return "corners are too blurred or hidden to be placed"
    for axis in (0, 1):
        kink = np.linalg.norm(np.diff(grid, n=2, axis=axis), axis=-1)
        middle = spacing[1:-1] if axis == 0 else spacing[:, 1:-1]
        if (kink > _MOST_KINK * middle).any():
            return "the corners found are no regular grid"
    return None


def in_board_order(gray: Gray, grid: Grid) -> Grid:
    """The grid as seen from the front, beginning where the outer corner square is black, if colours can tell.

    The detectors begin at any end of a board that has the same number of corners. Seen from the front, rows
    turn clockwise into columns (y is down); a photo of a mirror is turned back.
    """
    along_x, along_y = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along_x[0] * along_y[1] - along_x[1] * along_y[0] < 0:
        grid = grid[::-1]
    # Square (i, j) lies between corners (i, j) and (i+1, j+1); it has the colour of the outer corner square
    # if i + j is even.
    middles = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
    tones = _tones(gray, middles)
    j, i = np.indices(tones.shape)
    black = (i + j) % 2 == 0
    if tones[black].mean() > tones[~black].mean():
        grid = grid[::-1, ::-1]
    return grid


def sides_that_go_on(gray: Gray, grid: Grid) -> tuple[bool, bool, bool, bool]:
    """Whether there is a further row of corners beyond the grid's left, right, top and bottom side.

    A further corner is one around which black and white alternate, as they do around those found.
    """
    tones = [_probes(gray, grid, k) for k in range(4)]
    inner = np.abs(tones[0] + tones[2] - tones[1] - tones[3])[1:-1, 1:-1] / 2
    contrast = float(np.median(inner)) if inner.size else 0.0
    turned = np.transpose(grid, (1, 0, 2))
    outer = (turned[::1], turned[::-1], grid[::1], grid[::-1])
    return tuple(_goes_on(gray, side, contrast) for side in outer)  # pyright: ignore[reportReturnType]


def _goes_on(gray: Gray, grid: Grid, contrast: float) -> bool:
    """Whether another row of corners comes before the grid's first."""
    # Cross ratios are kept by a quadratic continuation well enough over one square.
    first, second, third = grid[0], grid[1], grid[2]
    beyond = 3 * first - 3 * second + third
    strip = np.stack([2 * beyond - first, beyond, first])
    height, width = gray.shape
    ends = strip[0]
    inside = ((ends > 1) & (ends < [width - 2, height - 2])).all(-1)[1:-1]
    if inside.sum() < 2 or contrast <= 0:
        return False
    # The four squares around each further corner, by turns.
    quads = [
        _tones(gray, beyond[1:-1] + _PROBE * (strip[row][1:-1] - beyond[1:-1] + along))
        for row, along in (
            (0, beyond[:-2] - beyond[1:-1]),
            (0, beyond[2:] - beyond[1:-1]),
            (2, beyond[2:] - beyond[1:-1]),
            (2, beyond[:-2] - beyond[1:-1]),
        )
    ]
    alternating = np.minimum(
        np.minimum(np.abs(quads[0] - quads[1]), np.abs(quads[1] - quads[2])),
        np.minimum(np.abs(quads[2] - quads[3]), np.abs(quads[3] - quads[0])),
    )
    across = np.maximum(np.abs(quads[0] - quads[2]), np.abs(quads[1] - quads[3]))
    saddle = (alternating > 0.5 * contrast) & (across < 0.5 * contrast)
    return bool(saddle[inside].mean() > 0.7)


def _probes(gray: Gray, grid: Grid, which: int) -> Float[np.ndarray, "rows columns"]:
    """Tones in one of the four squares around each corner; the outermost repeat their neighbours."""
    step_x = np.gradient(grid, axis=1)
    step_y = np.gradient(grid, axis=0)
    sx, sy = ((-1, -1), (1, -1), (1, 1), (-1, 1))[which]
    return _tones(gray, grid + _PROBE * (sx * step_x + sy * step_y))


def _tones(gray: Gray, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    """Tones of the pixels nearest to places, the picture's edge repeated."""
    height, width = gray.shape
    u = np.clip(np.round(px[..., 0]).astype(int), 0, width - 1)
    v = np.clip(np.round(px[..., 1]).astype(int), 0, height - 1)
    return gray[v, u].astype(float)
