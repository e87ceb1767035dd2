"""The last step where slabs lie evenly: the pose at which drawn joints have the picture's grey levels.

Every pixel near a joint is y = sum of share_k(pose, joint widths, blur) tone_k + noise. The tones are those
of the slabs' corners and of the joint at each crossing, or at each piece of a long joint: random effects
about common means, whose variance the picture tells, eliminated block by block (variable projection: Golub
and Pereyra 1973). What is left is solved by Gauss-Newton steps with robust weights. Nothing is measured
before it is fitted, so that crossings and far joints tell what they know, and the pose comes near the
Cramér-Rao bound; but every slab is taken to lie where the lattice says.

Whether it does, the picture tells as well. White noise gives the score of a cell (a crossing with the joints
around it) the variance that the pixels' information claims; slabs that lie elsewhere, or stone that is no
noise, give it more: the design effect (Kish 1965), the mean of g' H^-1 g over cells, over what it should be.
It scales the covariance, and where it is large the slabs are not even, and nothing is said.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_matrix
from scipy.special import chdtri

from autoreg import residuals as terms
from autoreg.freedom import stretched
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector
from autoreg.joint_image import JointImage, Shape, with_looks
from autoreg.joint_pixels import CLEAR_BLURS, JOINT, JointPixels, joint_pixels
from autoreg.refine import Fit
from autoreg.residuals import PARAMETERS
from autoreg.stations import Sides, visible_sides
from autoreg.tones import Blocks, tone_variances

# Pixels that are looked at: more tell little more, and cost time.
MOST_PIXELS = 80_000
MOST_STEPS = 5
# The first steps look at one pixel of so many.
ROUGHLY = 5
# Steps this small, in standard deviations of all that is solved for, are the last of the rough pass and of
# the whole one: the next would be some thirty times smaller.
ROUGHLY_STILL_SIGMAS, STILL_SIGMAS = 3.0, 8.0
# Looks change by at most this much at a time, in their logarithms.
MOST_LOOKS_STEP = 0.3
# Residuals beyond this many standard deviations count less, by the square.
ROBUST_SIGMAS = 3.0
# A cell whose mean square residual is so many times the rest's shows something else.
FOREIGN = 4.0
# Grey levels that even a drawn picture is off by.
LEAST_NOISE = 0.05
# The design effect of even slabs: one for white noise, up to five as measured on textured stone. Places that
# are off by as much as the pixels' noise hides in a cell double it; those of real slabs raise it to hundreds.
MOST_DESIGN_EFFECT = 8.0
# ... judged by no fewer cells than this beyond the number of unknowns.
SPARE_CELLS = 8
# A pose that is so unlikely by the joints' measured places is none.
CONTRADICTION = 1e-4
# A side takes part if this share of its stations does.
USABLE_SHARE = 0.5
# Unknowns besides the tones of blocks: seven of the pose, three looks, the mean tones of slabs and of joints.
POSE, LOOKS, MEANS, UNKNOWNS = slice(0, 7), slice(7, 10), slice(10, 12), 12


@dataclass(frozen=True)
class Photometric:
    """A fit at the pose of the grey levels, its covariance on the camera's side, and what it rests on."""

    fit: Fit
    covariance: Float[np.ndarray, "6 6"]
    noise_grey: float
    design_effect: float
    pixels: int


@dataclass(frozen=True)
class _State:
    """The unknowns, what is known of the tones, and each pixel's robust weight."""

    shape: Shape
    fit: Fit
    tones: Float[np.ndarray, "m t"]
    noise: float
    weight: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class _Step:
    """Information and cells' scores of one Gauss-Newton step, where it led, and its size."""

    state: _State
    free: np.ndarray
    information: Float[np.ndarray, "k k"]
    scores: Float[np.ndarray, "c k"]
    sigmas: float


def on_grey_levels(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    covariance: Float[np.ndarray, "6 6"],
    reach: float,
    field: Float[np.ndarray, "k 2"] | None = None,
) -> Photometric | None:
    """The fit moved to the pose of the picture's grey levels; None if its slabs do not lie evenly enough.

    None as well for rows, for a camera that is itself solved for, and where the joints are too few.

    Args:
        picture: grey levels that the fit's camera belongs to.
        fit: a converged fit.
        covariance: of its pose, on the camera's side, as irregular slabs leave it.
        reach: how far to look, in heights of the camera.
        field: where on the ground the paving is; everywhere if None.
    """
    if fit.grid.spacing_x is None or fit.free.focal or fit.free.centre or fit.free.radial:
        return None
    shape = Shape(fit.cam_from_ground, fit.grid, fit.strip.width, fit.strip.blur_px)
    sides = _sides(fit, reach, field)
    pixels = joint_pixels(
        picture, fit.camera, shape.pose, shape.grid, sides, shape.width, shape.blur_px, MOST_PIXELS
    )
    if pixels.cells < SPARE_CELLS + UNKNOWNS:
        return None
    state, last = _first(pixels.thinned(ROUGHLY), shape, fit), None
    for every in (ROUGHLY, 1):
        some = pixels.thinned(every)
        state = replace(state, weight=np.ones(len(some)))
        for _ in range(MOST_STEPS):
            last = _stepped(some, state)
            if last is None or not _sound(last.state.shape, shape):
                return None
            state = last.state
            if last.sigmas < (STILL_SIGMAS if every == 1 else ROUGHLY_STILL_SIGMAS):
                break
    return None if last is None else _judged(last, pixels, fit, covariance)


