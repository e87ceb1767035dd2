"""Straight edges that noise or grain hides from LSD, found by averaging along them.

LSD asks the gradient of single pixels for its direction, which noise as strong as the edge leaves without
one. A long narrow filter takes the noise out along an edge and keeps what changes across it, as the eye does.
The idea is that of oriented means: Galun, Basri and Brandt, "Multiscale edge detection and fiber enhancement
using differences of oriented means", ICCV 2007.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

# The filters: a Gaussian's derivative across, a Gaussian along (standard deviations in pixels), in so many
# directions of a half turn.
ACROSS_PX, ALONG_PX, DIRECTIONS = 1.2, 7.0, 24
# An edge stands out by so many standard deviations of what the filters find around it, within a window of
# this side, which rounding to grey levels alone makes one grey level.
LEAST_SIGMAS, AROUND_PX, ROUNDING = 4.2, 65, 1.0
# Places on an edge are no farther apart than this, and their directions by one step at the most.
LINK_PX = 2.3
# An edge is so long at least, with places on so large a share of its pixels, which lie aside by so much.
LEAST_LENGTH_PX, LEAST_SHARE, STRAIGHT_PX = 12.0, 0.7, 1.0


class _Places(NamedTuple):
    """Places on edges, the direction in which it gets brighter there, and its number on the full circle."""

    at_px: Float[np.ndarray, "n 2"]
    brighter: Float[np.ndarray, "n 2"]
    direction: Int[np.ndarray, " n"]


def faint_edges(gray: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2 2"]:
    """Both ends of each straight edge, in pixels; walking from the first to the second, the dark is right."""
    places = _places(*_strongest(gray))
    found = [_segment(places, rows) for rows in _linked(places)]
    return np.array([ends for ends in found if ends is not None]).reshape(-1, 2, 2)


def _strongest(
    gray: UInt8[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """The strongest filter's answer at each pixel, in standard deviations of those around, and its number."""
    picture = gray.astype(np.float32)
    strongest, number = np.zeros_like(picture), np.zeros(picture.shape, int)
    around = np.zeros_like(picture)
    for k in range(DIRECTIONS):
        answer = cv2.filter2D(picture, cv2.CV_32F, _filter(k), borderType=cv2.BORDER_REFLECT_101)
        size = np.abs(answer)
        around += size
        stronger = size > np.abs(strongest)
        strongest[stronger], number[stronger] = answer[stronger], k
    # The mean size of what is normally distributed is this much less than its standard deviation.
    sigma = cv2.blur(around, (AROUND_PX, AROUND_PX)) / DIRECTIONS * np.sqrt(np.pi / 2.0)
    return strongest / np.maximum(sigma, ROUNDING), number


def _normal(number: np.ndarray | int) -> Float[np.ndarray, "*n 2"]:
    """Across the direction of a number, half a circle of which has `DIRECTIONS`."""
    angle = np.pi * np.asarray(number) / DIRECTIONS
    return np.stack([-np.sin(angle), np.cos(angle)], -1)


def _filter(number: int) -> Float[np.ndarray, "k k"]:
    """The filter along a direction, positive where it gets brighter along the normal; of unit energy."""
    reach = int(np.ceil(2.5 * ALONG_PX))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(float)
    nx, ny = _normal(number)
    across, along = nx * x + ny * y, ny * x - nx * y
    values = across * np.exp(-0.5 * ((across / ACROSS_PX) ** 2 + (along / ALONG_PX) ** 2))
    return (values / np.linalg.norm(values)).astype(np.float32)


def _places(sigmas: Float[np.ndarray, "h w"], number: Int[np.ndarray, "h w"]) -> _Places:
    """Where the answers are strongest across their own direction, to a part of a pixel."""
    # Few photos need it, and it takes a twentieth of a second to import.
    from scipy.ndimage import map_coordinates

    size = np.abs(sigmas).astype(np.float32)
    y, x = np.nonzero(size > LEAST_SIGMAS)
    normal, own = _normal(number[y, x]), size[y, x]

    def beside(step: int) -> Float[np.ndarray, " n"]:
        at = np.stack([y, x]) + step * normal.T[::-1]
        return map_coordinates(size, at, order=1, mode="nearest")

    before, after = beside(-1), beside(1)
    peak = (own >= after) & (own > before)
    off = 0.5 * (after - before) / np.maximum(2.0 * own - before - after, 1e-6)
    at = np.stack([x, y], 1) + np.clip(off, -0.7, 0.7)[:, None] * normal
    darker = sigmas[y, x] < 0.0
    brighter = np.where(darker[:, None], -normal, normal)
    direction = number[y, x] + DIRECTIONS * darker
    return _Places(at[peak], brighter[peak], direction[peak])


def _linked(places: _Places) -> list[Int[np.ndarray, " k"]]:
    """The places of each edge: chains of near ones of about one direction."""
    n = len(places.at_px)
    if n == 0:
        return []
    near = KDTree(places.at_px).query_pairs(LINK_PX, output_type="ndarray")
    turn = np.abs(places.direction[near[:, 0]] - places.direction[near[:, 1]])
    near = near[np.minimum(turn, 2 * DIRECTIONS - turn) <= 1]
    graph = coo_array((np.ones(len(near)), (near[:, 0], near[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _segment(places: _Places, rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "2 2"] | None:
    """The ends of the straight edge on which some places lie; None if they are too few, or lie on none."""
    if len(rows) < LEAST_SHARE * LEAST_LENGTH_PX:
        return None
    at = places.at_px[rows]
    middle = at.mean(0)
    _, (_, aside), (way, _) = np.linalg.svd(at - middle, full_matrices=False)
    right = np.array([-way[1], way[0]])
    if places.brighter[rows].mean(0) @ right > 0.0:
        way = -way
    along = (at - middle) @ way
    if np.ptp(along) < LEAST_LENGTH_PX or aside > STRAIGHT_PX * np.sqrt(len(rows)):
        return None
    return middle + np.array([along.min(), along.max()])[:, None] * way
