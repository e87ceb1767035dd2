"""One step of the fit to grey levels: normal equations of all that is solved for, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

from autoreg import joint_data as terms
from autoreg.fit import Fit
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector
from autoreg.joint_image import JointImage, Shape, Slopes, with_looks
from autoreg.joint_pixels import JOINT, JointPixels
from autoreg.side_by_side import side_by_side
from autoreg.tones import Blocks, Shares, tone_variances

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
LOOKS, MEANS, UNKNOWNS, DOUBTED = slice(7, 10), slice(10, 12), 12, 11
# Where tiles meet without a joint that shows, there may be a hairline as wide as what is taken for none. Its
# tone moves the step by up to half of that.
HAIRLINE = 0.3
# Pixels that are drawn at a time, such parts side by side: what a processor's cache holds.
MOST_AT_ONCE = 32_768


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
    share: Float[np.ndarray, "n t"]
    weight: Float[np.ndarray, " n"]
    columns: Float[np.ndarray, "n p"]
    shares: Shares


@dataclass(frozen=True)
class Step:
    """One Gauss-Newton step: where it led, its size in sigmas, and what cells' scores are made of.

    It was taken from all `pixels` by `parts`. `sums` and `solved` are the blocks' products with the columns
    of the unknowns and the tones that imitate these, with `ridge` for what is known of the tones; `left` is
    what is left of each part's grey levels.
    """

    state: State
    free: Int[np.ndarray, " k"]
    pixels: JointPixels
    parts: list[Part]
    blocks: Blocks
    ridge: Float[np.ndarray, " t"]
    sums: Float[np.ndarray, "m t p"]
    solved: Float[np.ndarray, "m t p"]
    left: list[np.ndarray]
    sigmas: float


def first_state(pixels: JointPixels, shape: Shape, fit: Fit) -> State:
    """Tones by a ridge towards their common means, and the noise that they leave."""
    share = JointImage(pixels, shape).shares()
    common = np.stack([1.0 - share[:, JOINT], share[:, JOINT]], 1)
    means = np.linalg.lstsq(common.T @ common + 1e-6 * np.eye(2), common.T @ pixels.grey, rcond=None)[0]
    weight = np.ones(len(pixels))
    shares = Shares(pixels, share, weight)
    middle = np.r_[[means[0]] * JOINT, means[1]]
    away = shares.sums((pixels.grey - share @ middle)[:, None])
    blocks = Blocks([shares])
    tones = middle + blocks.solve(away, FIRST_RIDGE)[..., 0]
    noise = _scatter(_without_tones(pixels, share, tones), weight, blocks.freedom(FIRST_RIDGE))
    return State(shape, fit, tones, noise, weight)


def stepped(pixels: JointPixels, state: State) -> Step | None:
    """One Gauss-Newton step of the pose, the looks and all tones."""
    some = pixels.parts(MOST_AT_ONCE)
    images = side_by_side(lambda part: JointImage(part, state.shape), some)
    share = side_by_side(JointImage.shares, images)
    weight = state.weight
    if weight is None:
        off = [_without_tones(part, own, state.tones) for part, own in zip(some, share, strict=True)]
        weight = _robust(np.concatenate(off), state.noise, pixels.cell)
    ends = np.cumsum([len(part) for part in some])[:-1]
    drawn = list(zip(images, share, np.split(weight, ends), strict=True))
    parts = side_by_side(lambda part: _part(*part, state.tones), drawn)
    free = freed(state.fit)
    blocks = Blocks(part.shares for part in parts)
    sums, squares = (np.sum(products, 0) for products in zip(*side_by_side(_products, parts), strict=True))
    variances = tone_variances(blocks, blocks.solve(sums[..., -1:], 1e-3)[..., 0], state.noise)
    ridge = state.noise**2 / np.r_[[variances[0]] * JOINT, variances[1]]
    solved = blocks.solve(sums, ridge)
    H = squares - np.einsum("mtp,mtq->pq", sums, solved)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(H)[free], 1e-12))
    information = H[np.ix_(free, free)]
    scaled = information * np.outer(unit, unit)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e12:
        return None
    step = np.zeros(UNKNOWNS)
    step[free] = unit * np.linalg.solve(scaled, unit * H[free, -1])
    step[LOOKS] = np.clip(step[LOOKS], -MOST_LOOKS_STEP, MOST_LOOKS_STEP)
    means = np.r_[[step[10]] * JOINT, step[11]]
    off = solved[..., -1] - solved[..., :UNKNOWNS] @ step
    tones = off + means
    left = side_by_side(lambda part: _left(part, tones, step), parts)
    all_left = np.concatenate(left)
    noise = _scatter(all_left, weight, blocks.freedom(ridge))
    moved = replace(state, shape=moved_shape(state.shape, step), tones=tones, noise=noise)
    # Of the means, a step has no size: they are found anew each time.
    motion = np.where(free < MEANS.start, step[free], 0.0)
    sigmas = float(np.sqrt(motion @ information @ motion)) / noise
    moved = replace(moved, weight=_robust(all_left, noise, pixels.cell))
    return Step(moved, free, pixels, parts, blocks, ridge, sums[..., :-1], solved[..., :-1], left, sigmas)


def _part(image: JointImage, share: np.ndarray, weight: np.ndarray, tones: np.ndarray) -> Part:
    """Some pixels with all that a step needs of them."""
    pixels = image.pixels
    slopes = image.slopes(tones[pixels.block])
    means = 1.0 - share[:, JOINT], share[:, JOINT]
    columns = np.column_stack([image.by_pose(slopes), slopes.by_looks, *means, pixels.grey])
    return Part(image, slopes, share, weight, columns, Shares(pixels, share, weight))


def _products(part: Part) -> tuple[Float[np.ndarray, "m t p"], Float[np.ndarray, "p p"]]:
    """Weighted products of a part's columns with the shares of the blocks' tones, and with each other."""
    return part.shares.sums(part.columns), (part.columns * part.weight[:, None]).T @ part.columns


def _without_tones(pixels: JointPixels, share: np.ndarray, tones: np.ndarray) -> Float[np.ndarray, " n"]:
    """Grey levels without what the tones of their blocks explain."""
    return pixels.grey - np.einsum("nt,nt->n", share, tones[pixels.block])


def _left(part: Part, tones: np.ndarray, step: np.ndarray) -> Float[np.ndarray, " n"]:
    """What a step leaves of a part's grey levels."""
    moved = part.columns[:, : MEANS.start] @ step[: MEANS.start]
    return _without_tones(part.image.pixels, part.share, tones) - moved


