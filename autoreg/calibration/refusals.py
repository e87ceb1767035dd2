"""What cannot be calibrated: too few boards, a wrong pattern, views that determine no camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autoreg.calibration.adjustment import Adjustment
from autoreg.calibration.board import Board
from autoreg.calibration.coverage import coverage_of
from autoreg.calibration.flips import WORDS, Flipped
from autoreg.calibration.grouping import LEAST_SHARE, few
from autoreg.calibration.mixture import Mixture
from autoreg.calibration.observations import Data
from autoreg.calibration.photos import BoardPhoto, Source, find_pattern
from autoreg.calibration.precision import Precision
from autoreg.calibration.result import LeftOut
from autoreg.calibration.starting import sound
from autoreg.calibration.unknowns import State
from autoreg.errors import InputError, Refusal

LEAST_VIEWS = 3
# Of a focal length known no better than this, even the order of magnitude of the pose's errors is unknown.
_UNKNOWN_FOCAL = 0.05
# A board tilted by less than this in every view leaves focal length and distance to each other.
_PARALLEL_DEG = 5.0
# A side of the board with further corners, in this part of the views, means that the pattern is larger.
_LARGER_SHARE = 0.5


def refuse_wrong_pattern(photos: Sequence[BoardPhoto], board: Board) -> None:
    """A part of a larger board makes a grid too, but not the same part in every photo."""
    goes_on = [photo.detection.goes_on for photo in photos if photo.detection.found]
    larger = sum(any(sides) for sides in goes_on)
    if board.kind == "chessboard" and goes_on and larger > _LARGER_SHARE * len(goes_on):
        raise InputError(
            f"in {larger} of {len(goes_on)} photos black and white squares go on beyond {board.pattern} "
            "inner corners, so the board is larger than the pattern; count the corners where four squares "
            "meet, or use --pattern auto"
        )


def too_few(count: int, without: Sequence[LeftOut], board: Board, sources: Sequence[Source]) -> InputError:
    """The error of too few boards: each photo's reason, and the pattern that the photos seem to show.

    Args:
        count: number of photos.
        without: those that show no board.
        board: what was looked for.
        sources: the photos.
    """
    found = count - len(without)
    lines = [f"  {photo.name}: {photo.reason}" for photo in without[:20]]
    if len(without) > 20:
        lines.append(f"  ... and {len(without) - 20} more")
    hint = ""
    if board.kind == "chessboard" and without:
        seen = find_pattern(sources)
        if seen is not None and sorted(seen) != sorted((board.columns, board.rows)):
            hint = f"; the photos look like boards of {seen[0]}x{seen[1]} inner corners"
    return InputError(
        f"the {board.pattern} board was found in {found} of {count} photos, but a camera needs at least "
        f"{LEAST_VIEWS} views, better 15 to 30{hint}" + ("\n" + "\n".join(lines) if lines else "")
    )


def refuse_repeats(data: Data) -> None:
    """Refuse views that are too few because they repeat one another, as a resting video's frames do."""
    if data.standpoints < LEAST_VIEWS:
        places = "one place" if data.standpoints == 1 else f"only {data.standpoints} different places"
        raise Refusal(
            "undetermined",
            f"the {len(data)} views show the board in {places}, so they count as {data.standpoints}: what is "
            f"wrong in one is wrong in all; add views with the board elsewhere, from at least {LEAST_VIEWS} "
            "standpoints, better 15 to 30",
            measured=float(data.standpoints),
            limit=float(LEAST_VIEWS),
        )


def without_flipped(data: Data, flipped: Flipped) -> tuple[Data, tuple[LeftOut, ...]]:
    """The views that stand as the sensor saw them, and those that do not, if they are few.

    Args:
        data: the corners of all views.
        flipped: what was done to each view.

    Raises:
        InputError: too many were flipped to say which are as the sensor saw them.
    """
    upright = flipped.flips == 0
    if upright.sum() < LEAST_SHARE * len(data):
        kinds = [(k, [data.names[j] for j in np.flatnonzero(flipped.flips == k)]) for k in range(len(WORDS))]
        lines = [
            f"  {len(names)} {f'{WORDS[k]} against these' if k else 'of one kind'}: {few(names)}"
            for k, names in kinds
            if names
        ]
        raise InputError(
            "some photos were mirrored or turned over by software and their EXIF does not say so: each group "
            "shows the principal point on another side of the middle, so together they give a wrong one; "
            "give the group that stands as the camera saw it:\n" + "\n".join(lines)
        )
    left_out = tuple(
        LeftOut(
            data.names[k],
            f"it is {WORDS[flipped.flips[k]]} against most photos, and its EXIF does not say so: it shows "
            "the principal point on the other side of the middle",
        )
        for k in np.flatnonzero(~upright)
    )
    return data.part(np.flatnonzero(upright)), left_out


def without_foreign(data: Data, mixture: Mixture) -> tuple[Data, tuple[LeftOut, ...]]:
    """The views of one camera, and those that another camera saw, if they are few.

    Args:
        data: the corners of all views.
        mixture: the views as two cameras.

    Raises:
        InputError: neither camera saw most of the views.
    """
    members = np.flatnonzero(~mixture.second), np.flatnonzero(mixture.second)
    if len(members[0]) < LEAST_SHARE * len(data):
        lines = [
            f"  {len(group)} with a focal length of {fit.state.intrinsics[0]:.0f} px, principal point "
            f"({fit.state.intrinsics[2]:.0f}, {fit.state.intrinsics[3]:.0f}): "
            + few([data.names[k] for k in group])
            for group, fit in zip(members, mixture.cameras, strict=True)
        ]
        raise InputError(
            "the photos are of two cameras, or of one at two settings (zoom, focus, crop, lens): each "
            f"group fits a camera of its own, {mixture.apart:.0f} standard deviations from the other's; give "
            "one group at a time:\n" + "\n".join(lines)
        )
    focal = mixture.cameras[1].state.intrinsics[0]
    reason = f"it is of another camera or setting, with a focal length of {focal:.0f} px"
    return data.part(members[0]), tuple(LeftOut(data.names[k], reason) for k in members[1])


def refuse_undetermined(data: Data, state: State, width: int, height: int) -> None:
    """Refuse views that fit no camera, or that are all parallel to the sensor."""
    if not sound(state, width, height):
        raise Refusal(
            "undetermined",
            "the views fit no camera: the solve ran away; check that the photos are of one camera and one "
            "flat board, and add views with the board tilted by 20° to 45°",
        )
    tilt = float(coverage_of(data, state, width, height).tilts_deg.max())
    if tilt < _PARALLEL_DEG:
        raise Refusal(
            "undetermined",
            f"all views are nearly parallel to the sensor (tilted by at most {tilt:.1f}°), so focal length "
            "and distance cannot be told apart; add views with the board tilted by 20° to 45°, about both "
            "axes",
            measured=tilt,
            limit=_PARALLEL_DEG,
        )


def refuse_unknown(fit: Adjustment, precision: Precision) -> None:
    """Refuse a fit whose focal length is not known."""
    part = float(np.max(precision.std_devs[:2] / np.abs(fit.state.intrinsics[:2])))
    if not precision.determined or not part < _UNKNOWN_FOCAL or fit.outcome == "diverged":
        known = f"only to ±{100 * part:.0f} %" if precision.determined and np.isfinite(part) else "not at all"
        raise Refusal(
            "undetermined",
            f"the views determine the focal length {known}; do not use them: add views with the board tilted "
            "by 20° to 45° about both axes, and close enough to fill half the picture",
            measured=part if np.isfinite(part) else None,
            limit=_UNKNOWN_FOCAL,
        )
