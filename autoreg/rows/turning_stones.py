"""Whether the stones of a field all point one way, or turn from one side of it to the other.

Where arcs stand one behind the other, as those of fans do, a strip along their crowns is as even as a
lattice. Its robust fit leaves out the stones beside the crown, and by those that are left the joints are
straight. But a stone's joints turn with it, both alike, and those that were left out tell it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.ground.points import inside_box, on_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.rows.cross_joints import FANNED_RAD, LONGEST, MEDIAN_LOSS, SHORTEST, Lean, off_angle
from autoreg.segments import Segments
from autoreg.spread import spread

# Fewer segments than this in a third of the field tell no turn.
FEWEST_SEGMENTS = 8
# Stones that turn do it little by little: at least this share of them lies in the middle half of their turn,
# where a third lies of those that turn evenly. Next to none does of joints and of what crosses them at an
# angle on one side, such as a railing and its shadows.
LEAST_BETWEEN = 0.05
# The ground around a field reaches so many of its sizes to either side.
AROUND = 1.0
# Joints that scatter by less about a lattice's directions are those of slabs, and what lies around them in
# other directions is something else: those of boards and slabs scatter by up to 1.6 degrees, those of waves
# that pass as a lattice by 3 or more.
STRAIGHT_RAD = np.radians(2.0)
# Joints that run along the lattice do so to this.
ALONG_RAD = np.radians(1.0)


def common_turn(
    segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"], *, margin: float = 0.0
) -> Lean | None:
    """By how much the joints of both families turn alike from one third of a field to the opposite one.

    Across the field whichever way they turn more; the less of both families' turns, counterclockwise, and
    the greater of their standard deviations. None where too few joints are seen, or the families do not turn
    the same way. The ground around the field counts as well, within a `margin` of so many of its sizes. The
    fit, a lattice, is at the photo's own resolution.
    """
    ground = on_ground(segments.ends_px, fit.camera, fit.cam_from_ground)
    alike: list[Lean] = []
    for axis in (ALONG_X, ALONG_Y):
        turns = [_turn(ground, fit, field, family, axis, margin=margin) for family in (ALONG_X, ALONG_Y)]
        known = [turn for turn in turns if turn is not None]
        if len(known) == 2 and known[0].angle * known[1].angle > 0:
            less = min(known, key=lambda turn: abs(turn.angle))
            alike.append(Lean(less.angle, max(turn.sigma for turn in known)))
    return max(alike, key=lambda turn: abs(turn.angle), default=None)


def turn_across(segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"], family: int) -> Lean | None:
    """By how much the joints across those of a family turn, from one third of a field to the opposite one.

    Along that family; None where too few joints are seen. The fit is at the photo's own resolution.
    """
    ground = on_ground(segments.ends_px, fit.camera, fit.cam_from_ground)
    off, middle = _off(ground, fit, field, 1 - family)
    ends = _ends(off, middle[:, family])
    return None if ends is None else ends.turn


@dataclass(frozen=True)
class Directions:
    """How the joints of one family run: off the lattice's direction in the median, and how they scatter.

    In radians, counterclockwise; the `scatter` is a robust standard deviation of one joint's direction, and
    `along` the share of them that run along the lattice, to `ALONG_RAD`. They run `aslant`, to whichever
    side, in the median, and the `slant_scatter` is that of this angle; `rarer` is the share of those to the
    side that fewer run to.
    """

    off: float
    scatter: float
    along: float
    count: int
    aslant: float
    slant_scatter: float
    rarer: float

    @property
    def sigma(self) -> float:
        """Standard deviation of the median."""
        return MEDIAN_LOSS * self.scatter / float(np.sqrt(self.count))


def directions(
    segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"]
) -> tuple[Directions | None, ...]:
    """How the joints within a field run, those along X and those along Y; None where too few are seen.

    The fit is at the photo's own resolution.
    """
    ground = on_ground(segments.ends_px, fit.camera, fit.cam_from_ground)
    found = (_off(ground, fit, field, family)[0] for family in (ALONG_X, ALONG_Y))
    return tuple(_directions_of(off) if len(off) >= 3 * FEWEST_SEGMENTS else None for off in found)


def _directions_of(off: Float[np.ndarray, " n"]) -> Directions:
    slant, left = np.abs(off), float(np.mean(off > 0))
    return Directions(
        off=float(np.median(off)),
        scatter=spread(off),
        along=float(np.mean(slant < ALONG_RAD)),
        count=len(off),
        aslant=float(np.median(slant)),
        slant_scatter=spread(slant),
        rarer=min(left, 1.0 - left),
    )


def straight(run: tuple[Directions | None, ...]) -> bool:
    """Whether joints scatter so little that their stones cannot turn; False where too few are seen."""
    return all(family is not None and family.scatter < STRAIGHT_RAD for family in run)


def turned_alike(run: tuple[Directions | None, ...]) -> Lean | None:
    """By how much the joints of both families are turned alike from the lattice's directions.

    The less of both families' angles, and the greater of their standard deviations; None where too few joints
    are seen, or the families are not turned the same way.
    """
    known = [family for family in run if family is not None]
    if len(known) < 2 or known[0].off * known[1].off <= 0:
        return None
    less = min(known, key=lambda family: abs(family.off))
    return Lean(less.off, max(family.sigma for family in known))


def turn_of_rows(segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"]) -> Lean | None:
    """By how much the unbroken joints turn from one third of a field, and what lies around it, to the other.

    Along the rows or across them, whichever is more; None where too few joints are seen. A few stones of a
    wave are rows wherever it is straight enough, but it goes on beside them. The fit, of rows, is at the
    photo's own resolution.
    """
    ground = on_ground(segments.ends_px, fit.camera, fit.cam_from_ground)
    turns = [
        _turn(ground, fit, field, ALONG_X, axis, margin=AROUND, longest=np.inf) for axis in (ALONG_X, ALONG_Y)
    ]
    return max((turn for turn in turns if turn is not None), key=lambda t: abs(t.angle), default=None)


def _turn(
    ground: Float[np.ndarray, "n 2 2"],
    fit: Fit,
    field: Float[np.ndarray, "k 2"],
    family: int,
    axis: int,
    *,
    margin: float = 0.0,
    longest: float = LONGEST,
) -> Lean | None:
    """By how much the median direction of a family's segments turns along an axis of the ground.

    Of those that `_off` takes; None where they are too few, or where it does not turn but jumps.
    """
    off, middle = _off(ground, fit, field, family, margin=margin, longest=longest)
    ends = _ends(off, middle[:, axis])
    if ends is None:
        return None
    between = np.abs(off - 0.5 * (ends.first + ends.last)) <= 0.25 * abs(ends.turn.angle)
    return None if np.mean(between) < LEAST_BETWEEN else ends.turn


class _Ends(NamedTuple):
    """Median directions of the first and the last third of segments, and the sigma of their difference."""

    first: float
    last: float
    sigma: float

    @property
    def turn(self) -> Lean:
        """From the first to the last."""
        return Lean(self.last - self.first, self.sigma)


def _ends(off: Float[np.ndarray, " m"], place: Float[np.ndarray, " m"]) -> _Ends | None:
    """Directions of segments at the ends of their places; None where too few are seen."""
    if len(off) < 3 * FEWEST_SEGMENTS:
        return None
    low, high = np.quantile(place, [1 / 3, 2 / 3])
    ends = [off[place <= low], off[place >= high]]
    first, last = (float(np.median(end)) for end in ends)
    sigmas = [MEDIAN_LOSS * spread(end) / np.sqrt(len(end)) for end in ends]
    return _Ends(first, last, float(np.hypot(*sigmas)))


def _off(
    ground: Float[np.ndarray, "n 2 2"],
    fit: Fit,
    field: Float[np.ndarray, "k 2"],
    family: int,
    *,
    margin: float = 0.0,
    longest: float = LONGEST,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 2"]]:
    """Angles of a family's segments off the lattice's direction, and their middles.

    Each lies between two joints of the other family, and is a good part of a slab long, or up to `longest`
    slabs. Those around the field, within a `margin` of so many of its sizes, count as well.
    """
    middle = ground.mean(1)
    side = fit.grid.slab_size[family]
    length = np.linalg.norm(ground[:, 1] - ground[:, 0], axis=1) / side
    off = off_angle(ground[..., ::-1]) if family == ALONG_X else -off_angle(ground)
    own = inside_box(middle, field, margin) & (length > SHORTEST) & (length < longest)
    own &= np.abs(off) < FANNED_RAD
    return off[own], middle[own]
