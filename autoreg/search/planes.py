"""Lattices on the hypothesised grounds that are worth the time to look into."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from autoreg.ground.sight import Looks
from autoreg.paving.lattice_evidence import Paving, told_twice
from autoreg.paving.lay import lay_first
from autoreg.paving.plane_combs import (
    PROMISING_NATS,
    SHARPENED,
    Hypothesis,
    PlaneCombs,
    planes_as_they_came,
    sharpened,
    with_other_focals,
)
from autoreg.segments import Segments
from autoreg.solve.freedom import Free

# How many grounds are looked into, those with the clearest joints first.
MOST_PLANES = 3
# Beyond this margin the clearest ground's lattice is clear enough to leave grounds whose joints carry less
# than this share of its own, as they came.
CLEAR_NATS, LESS_CLEAR = 20.0, 0.5
# Grounds whose joints are told by their strength are promising beyond this: other things are stronger than
# their surroundings, too.
STRONG_NATS = 20.0
# Where none of them has a lattice, so many other focal lengths of the clearest one are looked into.
MOST_FOCALS = 5


def lay_planes(
    looks: Looks,
    segments: Segments,
    hypotheses: list[Hypothesis],
    best: tuple[Paving, ...],
    lay: Callable[[PlaneCombs], tuple[Paving, ...]],
    *,
    free_focal: bool,
) -> tuple[tuple[Paving, ...], list[PlaneCombs]]:
    """The best lattices of these and of those on the hypothesised grounds, and the grounds looked into.

    To sharpen a plane takes a good part of a second, and to lay a lattice on it some: that which is
    clearest as it came goes first, and where it shows a clear lattice those that are far less clear are left.
    """
    planes = planes_as_they_came(looks, hypotheses)
    if not planes:
        return best, []
    (first,) = sharpened(looks, segments, planes[:1], free_focal=free_focal)
    best = better(best, lay(first))
    if _is_sure(best):
        return best, [first]
    clear = bool(best) and best[0].margin_nats > CLEAR_NATS
    others = [plane for plane in planes[1:] if not clear or plane.score > LESS_CLEAR * planes[0].score]
    others = sharpened(looks, segments, others, SHARPENED - 1, free_focal=free_focal)
    ranked = sorted([first, *others], key=lambda plane: -plane.score)[:MOST_PLANES]
    return _laid_on([plane for plane in ranked if plane is not first], best, lay), ranked


def lay_promising(
    looks: Looks,
    segments: Segments,
    planes: list[PlaneCombs],
    lay: Callable[[PlaneCombs], tuple[Paving, ...]],
    *,
    free_focal: bool,
) -> tuple[tuple[Paving, ...], list[PlaneCombs]]:
    """The best lattices on those grounds, as they came, whose joints are clear, if any are, and the grounds.

    Where lines are told by their strength, most segments may be those of a grain, by which a ground is not
    sharpened but led astray: the clearest one is looked into as it came as well.
    """
    least = STRONG_NATS if looks.fine.strong else PROMISING_NATS
    promising = [plane for plane in planes if plane.score > least][:MOST_PLANES]
    ranked = sharpened(looks, segments, promising, free_focal=free_focal)
    as_it_came = [plane for plane in promising[:1] if looks.fine.strong and id(plane) not in map(id, ranked)]
    return _laid_on([*ranked, *as_it_came], (), lay), ranked


def _laid_on(
    planes: list[PlaneCombs], best: tuple[Paving, ...], lay: Callable[[PlaneCombs], tuple[Paving, ...]]
) -> tuple[Paving, ...]:
    """The best of these lattices and of those on some planes, which are looked into until one is sure."""
    for plane in planes:
        if _is_sure(best):
            break
        best = better(best, lay(plane))
    return best


def better(best: tuple[Paving, ...], others: tuple[Paving, ...]) -> tuple[Paving, ...]:
    """Those lattices of the two whose first explains the picture better."""
    return max(best, others, key=lambda pavings: pavings[0].margin_nats if pavings else -np.inf)


def is_there(pavings: tuple[Paving, ...]) -> bool:
    """Whether the first of some lattices does better than chance."""
    return bool(pavings) and pavings[0].margin_nats > 0


def _is_sure(pavings: tuple[Paving, ...]) -> bool:
    """Whether the first of some lattices is plain to see, or two starts on its ground led to it clearly."""
    return is_plain(pavings) or told_twice(pavings)


def is_plain(pavings: tuple[Paving, ...]) -> bool:
    """Whether the first of some lattices is there, and plain to see."""
    return bool(pavings) and pavings[0].plain


def by_other_focals(looks: Looks, planes: list[PlaneCombs], free: Free) -> tuple[Paving, ...]:
    """The lattice that is plain to see on the clearest plane by another focal length, if any is.

    By the right one the first start shows it: others, which take several times as long, never did.
    """
    if not planes or planes[0].score < PROMISING_NATS:
        return ()
    for plane in with_other_focals(looks, planes[0])[:MOST_FOCALS]:
        laid = lay_first(looks, plane, free)
        if laid is not None and laid.plain:
            return (laid,)
    return ()
