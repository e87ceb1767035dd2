"""The last step where slabs lie evenly: the pose at which drawn joints have the picture's grey levels.

Every pixel near a joint is y = sum of share_k(pose, joint widths, blur) tone_k + noise. The tones are those
of the slabs' corners and of the joint at each crossing, or at each piece of a long joint: random effects
about common means, whose variance the picture tells, eliminated block by block (variable projection: Golub
and Pereyra 1973). What is left is solved by Gauss-Newton steps with robust weights. Nothing is measured
before it is fitted, so that crossings and far joints tell what they know, and the pose comes near the
Cramér-Rao bound; but every slab is taken to lie where the lattice says.

Whether it does, the picture tells as well. White noise gives the score of a cell (a crossing with the joints
around it) the variance that the pixels' information claims; slabs that lie elsewhere, or stone that is no
noise, give it more, and make those of neighbours alike: the design effect (Kish 1965), the mean of g' H^-1 g
over cells and over pairs of neighbours, over what it should be. It scales the covariance, and where it is
large the slabs are not even, and nothing is said.

What moves all joints alike no scatter shows: shadows in them, a chamfer in the light, the lens. Such effects
are drawn as well, and the answer is averaged over how large they may be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtri

from autoreg.fitting.design_effect import Asked, design_effects
from autoreg.fitting.fit import LEAST_WEIGHT, Fit
from autoreg.grey_levels.cell_scores import told, told_by_cells, with_doubts
from autoreg.grey_levels.image_doubts import Averaged, Doubt, averaged_over
from autoreg.grey_levels.joint_image import Shape
from autoreg.grey_levels.joint_pixels import JOINT
from autoreg.grey_levels.near_joints import CLEAR_BLURS, joint_pixels
from autoreg.grey_levels.photometric_step import (
    UNKNOWNS,
    Step,
    first_state,
    moved_shape,
    stepped,
    stepped_on,
)
from autoreg.ground.sides import Sides, visible_sides
from autoreg.numbering import numbered
from autoreg.solve import joint_data as terms

# Pixels that are looked at: more tell little more, and cost time. Of joints that are blurred by more than so
# many pixels each tells less, and as many more are looked at.
MOST_PIXELS, MORE_FROM_PX = 80_000, 1.5
MOST_STEPS = 5
# The first steps look at one pixel of so many.
ROUGHLY = 5
# A pass ends where the next step would be this small, in standard deviations of all that is solved for, if it
# were as much smaller than the last as that was than the one before: the rough pass, and the whole one.
ROUGHLY_STILL_SIGMAS, STILL_SIGMAS = 1.0, 0.5
# The design effect of even slabs: one for white noise, up to five as measured on textured stone. Places that
# are off by as much as the pixels' noise hides in a cell double it; those of real slabs raise it to hundreds.
MOST_DESIGN_EFFECT = 8.0
# ... judged by no fewer cells than this beyond the number of unknowns.
SPARE_CELLS = 4
# Looks that have changed by more than these factors have run away. The width of a joint that is narrower than
# the blur is hard to tell from its depth, so that a strip fitted to it may be several times too wide.
NARROWEST, WIDEST = 0.1, 3.0
# A pose that is so unlikely by the joints' measured places is none.
CONTRADICTION = 1e-4
# What joints' halves differ by at least and at most: so many standard deviations less and more.
AT_LEAST, AT_MOST = 3.0, 2.0
# A side takes part if this share of its stations does.
USABLE_SHARE = 0.5
# What the joints of a family may lie off by together, in widths, as ray-traced prints do: walls a tenth of a
# millimetre high are enough.
TOGETHER = 0.01
# What the drawing leaves out: sides of joints that differ, by grey levels in the joint and beside it, the
# lens's first coefficient, pixels that the whole picture is moved by, as ray-traced prints are (0.003 to
# 0.005), and what a family's joints lie off by together, which looks like another pose. Real shadows have
# other shapes than those drawn: what they do is known to no better than itself.
HALVES = Doubt((0, 1), (0.3, 1.0, 3.0, 10.0, 30.0), 0.5, 0.2, 1.0)
DOUBTS = (
    HALVES,
    Doubt((2, 3), (0.3, 1.0, 3.0, 10.0, 30.0), 0.5, 0.2, 1.0),
    Doubt((4,), (3e-5, 1e-4, 3e-4, 1e-3, 3e-3), 0.5, 1e-5, 0.2),
    Doubt((5, 6), (0.003,), 0.0, 0.0, 0.0),
    Doubt((7, 8, 9, 10), (1.0,), 0.0, 0.0, 0.0),
)
# The shift of an odd bond besides: the measured joints have told it to some ten-thousandths of a slab.
ODD_SHIFT = Doubt((11,), (3e-5, 1e-4, 3e-4, 1e-3), 1e-6, 0.0, 0.0)


@dataclass(frozen=True)
class Photometric:
    """A fit at the pose of the grey levels, how sure it is, and what it rests on.

    `plain` is the covariance if joints look just as they are drawn, `doubted` what is added as they may not:
    of the same as a `spread`, but for a bond's shift, which the measured joints tell, and the picture hardly
    more. `away` is the motion from the fit that was given, of the same. `lopsided` is by how much the joints'
    far and near halves differ at least and at most, as a share of their contrast.
    """

    fit: Fit
    plain: Float[np.ndarray, "8 8"]
    doubted: Float[np.ndarray, "8 8"]
    away: Float[np.ndarray, "8"]
    lopsided: tuple[float, float]
    noise_grey: float
    design_effect: float
    pixels: int

    @property
    def spread(self) -> Float[np.ndarray, "8 8"]:
        """Covariance of the pose, the sides' ratio and the shift."""
        return self.plain + self.doubted

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of the pose."""
        return self.spread[:6, :6]


def on_grey_levels(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    covariance: Float[np.ndarray, "6 6"],
    reach: float,
    field: Float[np.ndarray, "k 2"] | None = None,
    together: float = TOGETHER,
) -> Photometric | None:
    """The fit moved to the pose of the picture's grey levels; None if its slabs do not lie evenly enough.

    None as well for rows, for a camera that is itself solved for, and where the joints are too few.

    Args:
        picture: grey levels that the fit's camera belongs to.
        fit: a converged fit.
        covariance: of its pose, on the camera's side, as irregular slabs leave it.
        reach: how far to look, in heights of the camera.
        field: where on the ground the paving is; everywhere if None.
        together: what the joints of a family may be off by together, as a share of their width.
    """
    if fit.grid.spacing_x is None or fit.free.focal or fit.free.centre or fit.free.radial:
        return None
    shape = Shape(fit.cam_from_ground, fit.grid, fit.strip.width, fit.strip.blur_px)
    sides = _sides(fit, reach, field)
    most = round(MOST_PIXELS * max(1.0, shape.blur_px / MORE_FROM_PX))
    pixels = joint_pixels(
        picture, fit.camera, shape.pose, shape.grid, sides, shape.width, shape.blur_px, most
    )
    if pixels.cells < SPARE_CELLS + UNKNOWNS:
        return None
    state, last = first_state(pixels.thinned(ROUGHLY), shape, fit), None
    for every, still in ((ROUGHLY, ROUGHLY_STILL_SIGMAS), (1, STILL_SIGMAS)):
        some = pixels.thinned(every)
        # The first pass knows no tones that pixels could be held against.
        state = replace(state, weight=None if every == 1 else np.ones(len(some)))
        before = 0.0
        for n in range(MOST_STEPS):
            # The first of all pixels finds the weights that the second goes by.
            last = stepped_on(last) if last and every == 1 and n > 1 else stepped(some, state)
            if last is None or not _sound(last.state.shape, shape):
                return None
            state, shrinks = last.state, min(1.0, last.sigmas / before) if before else 1.0
            before = last.sigmas
            if shrinks * last.sigmas < still:
                break
    if last is None:
        return None
    try:
        return _judged(last, fit, covariance, together)
    except np.linalg.LinAlgError:
        # Something that is asked for cannot be told from what is doubted.
        return None


def _sides(fit: Fit, reach: float, field: Float[np.ndarray, "k 2"] | None) -> Sides:
    """The sides that can be told apart, without those whose stations were refused."""
    least = CLEAR_BLURS * fit.strip.blur_px
    sides = visible_sides(fit.camera, fit.cam_from_ground, fit.grid, reach=reach, field=field, min_px=least)
    stations = fit.stations
    good = fit.weight > LEAST_WEIGHT
    keys = np.stack([stations.family, stations.line, stations.cell], 1)
    number, first = numbered(*keys.T)
    share = np.bincount(number, good) / np.bincount(number)
    refused = {tuple(name) for name in keys[first][share < USABLE_SHARE].tolist()}
    mine = np.stack([sides.family, sides.line, sides.cell], 1).tolist()
    return sides.take(np.array([k for k, key in enumerate(mine) if tuple(key) not in refused], dtype=int))


def _sound(shape: Shape, start: Shape) -> bool:
    """Whether a step has stayed near where it began."""
    finite = np.isfinite(np.r_[shape.pose.R.ravel(), shape.pose.t, shape.width, shape.blur_px]).all()
    ratios = np.r_[np.array(shape.width) / start.width, shape.blur_px / start.blur_px]
    return bool(finite and (ratios > NARROWEST).all() and (ratios < WIDEST).all())


def _judged(
    last: Step, fit: Fit, covariance: Float[np.ndarray, "6 6"], together: float
) -> Photometric | None:
    """The answer, if its slabs are even and the joints' measured places do not contradict it."""
    state, pixels = last.state, last.pixels
    counted = int((np.bincount(pixels.cell, state.weight) > 0).sum())
    if counted < SPARE_CELLS + len(last.normal.free):
        return None
    answer, effect = _averaged(last, together)
    if effect > MOST_DESIGN_EFFECT:
        return None
    plain, doubted = (_answered(each, last.normal.free) for each in (answer.plain, answer.added))
    of_pose, whole = _away(fit, state.shape)[:6], covariance + (plain + doubted)[:6, :6]
    if of_pose @ np.linalg.solve(whole, of_pose) > chdtri(6, CONTRADICTION):
        return None
    step = np.zeros(UNKNOWNS)
    step[last.normal.free] = answer.step[: len(last.normal.free)]
    shape = moved_shape(state.shape, step)
    if fit.grid.odd_bond:
        more = float(answer.step[len(last.normal.free) + ODD_SHIFT.columns[0]])
        shape = replace(shape, grid=replace(shape.grid, shift=shape.grid.shift + more))
    moved = replace(
        fit.moved(_motion(fit, shape)),
        cam_from_ground=shape.pose,
        strip=replace(fit.strip, width=shape.width),
    )
    lopsided = _lopsided(last, answer)
    return Photometric(moved, plain, doubted, _away(fit, shape), lopsided, state.noise, effect, len(pixels))


