"""One step of the fit to grey levels: normal equations of all that is solved for, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector
from autoreg.grey_levels.joint_image import JointImage, Shape, Slopes, with_looks
from autoreg.grey_levels.joint_pixels import JOINT, TONES, JointPixels
from autoreg.grey_levels.tones import Blocks, Shares, over_parts, tone_variances
from autoreg.solve import joint_data as terms
from autoreg.spread import spread_about

# Looks change by at most this much at a time, in their logarithms.
MOST_LOOKS_STEP = 0.3
# Residuals beyond this many standard deviations count less, by the square.
ROBUST_SIGMAS = 3.0
# A cell whose mean square residual is so many times the rest's shows something else.
FOREIGN = 4.0
# What the first tones are held to their common means by, in pixels.
FIRST_RIDGE = 0.02
# Grey levels that even a drawn picture is off by.
LEAST_NOISE = 0.05
# Unknowns besides the tones of blocks: seven of the pose, three looks, the mean tones of slabs and of joints;
# behind them stand the columns of what the drawing leaves out, which no step solves for.
LOOKS, MEANS, UNKNOWNS = slice(7, 10), slice(10, 12), 12
# Columns of a pixel in a step: the derivatives, and its grey level.
COLUMNS = UNKNOWNS + 1


@dataclass(frozen=True)
class State:
    """The unknowns, what is known of the tones, and each pixel's robust weight.

    Where no weights are given, they are those that the state's own tones leave.
    """

    shape: Shape
    fit: Fit
    tones: Float[np.ndarray, "m t"]
    noise: float
    weight: Float[np.ndarray, " n"] | None


@dataclass(frozen=True)
class Part:
    """Some of the pixels, as they are drawn from a state.

    `columns` are their derivatives by all unknowns and, behind these, their grey levels; `shares` are the
    tones', block by block.
    """

    image: JointImage
    slopes: Slopes
    weight: Float[np.ndarray, " n"]
    columns: Float[np.ndarray, "p n"]
    shares: Shares


@dataclass(frozen=True)
class Normal:
    """The normal equations of a step: of the `free` unknowns, and of the blocks' tones.

    `sums` and `solved` are the blocks' products with the columns of the unknowns and the tones that imitate
    these, with `ridge` for what is known of the tones; `H` is what the columns' own products leave beyond
    them. `weight` is that of the pixels.
    """

    free: Int[np.ndarray, " k"]
    weight: Float[np.ndarray, " n"]
    blocks: Blocks
    ridge: Float[np.ndarray, " t"]
    H: Float[np.ndarray, "p p"]
    sums: Float[np.ndarray, "m t q"]
    solved: Float[np.ndarray, "m t q"]


@dataclass(frozen=True)
class Step:
    """One Gauss-Newton step: where it led, its size in sigmas, and what cells' scores are made of.

    It was taken from all `pixels` by `parts`; `left` is what is left of each part's grey levels.
    """

    state: State
    pixels: JointPixels
    parts: list[Part]
    normal: Normal
    left: list[np.ndarray]
    sigmas: float


def first_state(pixels: JointPixels, shape: Shape, fit: Fit) -> State:
    """Tones by a ridge towards their common means, and the noise that they leave."""
    images = [JointImage(part, shape) for part in pixels.parts]
    of_joint = np.concatenate([image.share[-1] for image in images])
    common = np.stack([1.0 - of_joint, of_joint], 1)
    means = np.linalg.lstsq(common.T @ common + 1e-6 * np.eye(2), common.T @ pixels.grey, rcond=None)[0]
    middle = np.r_[[means[0]] * JOINT, means[1]]
    middles = np.tile(middle, (pixels.blocks, 1))
    parts = [Shares(image.pixels, image.share, np.ones(len(image.pixels))) for image in images]
    away = [np.column_stack([_without_tones(image, middles), _dense(image)]) for image in images]
    sums = [part.sums(each) for part, each in zip(parts, away, strict=True)]
    total = over_parts(pixels.blocks, parts, sums)
    blocks = Blocks(total[..., 1:])
    tones = middle + blocks.solve(total[..., :1], FIRST_RIDGE)[..., 0]
    left = np.concatenate([_without_tones(image, tones) for image in images])
    weight = np.ones(len(pixels))
    return State(shape, fit, tones, _scatter(left, weight, blocks.freedom(FIRST_RIDGE)), weight)


def stepped(pixels: JointPixels, state: State) -> Step | None:
    """One Gauss-Newton step of the pose, the looks and all tones."""
    images = [JointImage(part, state.shape) for part in pixels.parts]
    weight = state.weight
    if weight is None:
        off = np.concatenate([_without_tones(image, state.tones) for image in images])
        weight = _robust(off, state.noise, pixels.cell)
    drawn = zip(images, pixels.of_parts(weight), strict=True)
    parts, sums, squares = zip(*(_part(*each, state.tones) for each in drawn), strict=True)
    total = over_parts(pixels.blocks, [part.shares for part in parts], sums)
    blocks, sums = Blocks(total[..., COLUMNS:]), total[..., :COLUMNS]
    variances = tone_variances(blocks, sums[..., -1:], state.noise)
    ridge = state.noise**2 / np.r_[[variances[0]] * JOINT, variances[1]]
    solved = blocks.solve(sums, ridge)
    H = np.sum(squares, 0) - imitated(sums, solved)
    normal = Normal(freed(state.fit), weight, blocks, ridge, H[:-1, :-1], sums[..., :-1], solved[..., :-1])
    return _taken(state, pixels, list(parts), normal, H[:-1, -1], solved[..., -1])


def stepped_on(last: Step) -> Step | None:
    """A further step by the shares, derivatives, weights and ridge of the last one.

    Small steps hardly change these. The grey levels are those that they would have to explain: what the new
    shares leave, and what the old ones have of the tones as they are now.
    """
    state, pixels, normal = last.state, last.pixels, last.normal
    grey = [
        _without_tones(JointImage(part.image.pixels, state.shape), state.tones)
        + _explained(part.image, state.tones)
        for part in last.parts
    ]
    sums = tones_of(last, grey)[..., None]
    solved = normal.blocks.solve(sums, normal.ridge)
    products = [part.columns[:-1] @ (part.weight * own) for part, own in zip(last.parts, grey, strict=True)]
    right = np.sum(products, 0) - imitated(normal.sums, solved)[:, 0]
    parts = [
        replace(part, columns=np.concatenate([part.columns[:-1], own[None]]))
        for part, own in zip(last.parts, grey, strict=True)
    ]
    return _taken(state, pixels, parts, normal, right, solved[..., 0])


def _taken(
    state: State,
    pixels: JointPixels,
    parts: list[Part],
    normal: Normal,
    right: Float[np.ndarray, " p"],
    solved: Float[np.ndarray, "m t"],
) -> Step | None:
    """The step of normal equations with a right side; `solved` are the tones without it."""
    free = normal.free
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal.H)[free], 1e-12))
    information = normal.H[np.ix_(free, free)]
    scaled = information * np.outer(unit, unit)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e12:
        return None
    step = np.zeros(UNKNOWNS)
    step[free] = unit * np.linalg.solve(scaled, unit * right[free])
    step[LOOKS] = np.clip(step[LOOKS], -MOST_LOOKS_STEP, MOST_LOOKS_STEP)
    tones = solved - normal.solved @ step + np.r_[[step[10]] * JOINT, step[11]]
    left = [_left(part, tones, step) for part in parts]
    all_left = np.concatenate(left)
    noise = _scatter(all_left, normal.weight, normal.blocks.freedom(normal.ridge))
    # Of the means, a step has no size: they are found anew each time.
    motion = np.where(free < MEANS.start, step[free], 0.0)
    sigmas = float(np.sqrt(motion @ information @ motion)) / noise
    weight = _robust(all_left, noise, pixels.cell)
    moved = replace(state, shape=moved_shape(state.shape, step), tones=tones, noise=noise, weight=weight)
    return Step(moved, pixels, parts, normal, left, sigmas)


def _part(
    image: JointImage, weight: np.ndarray, tones: np.ndarray
) -> tuple[Part, Float[np.ndarray, "b t q"], Float[np.ndarray, "p p"]]:
    """Some pixels with all that a step needs of them.

    With it the products of the blocks' tones with its columns and with each other, and of the columns.
    """
    pixels, share = image.pixels, image.share
    slopes = image.slopes(tones.ravel()[pixels.tone])
    columns = np.concatenate(
        [image.by_pose(slopes), slopes.by_looks, [1.0 - share[-1], share[-1], pixels.grey]]
    )
    part = Part(image, slopes, weight, columns, Shares(pixels, share, weight))
    sums = part.shares.sums(np.concatenate([columns.T, _dense(image)], 1))
    weighted = columns * np.sqrt(weight)
    return part, sums, weighted @ weighted.T


def _dense(image: JointImage) -> Float[np.ndarray, "n t"]:
    """The shares of all tones of a pixel's block."""
    pixels = image.pixels
    dense = np.zeros((len(pixels), TONES))
    dense.ravel()[pixels.tone - (pixels.block - np.arange(len(pixels))) * TONES] = image.share
    return dense


