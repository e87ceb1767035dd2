"""Were some photos mirrored, or turned by half, and EXIF does not say so? Their centre is moved over."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int

from autoreg.calibration.adjustment import Adjustment, adjust, fit_poses
from autoreg.calibration.bad_views import sane_views
from autoreg.calibration.models import INTRINSICS
from autoreg.calibration.observations import Data
from autoreg.calibration.precision import precision_of, shared_variance
from autoreg.calibration.unknowns import Freedom, State

# What software does to a picture without changing its size: the signs of its x and y, and the words for it.
SIGNS = np.array([(1, 1), (-1, 1), (1, -1), (-1, -1)])
WORDS = ("as the sensor saw it", "mirrored left to right", "mirrored top to bottom", "turned by 180°")
_MOST_ROUNDS = 8
_TOLERANCE = 1e-5
# Undoing what was done to the views lowers the sum of squares, in units of the scatter that remains, by more
# than so much for each view. Scatter alone, divided by its sign, is explained to 1.3.
_LEAST_GAIN = 6.0
# And it explains all but this part of the variance that the views share beyond their corners' scatter: where
# stabilisation moves the principal point of every photo, the best division leaves 0.11 or more.
_MOST_LEFT = 0.1


@dataclass(frozen=True)
class Flipped:
    """What was done to each view.

    Attributes:
        flips: which of `WORDS` each view is, most being the first.
        fit: the camera of all views, with what was done to them undone.
        gain: by how much undoing it lowers the sum of squares, in units of the remaining scatter, per view.
        left: what is left of the variance that views share, as a part of that in the fit to all as they are.
    """

    flips: Int[np.ndarray, " v"]
    fit: Adjustment
    gain: float
    left: float

    @property
    def certain(self) -> bool:
        """Whether the views cannot all be as the sensor saw them."""
        return self.gain > _LEAST_GAIN and self.left < _MOST_LEFT


def flipped_views(data: Data, start: State, freedom: Freedom, width: int, height: int) -> Flipped | None:
    """Which views were mirrored or turned by half, if that is certain; None if it is not.

    A picture that was mirrored shows the camera with its principal point and its tangential terms mirrored.
    If all were, that is a camera like any other: no single picture of a chessboard tells left from right.
    The camera is fitted and each view given to what explains it best, by turns, until no view changes.

    Args:
        data: the corners of all views.
        start: first values.
        freedom: what may move besides the poses.
        width: of the frame in pixels.
        height: likewise.
    """
    sane = sane_views(data, start)
    if len(sane) < 2:
        return None
    some = data.part(sane)
    joint = adjust(some, start.part(sane), freedom)
    if precision_of(joint).dispersion <= 1:
        return None
    middle = np.array([width - 1, height - 1]) / 2
    settled = [_settled(some, joint, first, kinds, middle) for kinds, first in _starts(joint)]
    certain = [found for found in settled if found is not None and found.certain]
    if not certain:
        return None
    # Software does one thing to a folder; a mixture of several is believed only if none of them explains it.
    best = max(certain, key=lambda found: (-len(np.unique(found.flips)), found.gain))
    flips = np.zeros(len(data), int)
    flips[sane] = best.flips
    return replace(best, flips=flips)


def _starts(joint: Adjustment) -> Generator[tuple[tuple[int, ...], Int[np.ndarray, " v"]]]:
    """What may have been done, and a first guess: the views that pull the centre to one side."""
    across, down = (joint.gradients[:, _among(joint, name)] > 0 for name in ("cx", "cy"))
    yield (0, 1), 1 * across
    yield (0, 2), 2 * down
    yield (0, 3), 3 * across
    yield (0, 3), 3 * down
    yield (0, 1, 2, 3), across + 2 * down


def _among(fit: Adjustment, name: str) -> int:
    """Where an intrinsic stands among the free unknowns."""
    return int(fit.free[: INTRINSICS.index(name)].sum())


def _settled(
    data: Data,
    joint: Adjustment,
    flips: Int[np.ndarray, " v"],
    kinds: tuple[int, ...],
    middle: Float[np.ndarray, "2"],
) -> Flipped | None:
    """The guess at which no view changes any more."""
    state = joint.state
    for _ in range(_MOST_ROUNDS):
        flips = _fewest(flips)
        if not flips.any():
            return None
        here = _undone(data, flips, middle)
        fit = adjust(here, _posed(joint.state, state, flips), joint.freedom, tolerance=_TOLERANCE)
        if fit.outcome == "diverged":
            return None
        state = fit.state
        rms = np.array([_foretold(data, joint.state, state, kind, middle) for kind in kinds])
        now = np.array(kinds)[np.argmin(rms, axis=0)]
        if (now == flips).all():
            return _judged(joint, flips, fit)
        flips = now
    return None


def _fewest(flips: Int[np.ndarray, " v"]) -> Int[np.ndarray, " v"]:
    """The same guess with what was done to most views taken for nothing: one flip more of all is a camera."""
    most = int(np.argmax(np.bincount(flips, minlength=len(SIGNS))))
    return flips ^ most


def _undone(data: Data, flips: Int[np.ndarray, " v"], middle: Float[np.ndarray, "2"]) -> Data:
    """The corners with what was done to the views undone."""
    return replace(data, px=middle + SIGNS[flips][:, None] * (data.px - middle))


def _posed(joint: State, near: State, flips: Sequence[int] | np.ndarray) -> State:
    """The intrinsics of one state, with the poses of another as they look once a flip is undone."""
    return replace(
        near, poses=np.array([_turned(p, SIGNS[f]) for p, f in zip(joint.poses, flips, strict=True)])
    )


def _turned(pose: Float[np.ndarray, "6"], signs: Int[np.ndarray, "2"]) -> Float[np.ndarray, "6"]:
    """The pose of a flat board in a picture with mirrored axes: a mirrored board shows its back."""
    mirror = np.array([signs[0], signs[1], 1.0])
    R = np.asarray(cv2.Rodrigues(pose[:3])[0])
    x, y = mirror * R[:, 0], mirror * R[:, 1]
    turned = np.asarray(cv2.Rodrigues(np.column_stack([x, y, np.cross(x, y)]))[0]).ravel()
    return np.concatenate([turned, mirror * pose[3:]])


def _foretold(
    data: Data, joint: State, camera: State, flip: int, middle: Float[np.ndarray, "2"]
) -> Float[np.ndarray, " v"]:
    """How well a camera explains each view if it was flipped in one way."""
    flips = np.full(len(data), flip)
    posed = fit_poses(_undone(data, flips, middle), _posed(joint, camera, flips), tolerance=_TOLERANCE)
    return posed.view_rms_px


def _judged(joint: Adjustment, flips: Int[np.ndarray, " v"], fit: Adjustment) -> Flipped:
    scatter = (fit.sigma_px * precision_of(fit).dispersion) ** 2
    gain = float((joint.residuals_px**2).sum() - (fit.residuals_px**2).sum()) / scatter / len(flips)
    return Flipped(flips, fit, gain, shared_variance(fit) / max(shared_variance(joint), 1e-300))