def _answered(covariance: Float[np.ndarray, "k k"], free: Int[np.ndarray, " k"]) -> Float[np.ndarray, "8 8"]:
    """What is asked for of a covariance of the `free` unknowns: that of the pose, and of the sides' ratio."""
    rows = np.flatnonzero(free <= terms.RATIO)
    answered = np.zeros((len(terms.ANSWER), len(terms.ANSWER)))
    answered[np.ix_(free[rows], free[rows])] = covariance[np.ix_(rows, rows)]
    return answered


def _away(fit: Fit, shape: Shape) -> Float[np.ndarray, "8"]:
    """The motion from a fit to a shape, of what its covariance is of."""
    motion = _motion(fit, shape)
    moved = shape.pose.t - fit.cam_from_ground.t
    return np.r_[motion[terms.ROTATION], moved, motion[terms.RATIO], motion[terms.SHIFT]]


def _lopsided(last: Step, answer: Averaged) -> tuple[float, float]:
    """By how much the joints' halves differ at least and at most, as a share of their contrast."""
    halves, tone = list(HALVES.columns), last.state.tones.mean(0)
    differ, sigma = np.abs(answer.step[len(last.normal.free) :][halves]), answer.sigma[halves]
    contrast = max(abs(float(tone[:JOINT].mean() - tone[JOINT])), 1.0)
    least, most = float((differ - AT_LEAST * sigma).max()), float((differ + AT_MOST * sigma).max())
    return max(least, 0.0) / contrast, most / contrast