def _without_tones(image: JointImage, tones: np.ndarray) -> Float[np.ndarray, " n"]:
    """Grey levels without what the tones of their blocks explain."""
    return image.pixels.grey - _explained(image, tones)


def _explained(image: JointImage, tones: np.ndarray) -> Float[np.ndarray, " n"]:
    """What the tones of their blocks explain of the grey levels."""
    return (image.share * tones.ravel()[image.pixels.tone]).sum(0)


def _left(part: Part, tones: np.ndarray, step: np.ndarray) -> Float[np.ndarray, " n"]:
    """What a step leaves of a part's grey levels, those in its columns."""
    moved = step[: MEANS.start] @ part.columns[: MEANS.start]
    return part.columns[-1] - _explained(part.image, tones) - moved


def imitated(sums: Float[np.ndarray, "m t p"], solved: Float[np.ndarray, "m t q"]) -> np.ndarray:
    """Products of columns that the tones of all blocks take for their own."""
    return sums.reshape(-1, sums.shape[-1]).T @ solved.reshape(-1, solved.shape[-1])


def tones_of(last: Step, left: list[np.ndarray]) -> Float[np.ndarray, "m t"]:
    """Weighted products of all tones' shares with what is left of the grey levels."""
    parts = [part.shares for part in last.parts]
    sums = [part.sums(own[:, None]) for part, own in zip(parts, left, strict=True)]
    return over_parts(last.pixels.blocks, parts, sums)[..., 0]


