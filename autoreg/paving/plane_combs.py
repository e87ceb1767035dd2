"""Hypotheses of the ground's orientation with the joints that are found on each of them, as combs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.ground.crowd import crowded_window
from autoreg.ground.rectify import Window, rectify
from autoreg.ground.sharpen import sharpen
from autoreg.ground.sight import Look, Looks
from autoreg.paving.periods import PIECE, Comb, best_combs
from autoreg.segments import Segments

# Grounds that are looked at a second time.
SHARPENED = 6
# What is seen around the field of a comb when it is looked at by itself, in spacings, and the choice's price.
ZOOM_MARGIN, ZOOM_NATS = 2.0, 2.0
# Columns over which a line's support is taken together in a crowd, whose slabs may be small.
CROWD_PIECE = 12
# The first plane is tried before all others are looked at, if its joints carry this much.
PROMISING_NATS = 15.0
# Where rows alone are clear, the focal length by their slabs' short joints may be this much off.
OTHER_FOCALS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.12, 1.25, 1.4, 1.6, 1.8, 2.0)


@dataclass(frozen=True)
class PlaneCombs:
    """One ground hypothesis with the joints found on it; the camera is the photo's."""

    camera: Camera
    R: Float[np.ndarray, "3 3"]
    x: tuple[Comb, ...]
    y: tuple[Comb, ...]

    @property
    def score(self) -> float:
        """How much better the two best combs explain the plane than chance does."""
        return _score(self.x) + _score(self.y)


def _score(combs: tuple[Comb, ...]) -> float:
    return combs[0].score if combs else 0.0


Hypothesis = tuple[Camera, Float[np.ndarray, "3 3"]]
_Interval = tuple[float, float]


def promising_plane(looks: Looks, segments: Segments, hypotheses: list[Hypothesis]) -> PlaneCombs | None:
    """The first hypothesis, if its joints are clear as it came, on the whole or where its segments crowd."""

    def glances(camera: Camera, R: Float[np.ndarray, "3 3"]) -> Iterator[PlaneCombs | None]:
        yield _combed(looks.coarse, camera, R, local=False)
        yield _combed(looks.fine, camera, R, local=False)
        yield _where_crowded(looks.fine, segments, camera, R)

    seen = glances(*hypotheses[0]) if hypotheses else ()
    return next((p for p in seen if p is not None and p.score > PROMISING_NATS), None)


def comb_planes(
    looks: Looks, segments: Segments, hypotheses: list[Hypothesis], *, free_focal: bool
) -> list[PlaneCombs]:
    """The joints of both families on the hypothesised grounds, the planes with the clearest joints first.

    Those that are clearest as they came are sharpened, and looked at again.
    """
    return sharpened(looks, segments, planes_as_they_came(looks, hypotheses), free_focal=free_focal)