def _averaged(last: Step, together: float) -> tuple[Averaged, float]:
    """A last step of all unknowns, averaged over what is doubted, and the design effect of the pose."""
    known, noise = len(last.normal.free), last.state.noise
    doubts = (*DOUBTS, ODD_SHIFT) if last.state.shape.grid.odd_bond else DOUBTS
    doubted = sum(len(doubt.columns) for doubt in doubts)
    unknowns, last = np.r_[last.normal.free, UNKNOWNS + np.arange(doubted)], with_doubts(last, together)
    information, score = told(last, unknowns)
    ridge = np.diag(np.r_[np.zeros(known), 1e-12 + 1e-9 * np.diag(information)[known:]])
    asked = Asked.of(information + ridge, slice(0, 6))
    # Judged by what is left when all that is doubted has been taken out.
    scores, of_cells = told_by_cells(
        last, unknowns, asked.combined, np.linalg.solve(information + ridge, score)
    )
    effect = max(*design_effects(scores, of_cells, asked, last.pixels.places, noise), 1.0)
    variance = noise**2 * effect
    return averaged_over(doubts, information / variance, score / variance, known), effect


def _motion(fit: Fit, shape: Shape) -> Float[np.ndarray, " s"]:
    """The motion from a fit to a shape, where the turn swings the translation along."""
    motion = np.zeros(terms.MOTION)
    turn = shape.pose.R @ fit.cam_from_ground.R.T
    skew = 0.5 * (turn - turn.T)
    motion[terms.ROTATION] = skew[2, 1], skew[0, 2], skew[1, 0]
    motion[terms.TRANSLATION] = shape.pose.t - turn @ fit.cam_from_ground.t
    motion[terms.RATIO] = np.log((shape.grid.spacing_x or 1.0) / shape.grid.spacing_y) - np.log(
        (fit.grid.spacing_x or 1.0) / fit.grid.spacing_y
    )
    motion[terms.SHIFT] = shape.grid.shift - fit.grid.shift
    return motion