def freed(fit: Fit) -> Int[np.ndarray, " k"]:
    """Index of the unknowns that are solved for."""
    free = np.ones(UNKNOWNS, dtype=bool)
    free[6] = bool(fit.free.mask[terms.RATIO])
    # Tiles that meet without a joint have no width to be measured.
    free[LOOKS.start : LOOKS.start + 2] = np.array(fit.strip.polarity) != 0
    return np.flatnonzero(free)


def moved_shape(shape: Shape, step: Float[np.ndarray, " p"]) -> Shape:
    """What is drawn, after a step."""
    pose = Rigid(nearest_rotation(rotation_from_vector(step[:3]) @ shape.pose.R), shape.pose.t + step[3:6])
    half = 0.5 * float(step[6])
    grid = replace(
        shape.grid,
        spacing_x=(shape.grid.spacing_x or 1.0) * float(np.exp(half)),
        spacing_y=shape.grid.spacing_y * float(np.exp(-half)),
    )
    return replace(with_looks(shape, step[LOOKS]), pose=pose, grid=grid)


def _scatter(left: np.ndarray, weight: np.ndarray, fitted: float) -> float:
    """Standard deviation of the noise, by the median of the residuals that count and the values `fitted`."""
    counted = left[weight > 0]
    if len(counted) <= fitted:
        return LEAST_NOISE
    spared = np.sqrt(len(counted) / (len(counted) - fitted))
    return max(spread_about(counted) * float(spared), LEAST_NOISE)


def _robust(left: np.ndarray, noise: float, cell: np.ndarray) -> Float[np.ndarray, " n"]:
    """Weights: less for pixels far off, none for cells that as a whole are."""
    off = np.abs(left) / (ROBUST_SIGMAS * noise)
    weight = 1.0 / np.maximum(off, 1.0) ** 2
    square = np.bincount(cell, np.minimum(left**2, 25.0 * noise**2)) / np.maximum(np.bincount(cell), 1)
    return np.where(square[cell] > FOREIGN * noise**2, 0.0, weight)
