"""A linear mixed model of irregular slabs: the likeliest pose, and how sure it is.

The places of neighbouring joints are no independent measurements. Each joint lies off its line by

    J dp + place + lift + turn of the slabs on either side + course + drift + relief + common shift + bloom
        + noise,

where every slab's place, height and turn are random, and so is the place of every course, whose slabs were
laid along one string, and which goes on from where the one before it lies, so that courses drift. Where all
joints are lines, those of a family may be askew, or fan out, by as much as courses lie aside: a tilted pose
imitates that, and no residual shows it. Calibrated views of a printed board, whose own shape was solved for
along with the cameras, are so; without this a third of their 95 % regions held the truth.
The relief is the shift of a joint seen aslant: a lit wall of the far slab looks like the slab, and so the
joint looks narrower and nearer than it is, never wider or farther: these effects have a mean. What the joints
of a family are off by together beyond that shows in no residual: its size is that measured on ray-traced
pavings. Where both edges of a joint are told apart, its width is a second measurement, off by all of these
but J dp. Bright tiles that meet dark ones without a joint bloom: every edge is moved towards the dark one.
This is a linear mixed model (Searle, Casella, McCulloch, Variance Components, ch. 6 and 9): the sizes of the
random effects come from the photo's own residuals by restricted maximum likelihood, and the pose by
generalised least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from autoreg.fitting.fit import Fit
from autoreg.numbering import numbered
from autoreg.slabs.slab_equations import RELIEFS, Sizes, SlabEquations
from autoreg.solve.joint_data import MOTION
from autoreg.solve.solver import Prior
from autoreg.spread import spread_about

# What courses drift by from each to the next, in sizes of the place.
DRIFTS = (0.0, 0.3, 1.0, 3.0)
# What is tried in turn: factors of the place's size, sizes of lift, turn and courses as shares of it, of what
# is common to a family, and of the courses' drift, from those that are tried first. Slabs that lie aside
# mostly lie askew as well, and have worn or split edges: a turn of half the place moves a side's ends by a
# quarter of it. If sides were thought straighter than they are, a few long ones would tell the pose by their
# directions alone.
WIDE_SEARCHES = (
    ((0.3, 0.6, 1.6, 2.5), (0.0, 1.0), (0.0, 0.12, 1.0, 2.0), (0.0, 0.8, 2.0), (2.0, 4.0), DRIFTS),
    ((0.5, 0.75, 1.3), (), (), (0.0, 0.8, 2.0, 5.0), (1.0, 2.0, 4.0, 8.0), DRIFTS),
)
FIRST = (0.33, 0.5, 0.3, 1.0, 0.0)
# Near an earlier estimate, finely: how much evener another camera makes the slabs is judged by it.
NEAR_SEARCHES = (
    ((0.45, 0.7, 1.4), (), (), (0.0, 0.8, 2.0), (), DRIFTS),
    ((0.85, 1.18), (), (), (), (), ()),
)
# How many times as large as usual what the joints of a family are off by together may be, and how likely
# each is beforehand: chamfers, worn rims and deep shadows do more than the plain walls that the usual is of.
# What of it changes with the slope of the view shows in the residuals; what does not goes with it.
TIMES_TOGETHER = {1.0: 0.65, 2.0: 0.2, 4.0: 0.1, 8.0: 0.05}
USUAL = list(TIMES_TOGETHER).index(1.0)
FLAT = RELIEFS.index(0.0)
# Factors of the likeliest place's size over which the answer is averaged, from it downwards and upwards, and
# by how much less likely one is that no longer counts, nor do those beyond.
LIKELY, NEGLIGIBLE_NATS = ((1.0, 0.75, 0.55), (1.33, 1.8)), 9.0
# Where the widths tell the relief, its shape varies beyond the model: the variance is this much larger, as
# measured on ray-traced pavings. That shows where the slabs lie even: such shapes are some hundredths of the
# joints' width, and the scatter of slabs that lie aside by more than this share of it outweighs them.
MISFIT, DROWNED = 1.6, 0.03
# ... and what the relief moves the pose by is known to no better than this share of itself.
VAGUE = 0.3
# The sizes of the effects are searched on blocks of so many slabs square, with about so many stations in all.
BLOCK_SLABS, SEARCHED = 4, 600
# Height of the bow that even ground may have, as a share of its extent: 3 mm under a straightedge of 2 m.
BOW = 0.0015


@dataclass(frozen=True)
class Scatter:
    """Standard deviations of the slabs' irregularity, in the unit of the pose (`turn` in radians).

    `lift` and `turn` are of slabs, like `place`; `course` is what the joints of one line lie aside together,
    and those of a family at its ends, and `drift` by how much more or less those of the next one do; `relief`
    is a share of half the joint's width. `together` is how many times as large as usual what a family's
    joints are off by is. `misfit` is the factor, in variance, by which joints agree on being off beyond what
    all of these explain.
    """

    place: float
    lift: float
    turn: float
    course: float
    drift: float
    relief: float
    together: float
    misfit: float

    @property
    def aside(self) -> float:
        """Standard deviation of what slabs lie aside, by their own places and by those of their courses."""
        return float(np.linalg.norm([self.place, self.course, self.drift]))


@dataclass(frozen=True)
class Estimate:
    """Solution of the mixed model: a small motion from the fit, its covariance, and the scatter.

    The motion is of the solver's parameters, and of an odd bond's shift behind them. `by_relief` is the part
    of it that flat joints would not ask for.
    """

    parameters: Float[np.ndarray, " s"]
    by_relief: Float[np.ndarray, " s"]
    covariance: Float[np.ndarray, "s s"]
    scatter: Scatter


class _Likely(NamedTuple):
    """Log likelihood, motion and covariance by sizes of the place, of what is common, and of the relief."""

    value: Float[np.ndarray, "k t r"]
    motion: Float[np.ndarray, "k t r p"]
    covariance: Float[np.ndarray, "k t r p p"]


class _Looked(NamedTuple):
    """Log likelihood of some sizes with the likeliest relief, that relief, and the sizes."""

    value: float
    relief: float
    sizes: Sizes


def estimate_motion(
    fit: Fit,
    mask: Float[np.ndarray, " p"],
    prior: Prior,
    near: Scatter | None = None,
    *,
    bow: float = 0.0,
    widths: bool = True,
    drifts: bool = True,
    search: bool = True,
) -> Estimate:
    """The mixed model's motion of the free parameters from the fit, averaged over likely scatters.

    What is common to a family counts as usual for the motion; that it may be more adds to the covariance.

    Args:
        fit: a converged fit; its Jacobian tells what the parameters move.
        mask: ones for the free parameters.
        prior: what is known of them, counted from the fit.
        near: the scatter of an earlier estimate of this photo, near which to search instead of everywhere.
        search: whether to search at all; else the earlier scatter is taken as it is.
        bow: how far from a plane the ground may be bent, as a share of its extent (standard deviation).
        widths: whether the joints' widths have a say.
        drifts: whether courses may drift.
    """
    rows = np.flatnonzero(fit.usable)
    if near is not None and not search:
        sizes, relief = _sizes_of(near, fit.grid.slab_side), near.relief
        model = SlabEquations(fit, mask, prior, bow, rows, widths, sizes, drifts=drifts)
    else:
        some = _in_blocks(fit, rows)
        model = SlabEquations(fit, mask, prior, bow, some, widths, drifts=drifts)
        sizes, relief = _likeliest_sizes(model, near)
        if len(some) < len(rows):
            model = SlabEquations(fit, mask, prior, bow, rows, widths, sizes, drifts=drifts)
        else:
            model.begin_anew()
    for _ in range(2):
        model.reweigh(sizes, relief)
    likely = _likely(model, sizes)
    weight = _weights(likely.value)
    # Odd joints that are let lie off by more let the pose follow them: it is that of usual ones.
    usual, motions = likely.value[:, USUAL], likely.motion[:, USUAL]
    mean = np.tensordot(_weights(usual), motions, 2)
    # What differs between likely scatters is uncertainty too; it matters where slabs are few.
    away = likely.motion - mean
    inner = likely.covariance + away[..., :, None] * away[..., None, :]
    by_relief = mean - np.tensordot(_weights(usual[:, FLAT]), motions[:, FLAT], 1)
    sunk = 1.0 - float(weight[..., FLAT].sum())
    misfit = _misfit(model, sizes, relief, sunk) if near is None else near.misfit
    spread = np.tensordot(weight, inner, 3) * misfit + VAGUE**2 * np.outer(by_relief, by_relief)
    (parameters, relieved), covariance = np.zeros((2, MOTION)), np.zeros((MOTION, MOTION))
    parameters[model.free], relieved[model.free] = mean * model.unit, by_relief * model.unit
    covariance[np.ix_(model.free, model.free)] = spread * np.outer(model.unit, model.unit)
    relief = RELIEFS[int(likely.value.max((0, 1)).argmax())]
    scatter = _scatter_of(sizes, fit.grid.slab_side, relief, misfit)
    return Estimate(parameters, relieved, covariance, scatter)


def _misfit(model: SlabEquations, sizes: Sizes, relief: float, sunk: float) -> float:
    """How much larger the variance is than the model's, of joints that are `sunk` with such a probability."""
    if not len(model.joints.wide):
        model.factor(sizes)
        return max(1.0, model.misfit(relief))
    aside = sizes.place * float(np.linalg.norm([1.0, sizes.course, sizes.drift]))
    aside /= DROWNED * model.joints.width
    return 1.0 + (MISFIT - 1.0) * sunk / (1.0 + aside**2)