def _sides(fit: Fit, reach: float, field: Float[np.ndarray, "k 2"] | None) -> Sides:
    """The sides that can be told apart, without those whose stations were refused."""
    least = CLEAR_BLURS * fit.strip.blur_px
    sides = visible_sides(fit.camera, fit.cam_from_ground, fit.grid, reach=reach, field=field, min_px=least)
    stations = fit.stations
    good = fit.usable & (fit.weight > 0.1)
    keys = np.stack([stations.family, stations.line, stations.cell], 1)
    names, number = np.unique(keys, axis=0, return_inverse=True)
    share = np.bincount(number.ravel(), good) / np.bincount(number.ravel())
    refused = {tuple(name) for name in names[share < USABLE_SHARE].tolist()}
    mine = np.stack([sides.family, sides.line, sides.cell], 1).tolist()
    return sides.take(np.array([k for k, key in enumerate(mine) if tuple(key) not in refused], dtype=int))


def _first(pixels: JointPixels, shape: Shape, fit: Fit) -> _State:
    """Tones by a ridge towards their common means, and the noise that they leave."""
    share = JointImage(pixels, shape).shares()
    common = np.stack([1.0 - share[:, JOINT], share[:, JOINT]], 1)
    means = np.linalg.lstsq(common.T @ common + 1e-6 * np.eye(2), common.T @ pixels.grey, rcond=None)[0]
    weight = np.ones(len(pixels))
    blocks = Blocks(pixels, share, weight)
    middle = np.r_[[means[0]] * JOINT, means[1]]
    tones = middle + blocks.solve(blocks.sums((pixels.grey - share @ middle)[:, None]), 0.02)[..., 0]
    noise = _scatter(pixels.grey - (share * tones[pixels.block]).sum(1), weight)
    return _State(shape, fit, tones, noise, weight)


def _stepped(pixels: JointPixels, state: _State) -> _Step | None:
    """One Gauss-Newton step of the pose, the looks and all tones."""
    image = JointImage(pixels, state.shape)
    share, weight = image.shares(), state.weight
    slopes = image.slopes(state.tones[pixels.block])
    columns = np.column_stack(
        [image.by_pose(slopes), slopes.by_looks, 1.0 - share[:, JOINT], share[:, JOINT], pixels.grey]
    )
    free = _free(state.fit)
    blocks = Blocks(pixels, share, weight)
    sums = blocks.sums(columns)
    variances = tone_variances(blocks, blocks.solve(sums[..., -1:], 1e-3)[..., 0], state.noise)
    ridge = state.noise**2 / np.r_[[variances[0]] * JOINT, variances[1]]
    solved = blocks.solve(sums, ridge)
    H = (columns * weight[:, None]).T @ columns - np.einsum("mtp,mtq->pq", sums, solved)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(H)[free], 1e-12))
    information = H[np.ix_(free, free)]
    scaled = information * np.outer(unit, unit)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e12:
        return None
    step = np.zeros(UNKNOWNS)
    step[free] = unit * np.linalg.solve(scaled, unit * H[free, -1])
    step[LOOKS] = np.clip(step[LOOKS], -MOST_LOOKS_STEP, MOST_LOOKS_STEP)
    means = np.r_[[step[10]] * JOINT, step[11]]
    off = solved[..., -1] - solved[..., :-1] @ step
    tones = off + means
    left = pixels.grey - (share * tones[pixels.block]).sum(1) - columns[:, :-3] @ step[: MEANS.start]
    noise = _scatter(left, weight)
    moved = replace(state, shape=_moved(state.shape, step), tones=tones, noise=noise)
    # Of the means, a step has no size: they are found anew each time.
    motion = np.where(free < MEANS.start, step[free], 0.0)
    sigmas = float(np.sqrt(motion @ information @ motion)) / noise
    scores = _cell_scores(pixels, blocks, columns[:, free], weight * left, left, solved[..., free])
    moved = replace(moved, weight=_robust(left, noise, pixels.cell))
    return _Step(moved, free, information, scores, sigmas)


def _cell_scores(
    pixels: JointPixels,
    blocks: Blocks,
    columns: Float[np.ndarray, "n k"],
    pull: Float[np.ndarray, " n"],
    left: Float[np.ndarray, " n"],
    solved: Float[np.ndarray, "m t k"],
) -> Float[np.ndarray, "c k"]:
    """Gradient of every cell's misfit by the unknowns, as far as no tone can imitate it."""
    n = len(pixels)
    gather = csr_matrix((pull, (pixels.cell, np.arange(n))), shape=(pixels.cells, n))
    imitated = np.einsum("mtk,mt->mk", solved, blocks.sums(left[:, None])[..., 0])
    cell = np.zeros(blocks.count, dtype=np.int64)
    cell[pixels.block] = pixels.cell
    scores = gather @ columns
    np.subtract.at(scores, cell, imitated)
    return scores


