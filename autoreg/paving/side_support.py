"""How well the picture supports each side of a lattice, against places between its joints.

Each side is measured once where the lattice predicts it and several times where the lattice predicts none,
with the same length, direction and neighbourhood.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.points import lengths
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid, Sides, visible_sides
from autoreg.ground.stations import Stations
from autoreg.joints.edges import strip_support
from autoreg.joints.joint_looks import Strip
from autoreg.joints.profiles import sample_profiles
from autoreg.paving.paved_part import likeliest_box
from autoreg.paving.presence import Presence, likeliest_llr, rank_p

# The controls lie between these shares of the spacing off the predicted joint. Few sides get many controls
# each, so that the p-values are fine enough.
CONTROL_RANGE = (0.25, 0.75)
CONTROLS_AT_MOST, CONTROLS_AT_LEAST = 48, 3
# Slabs that look smaller than this tell nothing.
LEAST_SIDE_PX = 8.0
# How far a joint may lie from where it is predicted.
TOLERANCE_PX = 1.5
# One family in twenty of those that are neither dark nor light may be of lines of two tones.
PAIRED_COST = float(np.log(20.0))
# Sides are compared with controls about as large in the picture.
SIZE_BINS, BIN_AT_LEAST = 4, 25


@runtime_checkable
class LatticeSeen(Protocol):
    """A lattice on the ground before a camera, whose joints look like strips: what a `Fit` is."""

    @property
    def camera(self) -> Camera:
        """Of the picture."""
        ...

    @property
    def cam_from_ground(self) -> Rigid:
        """Its pose."""
        ...

    @property
    def grid(self) -> Grid:
        """The lattice."""
        ...

    @property
    def strip(self) -> Strip:
        """What its joints look like."""
        ...


class Effort(NamedTuple):
    """How many sides are looked at, at the most, with how many controls in all, and samples along each."""

    sides: int = 1200
    controls: int = 1500
    along: int = 10


USUAL = Effort()
# Noise hides joints that more samples show.
CLOSE = Effort(along=40)


def presence_of(
    picture: Float[np.ndarray, "h w"],
    lattice: LatticeSeen,
    effort: Effort = USUAL,
    *,
    only: int | None = None,
    field: Float[np.ndarray, "k 2"] | None = None,
    paired: bool = False,
) -> Presence:
    """How well each visible side of a lattice is supported by the picture of its camera.

    Only those of the family `only`, if that is given, and of a convex counter-clockwise `field`. Joints that
    are neither dark nor light are taken for steps of tone; where `paired`, for a light line beside a dark one
    if that makes them likelier, which has its price.
    """
    sides = visible_sides(
        lattice.camera,
        lattice.cam_from_ground,
        lattice.grid,
        min_px=LEAST_SIDE_PX,
        limit=effort.sides,
        only=only,
        field=field,
    )
    return presence_of_these(picture, lattice, sides, effort, paired=paired)


def looked_at_closer(
    picture: Float[np.ndarray, "h w"],
    lattice: LatticeSeen,
    presence: Presence,
    effort: Effort,
    *,
    paired: bool = False,
) -> Presence:
    """The sides in the box of the ground that is likeliest to be paved, held against places in it alone.

    Where paving fills a small part of a photo, few of its sides get few controls each, and most of these lie
    on what grows or lies around it. The choice of the box costs `GROUND_COST`.
    """
    box = likeliest_box(presence.sides.middle, presence.llr_by_missed)
    return presence_of_these(
        picture, lattice, presence.sides.take(np.flatnonzero(box)), effort, paired=paired
    )


def presence_of_these(
    picture: Float[np.ndarray, "h w"],
    lattice: LatticeSeen,
    sides: Sides,
    effort: Effort = USUAL,
    *,
    paired: bool = False,
) -> Presence:
    """How well some sides of a lattice, or parts of them, are supported; the rest is as for `presence_of`."""
    n = len(sides)
    if n == 0:
        none = np.zeros(0)
        return Presence(sides, none, none, none, none, np.zeros((0, 2)))
    controls = int(np.clip(np.ceil(effort.controls / n), CONTROLS_AT_LEAST, CONTROLS_AT_MOST))
    shares = np.r_[0.0, np.linspace(*CONTROL_RANGE, controls)]
    support, half_px, at_px = support_beside(picture, lattice, sides, shares, effort.along)
    p, looks_nats = np.ones(n), 0.0
    for family in (ALONG_X, ALONG_Y):
        rows = np.flatnonzero(sides.family == family)
        p[rows] = _ranked(support[:, rows], half_px[rows])
        if not paired or lattice.strip.polarity[family] != 0 or len(rows) == 0:
            continue
        pairs, _, _ = support_beside(picture, lattice, sides.take(rows), shares, effort.along, paired=True)
        other = _ranked(pairs, half_px[rows])
        if likeliest_llr(other) > likeliest_llr(p[rows]) + PAIRED_COST:
            p[rows], support[:, rows] = other, pairs
            looks_nats += PAIRED_COST
    beaten = (support[1:] >= support[0]).mean(0)
    return Presence(sides, p, 2.0 * half_px, support[0], beaten, at_px, looks_nats)


def _ranked(support: Float[np.ndarray, "k n"], half_px: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The p-value of each side of a family, by its support among that of controls about as large."""
    p = np.ones(len(half_px))
    order = np.argsort(half_px, kind="stable")
    for rows in np.array_split(order, max(1, min(SIZE_BINS, len(order) // BIN_AT_LEAST))):
        p[rows] = rank_p(support[0, rows], support[1:, rows].ravel())
    return p


def support_beside(
    picture: Float[np.ndarray, "h w"],
    lattice: LatticeSeen,
    sides: Sides,
    shares: Float[np.ndarray, " k"],
    along: int = USUAL.along,
    *,
    paired: bool = False,
) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """Support of places that lie so many shares of the spacing beside each side, the first of them on it.

    With half the measured length of the sides in pixels, and where their middles are. `paired` is as for
    `strip_support`.
    """
    across = np.array(lattice.grid.slab_size[::-1])[sides.family]
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
    profiles = sample_profiles(
        picture, lattice.camera, lattice.cam_from_ground, stations, 8.0, along_samples=along
    )
    # Beside a side at the picture's rim places may lie behind the camera, or beyond the lens's field.
    seen = np.isfinite(profiles.px_per_unit)
    scale = np.where(seen, profiles.px_per_unit, 0.0)
    width = np.array(lattice.strip.width)[stations.family] * scale
    # Between close joints the window must not reach the neighbours.
    room = 0.5 * across[stations.side] * scale
    support = strip_support(
        profiles,
        np.minimum(width, 6.0),
        lattice.strip.blur_px,
        TOLERANCE_PX,
        np.clip(room, 3.0, 8.0),
        np.array(lattice.strip.polarity)[stations.family],
        paired=paired,
    ).reshape(repeat, n)
    # What is not seen is no evidence for the side: it counts as a place that looks like it.
    support = np.where(seen.reshape(repeat, n), support, support[0])
    return support, half * scale[:n], profiles.centre_px[:n]