def _weights(value: Float[np.ndarray, "*k"]) -> Float[np.ndarray, "*k"]:
    """Probabilities of scatters whose log likelihoods these are."""
    weight = np.exp(value - value.max())
    return weight / weight.sum()


def _likely(model: SlabEquations, sizes: Sizes) -> _Likely:
    """What scatters of about the likeliest size of the place say.

    Whatever is common to a family is gone through as well, within each size of the place.
    """
    found: list[_Likely] = []
    best = -np.inf
    for way in LIKELY:
        for factor in way:
            solved: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
            for together, likely in TIMES_TOGETHER.items():
                model.factor(sizes._replace(place=factor * sizes.place, together=together))
                value, motion, covariance = model.solve()
                solved.append((value + np.log(likely), motion, covariance))
            found.append(_Likely(*map(np.stack, zip(*solved, strict=True))))
            likelihood = float(found[-1].value.max())
            best = max(best, likelihood)
            if likelihood < best - NEGLIGIBLE_NATS:
                break
    return _Likely(*map(np.stack, zip(*found, strict=True)))


def _sizes_of(scatter: Scatter, side: float) -> Sizes:
    """The sizes that an earlier estimate found, for slabs of such a side."""
    place, turn = scatter.place, scatter.turn * side
    return Sizes(
        place,
        scatter.lift / place,
        turn / place,
        scatter.course / place,
        scatter.together,
        scatter.drift / place,
    )