def _free(fit: Fit) -> np.ndarray:
    """Index of the unknowns that are solved for."""
    free = np.ones(UNKNOWNS, dtype=bool)
    free[6] = bool(fit.free.mask[terms.RATIO])
    # Tiles that meet without a joint have no width to be measured.
    free[LOOKS.start : LOOKS.start + 2] = np.array(fit.strip.polarity) != 0
    return np.flatnonzero(free)


def _moved(shape: Shape, step: Float[np.ndarray, " p"]) -> Shape:
    pose = Rigid(nearest_rotation(rotation_from_vector(step[:3]) @ shape.pose.R), shape.pose.t + step[3:6])
    half = 0.5 * float(step[6])
    grid = replace(
        shape.grid,
        spacing_x=(shape.grid.spacing_x or 1.0) * float(np.exp(half)),
        spacing_y=shape.grid.spacing_y * float(np.exp(-half)),
    )
    return replace(with_looks(shape, step[LOOKS]), pose=pose, grid=grid)


def _scatter(left: np.ndarray, weight: np.ndarray) -> float:
    """Standard deviation of the residuals that count, by their median."""
    counted = np.abs(left[weight > 0])
    return max(1.4826 * float(np.median(counted)), LEAST_NOISE) if len(counted) else LEAST_NOISE


def _robust(left: np.ndarray, noise: float, cell: np.ndarray) -> Float[np.ndarray, " n"]:
    """Weights: less for pixels far off, none for cells that as a whole are."""
    off = np.abs(left) / (ROBUST_SIGMAS * noise)
    weight = 1.0 / np.maximum(off, 1.0) ** 2
    square = np.bincount(cell, np.minimum(left**2, 25.0 * noise**2)) / np.maximum(np.bincount(cell), 1)
    return np.where(square[cell] > FOREIGN * noise**2, 0.0, weight)


def _sound(shape: Shape, start: Shape) -> bool:
    """Whether a step has stayed near where it began."""
    finite = np.isfinite(np.r_[shape.pose.R.ravel(), shape.pose.t, shape.width, shape.blur_px]).all()
    ratios = np.r_[np.array(shape.width) / start.width, shape.blur_px / start.blur_px]
    return bool(finite and (ratios > 0.3).all() and (ratios < 3.0).all())


def _judged(
    last: _Step, pixels: JointPixels, fit: Fit, covariance: Float[np.ndarray, "6 6"]
) -> Photometric | None:
    """The answer, if its slabs are even and the joints' measured places do not contradict it."""
    state = last.state
    inverse = np.linalg.inv(last.information)
    counted = int((np.bincount(pixels.cell, state.weight) > 0).sum())
    if counted < SPARE_CELLS + len(last.free):
        return None
    # Of the pose alone: what the looks and the mean tones would explain is taken out first.
    C = inverse[:6, :6]
    along = last.scores @ inverse[:, :6]
    effect = float(np.einsum("ck,kl,cl->", along, np.linalg.inv(C), along)) / (6 * state.noise**2)
    effect *= counted / (counted - len(last.free))
    if effect > MOST_DESIGN_EFFECT:
        return None
    found = C * state.noise**2 * max(effect, 1.0)
    parameters = _parameters(fit, state.shape)
    turn, shift = parameters[:3], state.shape.pose.t - fit.cam_from_ground.t
    away = np.r_[turn, shift]
    if away @ np.linalg.solve(covariance + found, away) > chdtri(6, CONTRADICTION):
        return None
    moved = replace(
        fit,
        cam_from_ground=state.shape.pose,
        grid=stretched(fit.grid, replace(fit.solution, parameters=parameters)),
        strip=replace(fit.strip, width=state.shape.width),
        distances_px=fit.distances_px + fit.solution.jacobian @ parameters,
    )
    return Photometric(moved, 0.5 * (found + found.T), state.noise, effect, len(pixels))


def _parameters(fit: Fit, shape: Shape) -> Float[np.ndarray, " p"]:
    """The motion from a fit in the solver's parameters, where the turn swings the translation along."""
    parameters = np.zeros(PARAMETERS)
    turn = shape.pose.R @ fit.cam_from_ground.R.T
    skew = 0.5 * (turn - turn.T)
    parameters[terms.ROTATION] = skew[2, 1], skew[0, 2], skew[1, 0]
    parameters[terms.TRANSLATION] = shape.pose.t - turn @ fit.cam_from_ground.t
    parameters[terms.RATIO] = np.log((shape.grid.spacing_x or 1.0) / shape.grid.spacing_y) - np.log(
        (fit.grid.spacing_x or 1.0) / fit.grid.spacing_y
    )
    return parameters
