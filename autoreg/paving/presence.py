"""Which slab sides are really there: the support of each predicted side against places between the joints.

The picture is its own control group. Each side is measured once where the lattice predicts it and several
times where the lattice predicts none, with the same length, direction and neighbourhood. On ground without
this lattice the two kinds of place are exchangeable, so the rank of a side's support among the controls is
a p-value that needs no model of the texture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree

from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid
from autoreg.ground.points import inside_convex, lengths
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid, Sides, visible_sides
from autoreg.ground.stations import Stations
from autoreg.joints.edges import strip_support
from autoreg.joints.joint_looks import Strip
from autoreg.joints.profiles import sample_profiles

# The controls lie between these shares of the spacing off the predicted joint. Few sides get many controls
# each, so that the p-values are fine enough.
CONTROL_RANGE = (0.25, 0.75)
CONTROLS_WANTED, CONTROLS_AT_MOST, CONTROLS_AT_LEAST = 1500, 48, 3
# Slabs that look smaller than this tell nothing.
LEAST_SIDE_PX = 8.0
# How far a joint may lie from where it is predicted, and samples along each side: so many do, but noise hides
# joints that the second number shows.
TOLERANCE_PX, ALONG_SAMPLES, CLOSE_SAMPLES = 1.5, 10, 40
# How sharply the p-values of visible sides gather at zero, and shares of true sides that cannot be seen
# (worn, overgrown, far, covered): the share that suits a photo best is taken.
SHARPNESS = 0.2
MISSED = (0.1, 0.25, 0.4, 0.55, 0.7)
# Sides are compared with controls about as large in the picture.
SIZE_BINS, BIN_AT_LEAST = 4, 25
# The paved field may end before the picture does: these shares of the sides, the nearest first, are tried,
# the best of some boxes of the picture, so large (as a share of it) and so many either way, and the best box
# of the ground between any two of so many cuts of either axis. The choice has its price: the chances are
# shared between the three kinds.
FIELD_SHARES = (0.12, 0.2, 0.33, 0.5, 0.7, 1.0)
BOXES = ((0.7, 2), (0.5, 3), (0.35, 5))
CUTS = 12
SHARE_COST = float(np.log(len(FIELD_SHARES) / 0.45))
BOX_COST = float(np.log(sum(count * count for _, count in BOXES) / 0.45))
GROUND_COST = float(np.log((CUTS * (CUTS - 1) // 2) ** 2 / 0.1))
# Sides whose p-value is below this are there, if no more of their own controls than the second have as much
# support; in a field, more than the third share of them.
PRESENT, BEATEN, FIELD_DENSITY = 0.2, 0.12, 0.45
# ... and more than these parts of what is usual in it, inside and at its rim. Neighbours lie within so many
# lengths of a side, and those that meet it within the last.
CORE_DENSITY, RIM_DENSITY, NEIGHBOURS, RIM = 0.75, 0.55, 1.6, 0.8


@dataclass(frozen=True)
class Presence:
    """The `support` of each side, `p`, its p-value among all controls, its length and place in the picture.

    `beaten` is the share of its own controls that have as much support. In clutter beside smooth slabs any
    place has more than most controls, but no more than its own.
    """

    sides: Sides
    p: Float[np.ndarray, " n"]
    size_px: Float[np.ndarray, " n"]
    support: Float[np.ndarray, " n"]
    beaten: Float[np.ndarray, " n"]
    at_px: Float[np.ndarray, "n 2"]

    @property
    def there(self) -> Bool[np.ndarray, " n"]:
        """Sides that are there, as far as one side by itself can tell."""
        return (self.p < PRESENT) & (self.beaten < BEATEN)

    def llr(self, rows: np.ndarray) -> Float[np.ndarray, " k"]:
        """Log likelihood ratios in nats of sides being there, for the share of missed ones that suits."""
        return max(self.llr_by_missed[:, rows], key=lambda llr: float(llr.sum()))

    @cached_property
    def llr_by_missed(self) -> Float[np.ndarray, "missed n"]:
        """Log likelihood ratios in nats of all sides being there, for each share of missed ones."""
        return np.array([p_llr(self.p, missed) for missed in MISSED])

    def largest(self, share: float) -> Bool[np.ndarray, " n"]:
        """Which sides are of the given share that is largest in the picture."""
        chosen = np.zeros(len(self.p), dtype=bool)
        count = max(1, round(share * len(self.p)))
        chosen[np.argsort(-self.size_px, kind="stable")[:count]] = True
        return chosen

    def nearest(self, share: float) -> Presence:
        """The given share of the sides, the largest in the picture first."""
        return self.take(np.flatnonzero(self.largest(share)))

    def inside(self, field: Float[np.ndarray, "k 2"]) -> Presence:
        """The sides whose middle lies in a convex counter-clockwise polygon."""
        return self.take(np.flatnonzero(inside_convex(self.sides.middle, field, 0.0)))

    def take(self, rows: np.ndarray) -> Presence:
        """The chosen sides."""
        return Presence(
            self.sides.take(rows),
            self.p[rows],
            self.size_px[rows],
            self.support[rows],
            self.beaten[rows],
            self.at_px[rows],
        )

    @cached_property
    def field(self) -> Float[np.ndarray, "n 2"]:
        """What `field_polygon` makes of it."""
        return field_polygon(self)

    @cached_property
    def possible_fields(self) -> tuple[tuple[Bool[np.ndarray, " n"], float], ...]:
        """Sides that may be all there is of the paving, each choice of them with its price in nats."""
        if len(self.p) == 0:
            return ((np.zeros(0, dtype=bool), SHARE_COST),)
        fields = [(self.largest(share), SHARE_COST) for share in FIELD_SHARES]
        boxes = _boxes(self.at_px)
        best = int((self.llr_by_missed @ np.array(boxes, float).T).max(0).argmax())
        return (*fields, (boxes[best], BOX_COST))


def _boxes(at_px: Float[np.ndarray, "n 2"]) -> list[Bool[np.ndarray, " n"]]:
    """Which places lie in each box of the part of the picture that they span."""
    low, size = at_px.min(0), np.ptp(at_px, axis=0)
    at = (at_px - low) / np.maximum(size, 1e-9)
    corners = ((share, np.linspace(0.0, 1.0 - share, count)) for share, count in BOXES)
    return [
        ((at >= corner) & (at <= corner + share)).all(1)
        for share, places in corners
        for corner in np.stack(np.meshgrid(places, places), -1).reshape(-1, 2)
    ]


def _likeliest_box(
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


def side_presence(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    strip: Strip,
    *,
    limit: int = 1200,
    only: int | None = None,
    field: Float[np.ndarray, "k 2"] | None = None,
    controls_wanted: int = CONTROLS_WANTED,
    along_samples: int = ALONG_SAMPLES,
) -> Presence:
    """How well each visible side of a lattice is supported by the picture.

    Only those of the family `only`, if that is given, and of a convex counter-clockwise `field`.
    """
    sides = visible_sides(
        camera, cam_from_ground, grid, min_px=LEAST_SIDE_PX, limit=limit, only=only, field=field
    )
    return _presence_of_sides(
        picture, camera, cam_from_ground, grid, strip, sides, controls_wanted, along_samples
    )


def _presence_of_sides(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    strip: Strip,
    sides: Sides,
    controls_wanted: int = CONTROLS_WANTED,
    along_samples: int = ALONG_SAMPLES,
) -> Presence:
    n = len(sides)
    if n == 0:
        none = np.zeros(0)
        return Presence(sides, none, none, none, none, np.zeros((0, 2)))
    controls = int(np.clip(np.ceil(controls_wanted / n), CONTROLS_AT_LEAST, CONTROLS_AT_MOST))
    shares = np.r_[0.0, np.linspace(*CONTROL_RANGE, controls)]
    support, half_px, at_px = support_beside(
        picture, camera, cam_from_ground, grid, strip, sides, shares, along_samples
    )
    p = np.ones(n)
    for family in (ALONG_X, ALONG_Y):
        members = np.flatnonzero(sides.family == family)
        members = members[np.argsort(half_px[members], kind="stable")]
        for rows in np.array_split(members, max(1, min(SIZE_BINS, len(members) // BIN_AT_LEAST))):
            beside = np.sort(support[1:, rows].ravel())
            above = len(beside) - np.searchsorted(beside, support[0, rows], side="left")
            p[rows] = (1 + above) / (1 + len(beside))
    beaten = (support[1:] >= support[0]).mean(0)
    return Presence(sides, p, 2.0 * half_px, support[0], beaten, at_px)


def support_beside(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    strip: Strip,
    sides: Sides,
    shares: Float[np.ndarray, " k"],
    along_samples: int = ALONG_SAMPLES,
) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """Support of places that lie so many shares of the spacing beside each side, the first of them on it.

    With half the measured length of the sides in pixels, and where their middles are.
    """
    across = np.array(grid.slab_size[::-1])[sides.family]
    direction = np.where(sides.family[:, None] == ALONG_X, [[0.0, 1.0]], [[1.0, 0.0]])
    middle, half = sides.middle, 0.4 * lengths(sides.ends[:, 1] - sides.ends[:, 0])
    n, repeat = len(sides), len(shares)
    stations = Stations(
        ground=np.concatenate([middle + share * across[:, None] * direction for share in shares]),
        half_length=np.tile(half, repeat),
        family=np.tile(sides.family, repeat),
        line=np.tile(sides.line, repeat),
        cell=np.tile(sides.cell, repeat),
        side=np.tile(np.arange(n), repeat),
    )
    profiles = sample_profiles(picture, camera, cam_from_ground, stations, 8.0, along_samples=along_samples)
    width = np.array(strip.width)[stations.family] * profiles.px_per_unit
    # Between close joints the window must not reach the neighbours.
    room = 0.5 * across[stations.side] * profiles.px_per_unit
    support = strip_support(
        profiles,
        np.minimum(width, 6.0),
        strip.blur_px,
        TOLERANCE_PX,
        np.clip(room, 3.0, 8.0),
        np.array(strip.polarity)[stations.family],
    )
    return support.reshape(repeat, n), half * profiles.px_per_unit[:n], profiles.centre_px[:n]


def presence_of(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    *,
    limit: int = 1200,
    only: int | None = None,
    field: Float[np.ndarray, "k 2"] | None = None,
    controls_wanted: int = CONTROLS_WANTED,
    along_samples: int = ALONG_SAMPLES,
) -> Presence:
    """How well each visible side of a fit's lattice is supported by the picture of its camera.

    Of the one family, and within the part of the ground, that `side_presence` takes.
    """
    return side_presence(
        picture,
        fit.camera,
        fit.cam_from_ground,
        fit.grid,
        fit.strip,
        limit=limit,
        only=only,
        field=field,
        controls_wanted=controls_wanted,
        along_samples=along_samples,
    )


def looked_at_closer(
    picture: Float[np.ndarray, "h w"], fit: Fit, presence: Presence, along_samples: int
) -> Presence:
    """The sides in the box of the ground that is likeliest to be paved, held against places in it alone.

    Where paving fills a small part of a photo, few of its sides get few controls each, and most of these lie
    on what grows or lies around it. The choice of the box costs `GROUND_COST`.
    """
    box = _likeliest_box(presence.sides.middle, presence.llr_by_missed)
    sides = presence.sides.take(np.flatnonzero(box))
    return _presence_of_sides(
        picture, fit.camera, fit.cam_from_ground, fit.grid, fit.strip, sides, along_samples=along_samples
    )


def p_llr(p: Float[np.ndarray, "*n"], missed: float) -> Float[np.ndarray, "*n"]:
    """Log likelihood ratio of a p-value: a Beta density that gathers at zero, or missed, against uniform.

    Its exponential has expectation one under the null, which makes the product over sides an e-value.
    """
    return np.log((1 - missed) * SHARPNESS * p ** (SHARPNESS - 1) + missed)


def field_polygon(presence: Presence) -> Float[np.ndarray, "n 2"]:
    """Convex hull of the largest field of sides that are there, counter-clockwise.

    A side belongs to the field if enough of its neighbours are there; of several fields that do not touch,
    the one with the most sides is taken.
    """
    if len(presence.p) == 0:
        raise ValueError("presence: no sides to span a field")
    middle = presence.sides.middle
    there = presence.there
    length = float(np.median(lengths(presence.sides.ends[:, 1] - presence.sides.ends[:, 0])))
    n = len(middle)
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
    points = (presence.sides.ends[field].reshape(-1, 1, 2) + corners).reshape(-1, 2)
    return points[ConvexHull(points).vertices]
