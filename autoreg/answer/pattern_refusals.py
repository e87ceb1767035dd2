"""Why what repeats as slabs would are no slabs in straight rows, but another pattern of stones, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autoreg.errors import Refusal
from autoreg.fitting.one_edge import MOST as MOST_ONE_EDGED
from autoreg.paving.meetings import Meetings
from autoreg.paving.patterns import BROKEN_P
from autoreg.rows.arcs import Arc
from autoreg.rows.cross_joints import Lean
from autoreg.rows.turning_stones import Directions

# The joints across those of rows, or all of a field of stones, turn by less than this from the first rows to
# the last, or from one side to the other: by some tenths of a degree in slabs. Where so much cannot be told
# from none, it may well be.
MOST_FANNED_DEG, FANNED_SIGMAS = 8.0, 2.5
# Both families of a lattice's joints do not scatter in direction by more than this. Of right answers the
# family with less of it does by 4.2 at most (wickerwork; elsewhere by 2.1), of waves that passed by 6.4.
MOST_ASKEW_DEG = 5.5
# ... but where more than this share of the edges runs along the lattice, these are its joints among others:
# of waves and fans 0.17 at most do, of slabs a third of which furniture covers 0.4.
MOST_ALONG = 0.3
# Joints run along their lattice: those of pinwheels of large and small squares lie 2 degrees across what
# looks like a lattice of theirs, others by 0.3 at most.
MOST_OFF_DEG, OFF_SIGMAS = 1.0, 5.0
# Joints of slabs do not all run aslant of their rows, by so much at least, as much to either side: those of
# hexagons do by 30 degrees, and scatter about that by a small part of it. So many of them run to either side,
# and next to none along the rows.
LEAST_ZIGZAG_DEG, SLANT_SCATTER, LEAST_RARER, MOST_ALONG_ZIGZAG = 10.0, 0.2, 0.2, 0.05
# Straight joints turn alike by less than this from end to end: by up to three through an untold lens.
MOST_ARC_DEG, ARC_SIGMAS = 3.5, 4.0
# Up to this, joints bow in straight paving too, where the ground is bent or the lens is another one: then
# those across them do not turn along, as they do between the stones of arcs, but surely by a smaller
# share than this.
MOST_BENT_DEG, TURNS_ALONG, ALONG_SIGMAS = 8.0, 0.5, 2.0
# Of the edges along a lattice's joints so many lie inside its slabs, over the share of those that lie
# anywhere, where the slabs are cells of a pattern: 1.0 and more in herringbone, 0.3 at the most in real ones.
MOST_INNER = 0.5
# Of the crossings of a stack bond that a joint passes through, another joint crosses it in most: in right
# answers it does not in 0.33 of them at the most, however much is hidden, in ashlar on a module in 0.88.
# Fewer crossings tell nothing.
MOST_UNCROSSED, FEWEST_MEETINGS = 0.6, 40


class PatternRefusal(Refusal):
    """The refusal of joints that are plain to see, and are those of another pattern."""


def fanned(change: Lean | None) -> PatternRefusal | None:
    """The refusal of joints that turn from row to row as those across arcs do; None if they may not."""
    return _curved(
        change,
        MOST_FANNED_DEG,
        FANNED_SIGMAS,
        "the joints across these rows turn by {:.0f} degrees from the first rows to the last, as those of "
        "fans and waves do; photograph slabs with right angles",
    )


def turning(turn: Lean | None) -> PatternRefusal | None:
    """The refusal of stones that turn across their field as those of fans do; None if they may not."""
    return _curved(
        turn,
        MOST_FANNED_DEG,
        FANNED_SIGMAS,
        "these stones turn by {:.0f} degrees from one side of their field to the other, as those of fans and "
        "rings do; photograph slabs in straight rows",
    )


def askew(run: Sequence[Directions | None]) -> PatternRefusal | None:
    """The refusal of stones both families of whose joints scatter in direction; None if they do not.

    Nor if those of either mostly run along the lattice and what is strewn over them does not.
    """
    seen = [family for family in run if family is not None]
    known = [float(np.degrees(family.scatter)) for family in seen]
    if len(known) < len(run) or min(known) < MOST_ASKEW_DEG or max(f.along for f in seen) > MOST_ALONG:
        return None
    return PatternRefusal(
        "no_lattice",
        f"the joints of these stones run {min(known):.0f} degrees askew of each other (standard deviation), "
        "as those of waves, fans and crazy paving do; photograph slabs in straight rows",
        measured=min(known),
        limit=MOST_ASKEW_DEG,
    )


def zigzag(run: Sequence[Directions | None]) -> PatternRefusal | None:
    """The refusal of stones whose joints run aslant to both sides of a lattice's; None if they do not."""
    for family in run:
        if family is None or np.degrees(family.aslant) < LEAST_ZIGZAG_DEG:
            continue
        even = family.slant_scatter < SLANT_SCATTER * family.aslant and family.rarer > LEAST_RARER
        if even and family.along < MOST_ALONG_ZIGZAG:
            return PatternRefusal(
                "no_lattice",
                f"the joints between these rows run {np.degrees(family.aslant):.0f} degrees to one side of "
                "them and to the other, as those of hexagons do; photograph slabs with right angles",
                measured=round(float(np.degrees(family.aslant)), 1),
                limit=LEAST_ZIGZAG_DEG,
            )
    return None


