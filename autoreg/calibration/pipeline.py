"""Calibration on one page: photos, boards, one camera, bad views, lens model, solve, quality, verdict."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from autoreg.calibration.adjustment import Adjustment, Data, Freedom, State, adjust, data_of
from autoreg.calibration.bad_views import BadView, sift
from autoreg.calibration.board import DEFAULT_DICTIONARY, DEFAULT_MARKER, Board, BoardView, parse_pattern
from autoreg.calibration.coverage import Coverage, coverage_of
from autoreg.calibration.flatness import Flatness, examine_flatness
from autoreg.calibration.grouping import one_camera
from autoreg.calibration.model_choice import Trial, choice_covariance, chosen, try_models
from autoreg.calibration.models import GENERAL, LensModel, camera_of
from autoreg.calibration.photos import (
    BoardPhoto,
    Progress,
    Source,
    find_pattern,
    photo_files,
    search_photos,
)
from autoreg.calibration.precision import Precision, precision_of
from autoreg.calibration.projection_map import HalvesDiffer, PictureMap, halves_differ, uncertainty_map
from autoreg.calibration.starting import first_state, sound
from autoreg.calibration.verdict import Evidence, Verdict, verdict_on
from autoreg.camera import Camera
from autoreg.errors import InputError, Refusal

Sheet = Literal["flat", "bent"]

_LEAST_VIEWS = 3
# Of a focal length known no better than this, even the order of magnitude of the pose's errors is unknown.
_UNKNOWN_FOCAL = 0.05
# A board tilted by less than this in every view leaves focal length and distance to each other.
_PARALLEL_DEG = 5.0
# A side of the board with further corners, in this part of the views, means that the pattern is larger.
_LARGER_SHARE = 0.5


@dataclass(frozen=True)
class LeftOut:
    """A photo that took no part, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera and everything that is known about how well.

    Attributes:
        camera: the camera.
        board: the board it was calibrated with.
        model: the lens model that was chosen.
        precision: the intrinsics' covariance.
        data: the corners of the views that took part.
        fit: the adjustment they gave.
        trials: the lens models that were tried.
        left_out: photos that took no part, and why.
        bad: those of them that contradict the other views.
        notes: what was done to the photos.
        sheet: whether the sheet was taken for flat or its shape was estimated.
        flatness: how flat the sheet was.
        coverage: where boards were seen.
        uncertainty: how well each pixel's direction is known.
        halves: how calibrations of half of the views differ, or None for too few views.
        verdict: whether to trust it.
    """

    camera: Camera
    board: Board
    model: LensModel
    precision: Precision
    data: Data
    fit: Adjustment
    trials: tuple[Trial, ...]
    left_out: tuple[LeftOut, ...]
    bad: tuple[BadView, ...]
    notes: tuple[str, ...]
    sheet: Sheet
    flatness: Flatness
    coverage: Coverage
    uncertainty: PictureMap
    halves: HalvesDiffer | None
    verdict: Verdict

    @property
    def rms_px(self) -> float:
        """OpenCV's RMS over all corners of the views that took part."""
        return self.fit.rms_px

    @property
    def mean_l2_over_n_px(self) -> float:
        """The mean over views of |residuals|_2 / N: about RMS / sqrt(N)."""
        return self.fit.mean_l2_over_n_px