def with_doubts(last: Step, together: float) -> Step:
    """The same step with the columns of what the drawing leaves out, instead of the grey levels.

    The joints of a family may lie off `together` by such a share of their width.
    """
    widths = zip(last.state.shape.width, last.state.fit.strip.polarity, strict=True)
    x, y = (together * width if polarity else HAIRLINE * width for width, polarity in widths)
    more = side_by_side(lambda part: _doubts(part, (x, y)), last.parts)
    both = list(zip(last.parts, more, strict=True))
    sums = np.sum([part.shares.sums(columns) for part, columns in both], 0)
    solved = np.concatenate([last.solved, last.blocks.solve(sums, last.ridge)], 2)
    parts = [replace(p, columns=np.concatenate([p.columns[:, :-1], columns], 1)) for p, columns in both]
    return replace(last, parts=parts, sums=np.concatenate([last.sums, sums], 2), solved=solved)


def _doubts(part: Part, off: tuple[float, float]) -> Float[np.ndarray, "n d"]:
    """What a part's grey levels change by where they are doubted; joints are `off` by so much together."""
    image, slopes = part.image, part.slopes
    return np.column_stack([image.lopsided(), image.by_lens(slopes), image.together(slopes, off)])


def told_by_cells(
    last: Step, unknowns: Int[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "c k"], Float[np.ndarray, "c k k"]]:
    """Gradient of every cell's misfit by the unknowns, as far as no tone can imitate it, and its information.

    The sum of what all cells tell is the step's normal matrix.
    """
    both = list(zip(last.parts, last.left, strict=True))
    of_parts = side_by_side(lambda part: _told_by_cells(*part, unknowns), both)
    scores, told = (np.sum(parts, 0) for parts in zip(*of_parts, strict=True))
    left = np.sum([part.shares.sums(left[:, None]) for part, left in both], 0)
    sums, solved = last.sums[..., unknowns], last.solved[..., unknowns]
    scores -= _by_cell(last.pixels, np.einsum("mtk,mt->mk", solved, left[..., 0]))
    imitated = (np.swapaxes(sums, 1, 2) @ solved).reshape(len(sums), -1)
    return scores, told - _by_cell(last.pixels, imitated).reshape(told.shape)


def _told_by_cells(
    part: Part, left: np.ndarray, unknowns: np.ndarray
) -> tuple[Float[np.ndarray, "c k"], Float[np.ndarray, "c k k"]]:
    """What a part's pixels tell, cell by cell, if they have the tones that they have."""
    pixels, k = part.image.pixels, len(unknowns)
    order = np.argsort(pixels.cell, kind="stable")
    columns = part.columns[np.ix_(order, unknowns)]
    weighted, left = columns * part.weight[order, None], left[order]
    ends = np.cumsum(np.bincount(pixels.cell, minlength=pixels.cells)).tolist()
    scores, told = np.empty((pixels.cells, k)), np.empty((pixels.cells, k, k))
    for cell, (start, end) in enumerate(pairwise([0, *ends])):
        told[cell] = weighted[start:end].T @ columns[start:end]
        scores[cell] = left[start:end] @ weighted[start:end]
    return scores, told


def _by_cell(pixels: JointPixels, of_blocks: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "c k"]:
    """Sums over the blocks of every cell."""
    cell = np.zeros(pixels.blocks, dtype=np.int64)
    cell[pixels.block] = pixels.cell
    ones, block = np.ones(len(cell)), np.arange(len(cell))
    return csr_matrix((ones, (cell, block)), shape=(pixels.cells, len(cell))) @ of_blocks


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
    counted = np.abs(left[weight > 0])
    if len(counted) <= fitted:
        return LEAST_NOISE
    spared = np.sqrt(len(counted) / (len(counted) - fitted))
    return max(1.4826 * float(np.median(counted) * spared), LEAST_NOISE)


def _robust(left: np.ndarray, noise: float, cell: np.ndarray) -> Float[np.ndarray, " n"]:
    """Weights: less for pixels far off, none for cells that as a whole are."""
    off = np.abs(left) / (ROBUST_SIGMAS * noise)
    weight = 1.0 / np.maximum(off, 1.0) ** 2
    square = np.bincount(cell, np.minimum(left**2, 25.0 * noise**2)) / np.maximum(np.bincount(cell), 1)
    return np.where(square[cell] > FOREIGN * noise**2, 0.0, weight)