def off_lattice(turn: Lean | None) -> PatternRefusal | None:
    """The refusal of a lattice across which its stones lie; None if they do not."""
    return _curved(
        turn,
        MOST_OFF_DEG,
        OFF_SIGMAS,
        "what repeats here does so {:.1f} degrees askew of its joints, as patterns of stones of several "
        "sizes do; photograph slabs in straight rows",
    )


def arcs(arc: Arc | None, across: Lean | None = None) -> PatternRefusal | None:
    """The refusal of unbroken joints that bow alike; None if they may be straight.

    Nor if those `across` them, which turn by so much from end to end of the arcs, do not turn with them.
    """
    if arc is not None and across is not None and abs(np.degrees(arc.turn)) < MOST_BENT_DEG:
        most = abs(across.angle) + ALONG_SIGMAS * across.sigma
        if most < TURNS_ALONG * abs(arc.turn):
            return None
    return _curved(
        None if arc is None else Lean(arc.turn, arc.sigma),
        MOST_ARC_DEG,
        ARC_SIGMAS,
        "the joints along these rows are arcs, which turn by {:.0f} degrees from end to end, as those of "
        "fans and waves do; photograph slabs in straight rows",
    )


def one_edged(share: float) -> Refusal | None:
    """The refusal of joints of which only one edge was met, as `one_edge` tells it; None if both were."""
    if share <= MOST_ONE_EDGED:
        return None
    return Refusal(
        "no_lattice",
        f"the ground beside these joints differs from one side to the other by {100 * share:.0f} % of their "
        "contrast, the same way at every joint, as where only one edge of wide joints was met; photograph "
        "slabs with joints narrower than a quarter of them, or from farther away",
        measured=round(share, 2),
        limit=MOST_ONE_EDGED,
    )


def filled(inner: float) -> PatternRefusal | None:
    """The refusal of a lattice whose slabs are full of edges along its joints; None if they are not."""
    if inner < MOST_INNER:
        return None
    return PatternRefusal(
        "no_lattice",
        "what repeats here as slabs would is full of joints itself, as herringbone and other patterns of "
        "several stones are; photograph slabs in straight rows",
        measured=round(inner, 2),
        limit=MOST_INNER,
    )


def in_part(parts: tuple[float, float] | None) -> PatternRefusal | None:
    """The refusal of joints that are there along the same part of every side; None if they are not."""
    if parts is None:
        return None
    return PatternRefusal(
        "no_lattice",
        "what repeats here as joints would is there along the same part of every side alone, as edges of "
        f"hexagons are (p-values {parts[0]:.2f} there, {parts[1]:.2f} beside it); photograph slabs with "
        "right angles, or give the camera with --camera",
        measured=round(parts[1], 2),
        limit=BROKEN_P,
    )


def on_module(meet: Meetings) -> PatternRefusal | None:
    """The refusal of joints that meet as those of stones of several sizes do; None if most of them cross.

    Where one family alone is hard to see, its joints do not pass through by themselves; where chance hides
    some of both, corners are left more often than joints that pass.
    """
    if meet.through < FEWEST_MEETINGS or meet.uncrossed < MOST_UNCROSSED:
        return None
    if 2 * min(meet.x_only, meet.y_only) <= meet.corners:
        return None
    return PatternRefusal(
        "no_lattice",
        f"at {100 * meet.uncrossed:.0f} % of the places where joints of one lattice would cross, one passes "
        "through alone or another ends at it, as between stones of several sizes; take slabs of one size",
        measured=round(meet.uncrossed, 2),
        limit=MOST_UNCROSSED,
    )


def _curved(turn: Lean | None, most_deg: float, sure_sigmas: float, message: str) -> PatternRefusal | None:
    """The refusal, by a message about its degrees, of a turn that is clear; None of one that is not."""
    degrees = None if turn is None else turn.clear_deg(most_deg, sure_sigmas)
    if degrees is None:
        return None
    return PatternRefusal("no_lattice", message.format(degrees), measured=round(degrees, 1), limit=most_deg)