def calibrate(
    photos: str | Path | Iterable[Source],
    pattern: str = "auto",
    *,
    square: float | None = None,
    charuco: bool = False,
    dictionary: str = DEFAULT_DICTIONARY,
    marker: float = DEFAULT_MARKER,
    sheet: Sheet = "flat",
    progress: Progress | None = None,
    workers: int | None = None,
) -> Calibration:
    """The camera of some photos of a calibration board, with how well it is known and a verdict.

    Args:
        photos: a glob pattern, a folder, or files or pictures (grey or BGR arrays).
        pattern: inner corners along a row x along a column, such as "9x6", or "auto".
        square: side of a square in metres, if known; it changes no intrinsic.
        charuco: whether the white squares hold ArUco markers.
        dictionary: the markers' dictionary.
        marker: side of a marker as a part of the square's.
        sheet: "flat", or "bent" to estimate the sheet's shape along with the camera.
        progress: is told how many photos of how many are searched.
        workers: photos searched at once.

    Raises:
        InputError: the photos cannot be used: missing, no board in them, of several cameras.
        Refusal: the views do not determine a camera.
    """
    sources = _sources(photos)
    board = _board(sources, pattern, square, charuco, dictionary, marker)
    found = search_photos(sources, board, progress, workers)
    _refuse_wrong_pattern(found, board)
    without = [LeftOut(p.name, p.detection.reason or "") for p in found if not p.detection.found]
    if len(found) - len(without) < _LEAST_VIEWS:
        raise _too_few(len(found), without, board, sources)
    group, others = one_camera(found)
    left_out = [*without, *(LeftOut(name, reason) for name, reason in others)]
    return calibrate_views(
        group.views, board, group.width, group.height, sheet=sheet, left_out=left_out, notes=group.notes
    )


def calibrate_views(
    views: Sequence[BoardView],
    board: Board,
    width: int,
    height: int,
    *,
    sheet: Sheet = "flat",
    left_out: Sequence[LeftOut] = (),
    notes: Sequence[str] = (),
) -> Calibration:
    """The camera of corners that were already found; see `calibrate`.

    Args:
        views: the corners.
        board: the board.
        width: of the frame in pixels.
        height: likewise.
        sheet: whether the sheet is taken for flat.
        left_out: photos that take no part, and why, to be passed on.
        notes: what was done to the photos, likewise.

    Raises:
        InputError: there are fewer than three views.
        Refusal: the views do not determine a camera.
    """
    if len(views) < _LEAST_VIEWS:
        raise InputError(
            f"{len(views)} views of a board do not determine a camera; give at least {_LEAST_VIEWS}"
        )
    everything = data_of(views, board)
    start = first_state(everything, width, height)
    sifted = sift(everything, start, lambda state: sound(state, width, height))
    data = everything.part(sifted.kept)
    _refuse_undetermined(data, sifted.state, width, height)
    # A bent sheet passes for a lens: where it is bent, lens models are compared with its shape allowed for.
    first = adjust(data, _with(sifted.state, GENERAL), Freedom(GENERAL.free))
    bent = sheet == "bent" or examine_flatness(data, first, board).bent
    trials = try_models(data, sifted.state, width, height, shape=bent)
    if not trials:
        raise Refusal(
            "undetermined",
            f"{len(data)} views with {int(data.present.sum())} corners determine no camera; add views, with "
            "more of the board in each",
        )
    picked = chosen(trials)
    model = picked.model
    flat_fit = adjust(data, _with(sifted.state, model), Freedom(model.free))
    flatness = examine_flatness(data, flat_fit, board)
    fit = flat_fit
    if sheet == "bent" and flatness.bent_fit is not None:
        fit = flatness.bent_fit
    precision = precision_of(fit)
    among = choice_covariance(trials, picked, precision.dispersion)
    precision = replace(precision, covariance=precision.covariance + among)
    camera = camera_of(fit.state.intrinsics, width, height)
    _refuse_unknown(fit, precision)
    anchors = data.px[data.present]
    uncertainty = uncertainty_map(fit.state.intrinsics, precision.covariance, anchors, width, height)
    halves = halves_differ(data, fit, precision.covariance, anchors, width, height)
    coverage = coverage_of(data, fit.state, width, height)
    change = None
    if fit is flat_fit and flatness.bent_fit is not None:
        change = float(flatness.bent_fit.state.intrinsics[0] / fit.state.intrinsics[0] - 1)
    evidence = Evidence(
        camera=camera,
        precision=precision,
        coverage=coverage,
        flatness=flatness if fit is flat_fit else examine_flatness(data, fit, board),
        uncertainty=uncertainty,
        halves=halves,
        rms_px=fit.rms_px,
        views=len(data),
        bad=len(sifted.bad),
        bent_focal_change=change,
        folds=picked.folds_inside,
    )
    return Calibration(
        camera=camera,
        board=board,
        model=model,
        precision=precision,
        data=data,
        fit=fit,
        trials=trials,
        left_out=(*left_out, *(LeftOut(bad.name, bad.reason) for bad in sifted.bad)),
        bad=sifted.bad,
        notes=tuple(notes),
        sheet="flat" if fit is flat_fit else "bent",
        flatness=flatness,
        coverage=coverage,
        uncertainty=uncertainty,
        halves=halves,
        verdict=verdict_on(evidence),
    )