def _scatter_of(sizes: Sizes, side: float, relief: float, misfit: float) -> Scatter:
    """What an estimate says of slabs of such a side."""
    place, lift, turn, course, together, drift = sizes
    return Scatter(
        place, place * lift, place * turn / side, place * course, place * drift, relief, together, misfit
    )


def _in_blocks(fit: Fit, rows: Int[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    """Some of the stations, in whole blocks of slabs spread over the ground: neighbours tell the scatter."""
    size = BLOCK_SLABS * np.array(fit.grid.slab_size)
    block = np.floor(fit.stations.ground[rows] / size).astype(int)
    member, first = numbered(*block.T)
    names, count = block[first], np.bincount(member)
    # An order in which near and far blocks, left and right ones follow each other.
    order = np.argsort((5 * names[:, 0] + 3 * names[:, 1]) % 13, kind="stable")
    wanted = order[: 1 + int(np.searchsorted(np.cumsum(count[order]), SEARCHED))]
    return rows[np.isin(member, wanted)]


def _likeliest_sizes(model: SlabEquations, near: Scatter | None) -> tuple[Sizes, float]:
    """Sizes and relief of highest restricted likelihood.

    Coordinate search from an earlier estimate, or from the residuals' scatter on the ground: each size in
    turn over a few values, the relief with every one.
    """
    if near is None:
        joints = model.joints
        ground = spread_about(joints.off_px[: len(joints.rows)] / joints.px_per_unit) + 1e-12
        best, relief, searches = Sizes(ground, *FIRST), 0.5, WIDE_SEARCHES
    else:
        best, relief, searches = _sizes_of(near, model.joints.fit.grid.slab_side), near.relief, NEAR_SEARCHES
    model.reweigh(best, relief)
    for search in searches:
        found = _looked_at(model, best)
        for axis, options in enumerate(search):
            found = _climbed(model, found, axis, options)
        _, relief, best = found
        model.reweigh(best, relief)
    return best, relief


def _climbed(model: SlabEquations, found: _Looked, axis: int, options: tuple[float, ...]) -> _Looked:
    """The likeliest by one of the sizes: from where it stands downwards and upwards as long as that helps."""
    start = found.sizes
    # Places are given as factors.
    now, unit = (start[axis], 1.0) if axis else (1.0, start.place)
    below, above = [o for o in options if o < now], [o for o in options if o > now]
    for way in (sorted(below, reverse=True), above):
        for option in way:
            looked = _looked_at(model, start._replace(**{Sizes._fields[axis]: option * unit}))
            if looked.value <= found.value:
                break
            found = looked
    return found


def _looked_at(model: SlabEquations, sizes: Sizes) -> _Looked:
    """The highest log likelihood of the sizes, whatever the relief is, and the relief that has it."""
    value, relief = max((value, relief) for relief, value in model.evidence(sizes).items())
    return _Looked(value + float(np.log(TIMES_TOGETHER[sizes.together])), relief, sizes)