def sharpened(
    looks: Looks, segments: Segments, planes: list[PlaneCombs], count: int = SHARPENED, *, free_focal: bool
) -> list[PlaneCombs]:
    """Planes of which the first `count` have their joints lined up, the clearest first again."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        again = pool.map(
            lambda plane: _lined_up(looks, segments, plane, free_focal=free_focal), planes[:count]
        )
        return sorted([*again, *planes[count:]], key=lambda plane: -plane.score)


def planes_as_they_came(looks: Looks, hypotheses: list[Hypothesis]) -> list[PlaneCombs]:
    """The joints of the hypothesised grounds as they came, the planes with the clearest ones first."""
    # Most of it is done in numpy and OpenCV, which lets the planes go side by side.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        planes = pool.map(lambda hypothesis: _combed(looks.fine, *hypothesis), hypotheses)
        return sorted((plane for plane in planes if plane is not None), key=lambda plane: -plane.score)


def _lined_up(looks: Looks, segments: Segments, plane: PlaneCombs, *, free_focal: bool) -> PlaneCombs:
    """The plane with its joints lined up, looked at again.

    As a whole, where the joints are clearest, and where the segments crowd.
    """
    sharp = sharpen(segments, plane.camera, plane.R, free_focal=free_focal)
    again = (_combed(look, *sharp) for look in (looks.fine, looks.coarse, looks.unshaded))
    best = max((plane, *(p for p in again if p is not None)), key=lambda p: p.score)
    near = (
        near
        for look in (looks.fine, looks.unshaded)
        for near in (_zoomed(look, best), _where_crowded(look, segments, *sharp))
    )
    return max((best, *(p for p in near if p is not None)), key=lambda p: p.score)


def _combed(
    look: Look, camera: Camera, R: Float[np.ndarray, "3 3"], *, local: bool = True
) -> PlaneCombs | None:
    rectified = rectify(
        look.gradient, camera.scaled(*look.gradient.size), R, size=look.lines, strong=look.strong
    )
    if rectified is None:
        return None
    return PlaneCombs(camera, R, best_combs(rectified.x, local=local), best_combs(rectified.y, local=local))


def _zoomed(look: Look, plane: PlaneCombs) -> PlaneCombs | None:
    """The plane with the combs of both families where its clearest local comb lies."""
    families = enumerate((plane.x, plane.y))
    local = [(comb, axis) for axis, combs in families for comb in combs if np.isfinite(comb.lines).all()]
    if not local:
        return None
    comb, axis = max(local, key=lambda pair: pair[0].score)
    margin = ZOOM_MARGIN * comb.spacing
    across, along = (comb.lines[0] - margin, comb.lines[1] + margin), comb.along
    x, y = (along, across) if axis == 0 else (across, along)
    return _in_window(look, plane.camera, plane.R, Window((x[0], y[0]), (x[1], y[1])))


def _where_crowded(
    look: Look, segments: Segments, camera: Camera, R: Float[np.ndarray, "3 3"]
) -> PlaneCombs | None:
    """The joints of a hypothesised ground where its segments crowd."""
    window = crowded_window(segments, camera, R)
    return None if window is None else _in_window(look, camera, R, window, piece=CROWD_PIECE)


def _in_window(
    look: Look, camera: Camera, R: Float[np.ndarray, "3 3"], window: Window, *, piece: int = PIECE
) -> PlaneCombs | None:
    """The joints of a hypothesised ground in a part of it, at the price of the choice."""
    own = camera.scaled(*look.gradient.size)
    rectified = rectify(look.gradient, own, R, size=look.lines, window=window, strong=look.strong)
    if rectified is None:
        return None
    families = (best_combs(family, local=True, piece=piece) for family in (rectified.x, rectified.y))
    x, y = zip(window.low, window.high, strict=True)
    x_combs, y_combs = (
        tuple(_within(replace(c, score=c.score - ZOOM_NATS), lines, reach) for c in combs)
        for combs, lines, reach in zip(families, (y, x), (x, y), strict=True)
    )
    return PlaneCombs(camera, R, x_combs, y_combs)


def _within(comb: Comb, lines: _Interval, along: _Interval) -> Comb:
    """A comb with its field cut to a part of the ground."""
    return replace(comb, lines=_overlap(comb.lines, lines), along=_overlap(comb.along, along))


def _overlap(a: _Interval, b: _Interval) -> _Interval:
    return max(a[0], b[0]), min(a[1], b[1])


def with_other_focals(looks: Looks, plane: PlaneCombs) -> list[PlaneCombs]:
    """The plane by other focal lengths, with the horizon and the clearer joints' direction where they are.

    Those with the clearest joints come first. The joints between the slabs of a row are short, and tell where
    they vanish, and so the focal length, much worse than the rows do.
    """
    clearer = 0 if _score(plane.x) > _score(plane.y) else 1
    return planes_as_they_came(looks, [_by_focal(plane, factor, clearer) for factor in OTHER_FOCALS])


def _by_focal(plane: PlaneCombs, factor: float, axis: int) -> Hypothesis:
    """The plane by so many times its focal length; in the picture its horizon and one axis's end stay."""
    camera = replace(plane.camera, fx=factor * plane.camera.fx, fy=factor * plane.camera.fy)
    end = plane.R[:, axis] * [1.0, 1.0, factor]
    up = plane.R[:, 2] * [factor, factor, 1.0]
    end, up = end / np.linalg.norm(end), up / np.linalg.norm(up)
    other = np.cross(up, end) if axis == 0 else np.cross(end, up)
    return camera, np.stack([end, other, up] if axis == 0 else [other, end, up], 1)