def _sources(photos: str | Path | Iterable[Source]) -> list[Source]:
    if isinstance(photos, (str, Path)):
        return list(photo_files([photos]))
    sources: list[Source] = []
    for photo in photos:
        sources += [photo] if isinstance(photo, np.ndarray) else photo_files([photo])
    if not sources:
        raise InputError("no photos were given; give photos of the board, such as 'boards/*.jpg'")
    return sources


def _board(
    sources: Sequence[Source],
    pattern: str,
    square: float | None,
    charuco: bool,
    dictionary: str,
    marker: float,
) -> Board:
    size = parse_pattern(pattern)
    if size is None and charuco:
        raise InputError("--pattern auto cannot count a ChArUco board; give its inner corners, such as 9x6")
    if size is None:
        size = find_pattern(sources)
        if size is None:
            raise InputError(
                "no chessboard was found in the photos, so its pattern cannot be counted; check that the "
                "whole "
                "board shows, or give --pattern"
            )
    known = square is not None
    kind = "charuco" if charuco else "chessboard"
    board = Board(size[0], size[1], square if square is not None else 1.0, known, kind, dictionary, marker)
    if charuco:
        board.charuco()  # complains about the dictionary before any photo is read
    return board


def _refuse_wrong_pattern(photos: Sequence[BoardPhoto], board: Board) -> None:
    """A part of a larger board makes a grid too, but not the same part in every photo."""
    goes_on = [photo.detection.goes_on for photo in photos if photo.detection.found]
    larger = sum(any(sides) for sides in goes_on)
    if board.kind == "chessboard" and goes_on and larger > _LARGER_SHARE * len(goes_on):
        raise InputError(
            f"in {larger} of {len(goes_on)} photos black and white squares go on beyond {board.pattern} "
            "inner "
            "corners, so the board is larger than the pattern; count the corners where four squares meet, "
            "or use "
            "--pattern auto"
        )


def _too_few(count: int, without: Sequence[LeftOut], board: Board, sources: Sequence[Source]) -> InputError:
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
        f"a {board.pattern} board was found in {found} of {count} photos, but a camera needs at least "
        f"{_LEAST_VIEWS} views, better 15 to 30{hint}" + ("\n" + "\n".join(lines) if lines else "")
    )


def _with(state: State, model: LensModel) -> State:
    """A state with the coefficients that a model does not have at zero."""
    return replace(state, intrinsics=model.restricted(state.intrinsics))


def _refuse_undetermined(data: Data, state: State, width: int, height: int) -> None:
    if not sound(state, width, height):
        raise Refusal(
            "undetermined",
            "the views fit no camera: the solve ran away; check that the photos are of one camera and one "
            "flat "
            "board, and add views with the board tilted by 20° to 45°",
        )
    tilt = float(coverage_of(data, state, width, height).tilts_deg.max())
    if tilt < _PARALLEL_DEG:
        raise Refusal(
            "undetermined",
            f"all views are nearly parallel to the sensor (tilted by at most {tilt:.1f}°), so focal length "
            "and "
            "distance cannot be told apart; add views with the board tilted by 20° to 45°, about both axes",
            measured=tilt,
            limit=_PARALLEL_DEG,
        )


def _refuse_unknown(fit: Adjustment, precision: Precision) -> None:
    part = float(np.max(precision.std_devs[:2] / np.abs(fit.state.intrinsics[:2])))
    if not precision.determined or not part < _UNKNOWN_FOCAL or fit.outcome == "diverged":
        known = f"only to ±{100 * part:.0f} %" if precision.determined and np.isfinite(part) else "not at all"
        raise Refusal(
            "undetermined",
            f"the views determine the focal length {known}; do not use them: add views with the board "
            "tilted by "
            "20° to 45° about both axes, and close enough to fill half the picture",
            measured=part if np.isfinite(part) else None,
            limit=_UNKNOWN_FOCAL,
        )
