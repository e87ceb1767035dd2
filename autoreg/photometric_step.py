"""One step of the fit to grey levels: normal equations of all that is solved for, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

from autoreg import joint_data as terms
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector
from autoreg.joint_image import JointImage, Shape, Slopes, with_looks
from autoreg.joint_pixels import JOINT, JointPixels
from autoreg.refine import Fit
from autoreg.tones import Blocks, tone_variances

# Looks change by at most this much at a time, in their logarithms.
MOST_LOOKS_STEP = 0.3
# Residuals beyond this many standard deviations count less, by the square.
ROBUST_SIGMAS = 3.0
# A cell whose mean square residual is so many times the rest's shows something else.
FOREIGN = 4.0
# Grey levels that even a drawn picture is off by.
LEAST_NOISE = 0.05
# Unknowns besides the tones of blocks: seven of the pose, three looks, the mean tones of slabs and of joints;
# behind them stand the columns of what the drawing leaves out, which no step solves for.
LOOKS, MEANS, UNKNOWNS, DOUBTED = slice(7, 10), slice(10, 12), 12, 7


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
class Step:
    """One Gauss-Newton step: where it led, its size in sigmas, and what cells' scores are made of.

    `image` and `slopes` are those that it was taken from. `columns` are the pixels' derivatives by all
    unknowns, `sums` and `solved` the blocks' products with them and the tones that imitate them, with `ridge`
    for what is known of the tones.
    """

    state: State
    free: Int[np.ndarray, " k"]
    image: JointImage
    slopes: Slopes
    blocks: Blocks
    ridge: Float[np.ndarray, " t"]
    columns: Float[np.ndarray, "n p"]
    sums: Float[np.ndarray, "m t p"]
    solved: Float[np.ndarray, "m t p"]
    left: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    sigmas: float


def first_state(pixels: JointPixels, shape: Shape, fit: Fit) -> State:
    """Tones by a ridge towards their common means, and the noise that they leave."""
    share = JointImage(pixels, shape).shares()
    common = np.stack([1.0 - share[:, JOINT], share[:, JOINT]], 1)
    means = np.linalg.lstsq(common.T @ common + 1e-6 * np.eye(2), common.T @ pixels.grey, rcond=None)[0]
    weight = np.ones(len(pixels))
    blocks = Blocks(pixels, share, weight)
    middle = np.r_[[means[0]] * JOINT, means[1]]
    tones = middle + blocks.solve(blocks.sums((pixels.grey - share @ middle)[:, None]), 0.02)[..., 0]
    noise = _scatter(pixels.grey - (share * tones[pixels.block]).sum(1), weight)
    return State(shape, fit, tones, noise, weight)


def stepped(pixels: JointPixels, state: State) -> Step | None:
    """One Gauss-Newton step of the pose, the looks and all tones."""
    image = JointImage(pixels, state.shape)
    share, weight = image.shares(), state.weight
    if weight is None:
        off = pixels.grey - (share * state.tones[pixels.block]).sum(1)
        weight = _robust(off, state.noise, pixels.cell)
    slopes = image.slopes(state.tones[pixels.block])
    means = 1.0 - share[:, JOINT], share[:, JOINT]
    columns = np.column_stack([image.by_pose(slopes), slopes.by_looks, *means, pixels.grey])
    free = freed(state.fit)
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
    off = solved[..., -1] - solved[..., :UNKNOWNS] @ step
    tones = off + means
    left = (
        pixels.grey - (share * tones[pixels.block]).sum(1) - columns[:, : MEANS.start] @ step[: MEANS.start]
    )
    noise = _scatter(left, weight)
    moved = replace(state, shape=moved_shape(state.shape, step), tones=tones, noise=noise)
    # Of the means, a step has no size: they are found anew each time.
    motion = np.where(free < MEANS.start, step[free], 0.0)
    sigmas = float(np.sqrt(motion @ information @ motion)) / noise
    moved = replace(moved, weight=_robust(left, noise, pixels.cell))
    own = columns[:, :-1], sums[..., :-1], solved[..., :-1]
    return Step(moved, free, image, slopes, blocks, ridge, *own, left, weight, sigmas)


def with_doubts(last: Step) -> Step:
    """The same step with the columns of what the drawing leaves out."""
    more = np.column_stack([last.image.lopsided(), last.image.by_lens(last.slopes)])
    sums = last.blocks.sums(more)
    return replace(
        last,
        columns=np.concatenate([last.columns, more], 1),
        sums=np.concatenate([last.sums, sums], 2),
        solved=np.concatenate([last.solved, last.blocks.solve(sums, last.ridge)], 2),
    )


def cell_scores(last: Step, free: Int[np.ndarray, " k"]) -> Float[np.ndarray, "c k"]:
    """Gradient of every cell's misfit by the unknowns, as far as no tone can imitate it."""
    pixels = last.image.pixels
    n = len(pixels)
    gather = csr_matrix((last.weight * last.left, (pixels.cell, np.arange(n))), shape=(pixels.cells, n))
    imitated = np.einsum("mtk,mt->mk", last.solved[..., free], last.blocks.sums(last.left[:, None])[..., 0])
    scores = gather @ last.columns[:, free]
    return scores - _by_cell(last, imitated)


def cell_information(last: Step, free: Int[np.ndarray, " k"]) -> Float[np.ndarray, "c k k"]:
    """What every cell tells of the unknowns; together that is the step's normal matrix."""
    pixels, k = last.image.pixels, len(free)
    order = np.argsort(pixels.cell, kind="stable")
    sorted_columns = last.columns[order][:, free]
    weighted = sorted_columns * last.weight[order, None]
    ends = np.cumsum(np.bincount(pixels.cell, minlength=pixels.cells)).tolist()
    told = np.empty((pixels.cells, k, k))
    for cell, (start, end) in enumerate(pairwise([0, *ends])):
        told[cell] = weighted[start:end].T @ sorted_columns[start:end]
    imitated = np.einsum("mtp,mtq->mpq", last.sums[..., free], last.solved[..., free])
    return told - _by_cell(last, imitated.reshape(len(imitated), -1)).reshape(told.shape)


def _by_cell(last: Step, of_blocks: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "c k"]:
    """Sums over the blocks of every cell."""
    pixels, cell = last.image.pixels, np.zeros(last.blocks.count, dtype=np.int64)
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
