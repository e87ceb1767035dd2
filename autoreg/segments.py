"""Straight edge segments of a photo, in its own pixels."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple, cast

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from autoreg.faint_edges import faint_edges

# Where LSD finds fewer segments than this, fainter ones are looked for.
FEW = 150
# Where the contrast of a segment is sampled: shares of its length, and pixels to either side.
ALONG, BESIDE_PX = np.linspace(0.1, 0.9, 9), 1.5
# Segments both of whose ends lie this close to an edge between blocks run along it.
ON_EDGE_PX = 1.25
# LSD's bound on the gradient's error by quantisation, in grey levels, as published.
LSD_GRADIENT_STEP = 2.0


@dataclass(frozen=True)
class SegmentOptions:
    """How segments are searched.

    Attributes:
        megapixels: size of the finest level; a larger photo is reduced to it first, which bounds time and
            memory and takes out texture finer than a joint.
        levels: number of levels, each of half the width of the one before.
        min_length_px: shortest segment kept, in pixels of the level that found it.
        max_segments: the longest so many are kept.
        blocks_px: side of the squares, from the picture's first pixel on, along whose edges no segments are
            kept: those of the blocks in which a file keeps colours. 0 for none.
    """

    megapixels: float = 0.6
    levels: int = 3
    min_length_px: float = 10.0
    max_segments: int = 3000
    blocks_px: float = 0.0


@dataclass(frozen=True)
class Segments:
    """Edge segments, longest first; walking from the first end to the second, the DARK side is on the right.

    "Right" is as seen in the picture (x right, y down): the brightness grows along (dy, -dx) for a segment
    of direction (dx, dy). `sigma_px` is the standard deviation of each end across the segment.
    """

    ends_px: Float[np.ndarray, "n 2 2"]
    sigma_px: Float[np.ndarray, " n"]
    level: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.ends_px)

    @property
    def length_px(self) -> Float[np.ndarray, " n"]:
        """Length of each segment."""
        return np.hypot(*(self.ends_px[:, 1] - self.ends_px[:, 0]).T)

    def take(self, index: np.ndarray) -> Segments:
        """The segments that an index array or a mask selects."""
        return Segments(self.ends_px[index], self.sigma_px[index], self.level[index])


def detect_segments(gray: UInt8[np.ndarray, "h w"], *, options: SegmentOptions | None = None) -> Segments:
    """Segments of a grey picture found by LSD on a short pyramid, duplicates between its levels removed.

    Where it finds few, those that noise or grain hides from it are added (`faint_edges`).

    LSD: Grompone von Gioi et al., "LSD: a Line Segment Detector", IPOL 2012. It runs at its own scale 1.0 on
    levels that are reduced here, because its built-in reduction (scale 0.8) forgets the half pixel between
    pixel centres and corners and so moves every segment by (-0.12, -0.12) px.

    Raises:
        ValueError: the picture is no array of h x w grey levels of 8 bits.
    """
    shape, kind = getattr(gray, "shape", ()), getattr(gray, "dtype", type(gray).__name__)
    if len(shape) != 2 or 0 in shape or kind != np.uint8:
        got = f"{' x '.join(map(str, shape))} of {kind}" if shape else kind
        raise ValueError(
            f"gray must be an array of h x w of uint8, got {got}; autoreg.load_photo(path).gray is that of "
            "a file"
        )
    return begin_detection(gray, options=options).all


@dataclass(frozen=True)
class Detection:
    """Segments of a picture, those of the coarser levels first, while others are still being looked for."""

    coarse_begun: Future[Segments]
    all_begun: Future[Segments]

    @property
    def coarse(self) -> Segments:
        """Those of all levels but the finest; waits for them."""
        return self.coarse_begun.result()

    @property
    def all(self) -> Segments:
        """Those of all levels, without duplicates; waits for them."""
        return self.all_begun.result()


def begin_detection(gray: UInt8[np.ndarray, "h w"], *, options: SegmentOptions | None = None) -> Detection:
    """Like `detect_segments`, but nobody need wait for more than he can do with.

    The finest level takes longer than all others together, and LSD lets other threads run.
    """
    options = options or SegmentOptions()
    levels = _levels(gray, options)
    finest, *coarser = levels
    pool = ThreadPoolExecutor(1)
    rest = [pool.submit(_detect_on_level, level, options) for level in coarser]
    coarse = pool.submit(lambda: _joined([level.result() for level in rest], options))
    found = [pool.submit(_detect_on_level, finest, options), *rest]
    everything = pool.submit(lambda: _with_faint([level.result() for level in found], levels, options))
    pool.shutdown(wait=False)
    return Detection(coarse, everything)


def contrast_across(
    picture: Float32[np.ndarray, "h w"], segments: Segments, size: tuple[int, int]
) -> Float[np.ndarray, " n"]:
    """By how many grey levels a picture differs between the two sides of each segment.

    `size` is the width and height of the photo in whose pixels the segments are, which may be larger.
    """
    if not len(segments):
        return np.zeros(0)
    ends = (segments.ends_px + 0.5) * (np.array(picture.shape[::-1]) / size) - 0.5
    along = ends[:, 1] - ends[:, 0]
    across = along[:, ::-1] * [-1.0, 1.0] / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    place = ends[:, None, 0] + ALONG[:, None] * along[:, None]
    sides = [place + side * BESIDE_PX * across[:, None] for side in (1.0, -1.0)]
    u, v = np.moveaxis(np.stack(sides).astype(np.float32), -1, 0)
    one, other = (
        cv2.remap(picture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).mean(1)
        for at in zip(u, v, strict=True)
    )
    return np.abs(one - other).astype(float)


def _with_faint(found: list[Segments], levels: list[_Level], options: SegmentOptions) -> Segments:
    """The segments of all levels as one set, with those that noise hides from LSD where it finds few."""
    by_lsd = _joined(found, options)
    if len(by_lsd) >= FEW:
        return by_lsd
    faint = [_as_segments(faint_edges(level.gray), level, options) for level in levels]
    return _joined([by_lsd, *faint], options)


def _joined(levels: list[Segments], options: SegmentOptions) -> Segments:
    """The segments of some levels, the finest first, as one set."""
    found = reduce(_merge, levels, _empty())
    order = np.argsort(-found.length_px, kind="stable")[: options.max_segments]
    return found.take(order)


class _Level(NamedTuple):
    """A picture of the pyramid, the size of its pixels in those of the photo, and its number."""

    gray: UInt8[np.ndarray, "h w"]
    px_per_level_px: Float[np.ndarray, "2"]
    number: int


def _levels(gray: UInt8[np.ndarray, "h w"], options: SegmentOptions) -> list[_Level]:
    """The pyramid, its finest level first."""
    height, width = gray.shape
    finest = min(1.0, float(np.sqrt(options.megapixels * 1e6 / (width * height))))
    levels: list[_Level] = []
    for level in range(options.levels):
        scale = finest / 2**level
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        if min(size) < 64 and level > 0:
            break
        if size != gray.shape[::-1]:
            gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        levels.append(_Level(gray, np.array([width / size[0], height / size[1]]), level))
    return levels


def _empty() -> Segments:
    return Segments(np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, int))


def _detect_on_level(level: _Level, options: SegmentOptions) -> Segments:
    # Averaging takes out noise, so a coarser level may ask for less contrast: soft or worn joints show there.
    step = LSD_GRADIENT_STEP / np.sqrt(2.0) ** level.number
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 1.0, 0.6, step)
    # None where nothing is found, (N, 1, 4) in OpenCV 4, (N, 4) in OpenCV 5.
    lines = cast("np.ndarray | None", detector.detect(level.gray)[0])
    if lines is None:
        return _empty()
    return _as_segments(np.asarray(lines, float).reshape(-1, 2, 2), level, options)


def _as_segments(ends: Float[np.ndarray, "n 2 2"], level: _Level, options: SegmentOptions) -> Segments:
    """The segments of a level whose ends are these, in its pixels, but for the shortest."""
    length = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
    keep = length >= options.min_length_px
    ends, length = ends[keep], length[keep]
    sigma = _end_sigma(length) * float(level.px_per_level_px.mean())
    # Pixel centres of two levels agree only at the corners of the pictures: half a pixel in, half out.
    found = Segments((ends + 0.5) * level.px_per_level_px - 0.5, sigma, np.full(len(ends), level.number))
    return found.take(~_on_blocks(found.ends_px, options.blocks_px)) if options.blocks_px else found


def _on_blocks(ends_px: Float[np.ndarray, "n 2 2"], side_px: float) -> Bool[np.ndarray, " n"]:
    """Which segments run along the edges of blocks of such a side, which begin at the picture's corner."""
    from_corner = ends_px + 0.5
    edge = np.rint(from_corner / side_px)
    near = np.abs(from_corner - side_px * edge) < ON_EDGE_PX
    return (near.all(1) & (edge[:, 0] == edge[:, 1])).any(1)


