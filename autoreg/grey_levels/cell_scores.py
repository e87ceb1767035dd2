"""What pixels tell of all that is solved for, and of what the drawing leaves out."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from autoreg.grey_levels.photometric_step import Part, State, Step, imitated, tones_of
from autoreg.grey_levels.tones import over_parts

# Where tiles meet without a joint that shows, there may be a hairline as wide as what is taken for none. Its
# tone moves the step by up to half of that.
HAIRLINE = 0.3


def with_doubts(last: Step, together: float) -> Step:
    """The same step with the columns of what the drawing leaves out, instead of the grey levels.

    The joints of a family may lie off `together` by such a share of their width.
    """
    widths = zip(last.state.shape.width, last.state.fit.strip.polarity, strict=True)
    x, y = (together * width if polarity else HAIRLINE * width for width, polarity in widths)
    parts, sums = zip(*(_doubted(part, (x, y), last.state) for part in last.parts), strict=True)
    total = over_parts(last.pixels.blocks, [part.shares for part in parts], sums)
    normal = last.normal
    solved = np.concatenate([normal.solved, normal.blocks.solve(total, normal.ridge)], 2)
    normal = replace(normal, sums=np.concatenate([normal.sums, total], 2), solved=solved)
    return replace(last, parts=list(parts), normal=normal)


def _doubted(part: Part, off: tuple[float, float], state: State) -> tuple[Part, Float[np.ndarray, "b t d"]]:
    """A part with columns of what its grey levels change by where they are doubted, and the tones' products.

    Joints are `off` by so much together.
    """
    image, slopes = part.image, part.slopes
    more = np.concatenate([image.lopsided(), image.by_lens(slopes), image.together(slopes, off)])
    if state.shape.grid.odd_bond:
        more = np.concatenate([more, image.by_shift(state.tones.ravel()[image.pixels.tone])[None]])
    columns = np.concatenate([part.columns[:-1], more])
    return replace(part, columns=columns), part.shares.sums(np.ascontiguousarray(more.T))


def told(
    last: Step, unknowns: Int[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """Information about some of the unknowns in all pixels, beyond what tones can imitate, and its score."""
    products = [_squares(part, left, unknowns) for part, left in zip(last.parts, last.left, strict=True)]
    squares, score = (np.sum(each, 0) for each in zip(*products, strict=True))
    sums, solved = last.normal.sums[..., unknowns], last.normal.solved[..., unknowns]
    score = score - np.einsum("mtk,mt->k", solved, tones_of(last, last.left))
    return squares - imitated(sums, solved), score


def _squares(part: Part, left: np.ndarray, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    columns = part.columns[unknowns]
    weighted = columns * np.sqrt(part.weight)
    return weighted @ weighted.T, columns @ (part.weight * left)


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
    tones = normal.blocks.solve(tones_of(last, left)[..., None], normal.ridge)
    by_tones = sums @ np.concatenate([normal.solved[..., unknowns], tones], 2)
    # Blocks are numbered cell by cell.
    cell = np.zeros(pixels.blocks, dtype=np.int64)
    cell[pixels.block] = pixels.cell
    total = -np.add.reduceat(by_tones, np.searchsorted(cell, np.arange(pixels.cells)), axis=0)
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
