"""One step of the fit to grey levels: normal equations of all that is solved for, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from autoreg import joint_data as terms
from autoreg.fit import Fit
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector
from autoreg.joint_image import JointImage, Shape, Slopes, with_looks
from autoreg.joint_pixels import JOINT, TONES, JointPixels
from autoreg.tones import Blocks, Shares, over_parts, tone_variances

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
# Columns of a pixel in a step: the derivatives, and its grey level.
COLUMNS = UNKNOWNS + 1
# Where tiles meet without a joint that shows, there may be a hairline as wide as what is taken for none. Its
# tone moves the step by up to half of that.
HAIRLINE = 0.3


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
    total = over_parts(pixels.blocks, [(own, own.sums(each)) for own, each in zip(parts, away, strict=True)])
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
    total = over_parts(pixels.blocks, [(part.shares, own) for part, own in zip(parts, sums, strict=True)])
    blocks, sums = Blocks(total[..., COLUMNS:]), total[..., :COLUMNS]
    variances = tone_variances(blocks, sums[..., -1:], state.noise)
    ridge = state.noise**2 / np.r_[[variances[0]] * JOINT, variances[1]]
    solved = blocks.solve(sums, ridge)
    H = np.sum(squares, 0) - _imitated(sums, solved)
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
    sums = _tones_of(last, grey)[..., None]
    solved = normal.blocks.solve(sums, normal.ridge)
    products = [part.columns[:-1] @ (part.weight * own) for part, own in zip(last.parts, grey, strict=True)]
    right = np.sum(products, 0) - _imitated(normal.sums, solved)[:, 0]
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


def _imitated(sums: Float[np.ndarray, "m t p"], solved: Float[np.ndarray, "m t q"]) -> np.ndarray:
    """Products of columns that the tones of all blocks take for their own."""
    return sums.reshape(-1, sums.shape[-1]).T @ solved.reshape(-1, solved.shape[-1])


def with_doubts(last: Step, together: float) -> Step:
    """The same step with the columns of what the drawing leaves out, instead of the grey levels.

    The joints of a family may lie off `together` by such a share of their width.
    """
    widths = zip(last.state.shape.width, last.state.fit.strip.polarity, strict=True)
    x, y = (together * width if polarity else HAIRLINE * width for width, polarity in widths)
    parts, sums = zip(*(_doubted(part, (x, y)) for part in last.parts), strict=True)
    total = over_parts(
        last.pixels.blocks, [(part.shares, own) for part, own in zip(parts, sums, strict=True)]
    )
    normal = last.normal
    solved = np.concatenate([normal.solved, normal.blocks.solve(total, normal.ridge)], 2)
    normal = replace(normal, sums=np.concatenate([normal.sums, total], 2), solved=solved)
    return replace(last, parts=list(parts), normal=normal)


def _doubted(part: Part, off: tuple[float, float]) -> tuple[Part, Float[np.ndarray, "b t d"]]:
    """A part with columns of what its grey levels change by where they are doubted, and the tones' products.

    Joints are `off` by so much together.
    """
    image, slopes = part.image, part.slopes
    more = np.concatenate([image.lopsided(), image.by_lens(slopes), image.together(slopes, off)])
    columns = np.concatenate([part.columns[:-1], more])
    return replace(part, columns=columns), part.shares.sums(np.ascontiguousarray(more.T))


def told(
    last: Step, unknowns: Int[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """Information about some of the unknowns in all pixels, beyond what tones can imitate, and its score."""
    products = [_squares(part, left, unknowns) for part, left in zip(last.parts, last.left, strict=True)]
    squares, score = (np.sum(each, 0) for each in zip(*products, strict=True))
    sums, solved = last.normal.sums[..., unknowns], last.normal.solved[..., unknowns]
    score = score - np.einsum("mtk,mt->k", solved, _tones_of(last, last.left))
    return squares - _imitated(sums, solved), score


def _squares(part: Part, left: np.ndarray, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    columns = part.columns[unknowns]
    weighted = columns * np.sqrt(part.weight)
    return weighted @ weighted.T, columns @ (part.weight * left)


def _tones_of(last: Step, left: list[np.ndarray]) -> Float[np.ndarray, "m t"]:
    """Weighted products of all tones' shares with what is left of the grey levels."""
    parts = [
        (part.shares, part.shares.sums(own[:, None])) for part, own in zip(last.parts, left, strict=True)
    ]
    return over_parts(last.pixels.blocks, parts)[..., 0]


def told_by_cells(
    last: Step, unknowns: Int[np.ndarray, " k"], ask: Float[np.ndarray, "j k"], step: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "c j"], Float[np.ndarray, "c j k"]]:
    """What every cell tells of some combinations `ask` of the unknowns: its score, and its information.

    As far as no tone can imitate it; the score is what is left of it when all have taken a `step`. The sum
    of what all cells tell is the combinations' part of the normal matrix.
    """
    pixels, normal = last.pixels, last.normal
    left = [own - step @ part.columns[unknowns] for part, own in zip(last.parts, last.left, strict=True)]
    sums = np.swapaxes(normal.sums[..., unknowns] @ ask.T, 1, 2)
    # The score's column is the last.
    tones = normal.blocks.solve(_tones_of(last, left)[..., None], normal.ridge)
    imitated = sums @ np.concatenate([normal.solved[..., unknowns], tones], 2)
    # Blocks are numbered cell by cell.
    cell = np.zeros(pixels.blocks, dtype=np.int64)
    cell[pixels.block] = pixels.cell
    total = -np.add.reduceat(imitated, np.searchsorted(cell, np.arange(pixels.cells)), axis=0)
    for part, own in zip(last.parts, left, strict=True):
        of_part = _told_by_cells(part, own, unknowns, ask)
        first = part.image.pixels.cell[0]
        total[first : first + len(of_part)] += of_part
    return total[..., -1], total[..., :-1]


def _told_by_cells(
    part: Part, left: np.ndarray, unknowns: np.ndarray, ask: np.ndarray
) -> Float[np.ndarray, "b j k"]:
    """What a part's pixels tell, cell by cell, if they have the tones that they have."""
    cell = part.image.pixels.cell
    columns = np.concatenate([part.columns[unknowns], left[None]])
    asked = (ask @ columns[:-1]) * part.weight
    ends = np.cumsum(np.bincount(cell - cell[0])).tolist()
    found = np.zeros((len(ends), len(ask), len(columns)))
    for own, (start, end) in zip(found, pairwise([0, *ends]), strict=True):
        if end > start:
            np.matmul(asked[:, start:end], columns[:, start:end].T, out=own)
    return found


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
