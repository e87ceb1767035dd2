"""Which part of the ground is paved: boxes that slab sides gather in, and the hull of those that show."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree

from autoreg.ground.points import lengths
from autoreg.ground.sides import Sides

# Boxes of the picture, so large (as a share of it) and so many either way, and on the ground those between
# any two of so many cuts of either axis.
BOXES = ((0.7, 2), (0.5, 3), (0.35, 5))
CUTS = 12
# Of the sides in a field more than this share is there ...
FIELD_DENSITY = 0.45
# ... and more than these parts of what is usual in it, inside and at its rim. Neighbours lie within so many
# lengths of a side, and those that meet it within the last.
CORE_DENSITY, RIM_DENSITY, NEIGHBOURS, RIM = 0.75, 0.55, 1.6, 0.8


def picture_boxes(at_px: Float[np.ndarray, "n 2"]) -> list[Bool[np.ndarray, " n"]]:
    """Which places lie in each box of the part of the picture that they span."""
    low, size = at_px.min(0), np.ptp(at_px, axis=0)
    at = (at_px - low) / np.maximum(size, 1e-9)
    corners = ((share, np.linspace(0.0, 1.0 - share, count)) for share, count in BOXES)
    return [
        ((at >= corner) & (at <= corner + share)).all(1)
        for share, places in corners
        for corner in np.stack(np.meshgrid(places, places), -1).reshape(-1, 2)
    ]


def likeliest_box(
    middle: Float[np.ndarray, "n 2"], llr: Float[np.ndarray, "missed n"]
) -> Bool[np.ndarray, " n"]:
    """Which places on the ground lie in the box, along its axes, in which their log likelihoods sum to most.

    It lies between two of the quantiles of the places along either axis.
    """
    cuts = np.linspace(0.0, 1.0, CUTS)[1:-1]
    cell = np.stack([np.searchsorted(np.quantile(at, cuts), at, side="right") for at in middle.T], 1)
    flat = np.ravel_multi_index((cell[:, 0], cell[:, 1]), (CUTS - 1, CUTS - 1))
    sums = [np.bincount(flat, weights=one, minlength=(CUTS - 1) ** 2) for one in llr]
    table = np.zeros((len(llr), CUTS, CUTS))
    table[:, 1:, 1:] = np.reshape(sums, (-1, CUTS - 1, CUTS - 1)).cumsum(1).cumsum(2)
    first, last = np.triu_indices(CUTS, 1)
    slabs = table[:, last] - table[:, first]
    boxes = (slabs[:, :, last] - slabs[:, :, first]).max(0)
    x, y = np.unravel_index(boxes.argmax(), boxes.shape)
    low, high = np.array([first[x], first[y]]), np.array([last[x], last[y]])
    return np.asarray(((cell >= low) & (cell < high)).all(1))


def field_polygon(sides: Sides, there: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "k 2"]:
    """Convex hull of the largest field of sides that are `there`, counter-clockwise.

    A side belongs to the field if enough of its neighbours are there; of several fields that do not touch,
    the one with the most sides is taken.
    """
    n = len(sides)
    if n == 0:
        raise ValueError("no sides to span a field")
    middle, length = sides.middle, float(np.median(lengths(sides.ends[:, 1] - sides.ends[:, 0])))
    pairs = KDTree(middle).query_pairs(NEIGHBOURS * length, output_type="ndarray")
    both = np.concatenate([pairs, pairs[:, ::-1], np.repeat(np.arange(n), 2).reshape(-1, 2)])
    share = np.bincount(both[:, 0], weights=there[both[:, 1]]) / np.bincount(both[:, 0])
    # What lies beside a field in which all sides are there must not be counted to it for a few chance hits.
    usual = float(np.quantile(share[there], 0.75)) if there.any() else 0.0
    core = there & (share > max(FIELD_DENSITY, CORE_DENSITY * usual))
    linked = both[core[both[:, 0]] & core[both[:, 1]]]
    graph = coo_array((np.ones(len(linked)), (linked[:, 0], linked[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    counts = np.bincount(label, weights=core)
    field = core & (label == counts.argmax())
    # Sides at the rim have half of their neighbours outside: those next to the core belong to the field.
    rim = there & (share > max(FIELD_DENSITY, RIM_DENSITY * usual))
    near = both[field[both[:, 0]] & rim[both[:, 1]]]
    near = near[lengths(middle[near[:, 0]] - middle[near[:, 1]]) < RIM * length]
    field[near[:, 1]] = True
    if field.sum() < 4:
        field = np.ones(n, dtype=bool)
    # Slightly widened, so that the sides of a single line span an area too.
    corners = 0.05 * length * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    points = (sides.ends[field].reshape(-1, 1, 2) + corners).reshape(-1, 2)
    return points[ConvexHull(points).vertices]