def _end_sigma(length: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Standard deviation of an end across its segment, in pixels of the level that found it.

    Measured on ray-traced joints of known place (0.18 px at 15 px of length, 0.05 px at 120 px); the floor is
    there because real joints are less straight than those.
    """
    return np.sqrt(0.06**2 + 0.8**2 / length)


def _merge(fine: Segments, coarse: Segments) -> Segments:
    """Both sets without the coarse segments that fine ones already say, and the other way round.

    A fine segment wins over a coarse one unless it is a piece, less than half as long, of it.
    """
    if not len(fine) or not len(coarse):
        return fine if len(fine) else coarse
    i, j, shared_px = _overlaps(fine, coarse)
    fine_px, coarse_px = fine.length_px, coarse.length_px
    keep_fine = np.ones(len(fine), bool)
    keep_fine[i[(shared_px > 0.7 * fine_px[i]) & (fine_px[i] < 0.5 * coarse_px[j])]] = False
    said_px = np.bincount(j, shared_px * keep_fine[i], len(coarse))
    fine, coarse = fine.take(keep_fine), coarse.take(said_px <= 0.5 * coarse_px)
    return Segments(
        np.concatenate([fine.ends_px, coarse.ends_px]),
        np.concatenate([fine.sigma_px, coarse.sigma_px]),
        np.concatenate([fine.level, coarse.level]),
    )


def _overlaps(
    fine: Segments, coarse: Segments
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Pairs (fine, coarse) that lie on the same side of the same edge, and the length that they share."""
    start, length = coarse.ends_px[:, 0], coarse.length_px
    along = (coarse.ends_px[:, 1] - start) / length[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    reach = 5.0 * coarse.sigma_px
    # All pairs meet only in these two products, in single precision; the rest is done on the few near ones.
    middle = fine.ends_px.mean(1).astype(np.float32)
    off = np.abs(middle @ across.T.astype(np.float32) - (start * across).sum(1).astype(np.float32))
    i, j = np.nonzero(off < reach.astype(np.float32))
    rel = fine.ends_px[i] - start[j, None]
    s = (rel * along[j, None]).sum(-1)
    d = np.abs((rel * across[j, None]).sum(-1)).max(1)
    shared_px = np.minimum(s[:, 1], length[j]) - np.maximum(s[:, 0], 0.0)
    # The two edges of a joint run in opposite directions: only a positive step is the same edge.
    same = (d < reach[j]) & (s[:, 1] > s[:, 0]) & (shared_px > 0)
    return i[same], j[same], shared_px[same]
