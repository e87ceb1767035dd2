"""Calibration on one page: photos, boards, one camera, bad views, lens model, solve, quality, verdict."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from autoreg.blas_threads import one_blas_thread
from autoreg.calibration.adjustment import adjust
from autoreg.calibration.bad_views import Sifted, sift
from autoreg.calibration.board import DEFAULT_DICTIONARY, DEFAULT_MARKER, Board, BoardView, parse_pattern
from autoreg.calibration.coverage import coverage_of
from autoreg.calibration.flatness import examine_flatness
from autoreg.calibration.flips import flipped_views
from autoreg.calibration.grouping import one_camera
from autoreg.calibration.mixture import two_cameras
from autoreg.calibration.model_choice import choice_covariance, chosen, freedom_of, rayless, try_models
from autoreg.calibration.models import GENERAL, LensModel, camera_of
from autoreg.calibration.observations import Data, data_of
from autoreg.calibration.photos import Progress, Source, find_pattern, search_photos, sources_of
from autoreg.calibration.precision import precision_of
from autoreg.calibration.projection_map import halves_differ, uncertainty_map
from autoreg.calibration.refusals import (
    LEAST_VIEWS,
    refuse_repeats,
    refuse_undetermined,
    refuse_unknown,
    refuse_wrong_pattern,
    too_few,
    without_flipped,
    without_foreign,
)
from autoreg.calibration.result import Calibration, LeftOut, Sheet
from autoreg.calibration.starting import first_state, sound
from autoreg.calibration.unknowns import Freedom, State
from autoreg.calibration.verdict import Evidence, verdict_on
from autoreg.errors import InputError, Refusal


def calibrate(
    photos: str | Path | Iterable[Source],
    pattern: str | tuple[int, int] = "auto",
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
        pattern: inner corners along a row x along a column, such as "9x6" or (9, 6), or "auto".
        square: side of a square in metres, if known; it changes no intrinsic.
        charuco: whether the white squares hold ArUco markers.
        dictionary: the markers' dictionary.
        marker: side of a marker as a part of the square's.
        sheet: "flat", or "bent" to estimate the sheet's shape along with the camera.
        progress: is told how many photos of how many are searched.
        workers: photos searched at once.

    Raises:
        ValueError: an argument is of the wrong kind.
        InputError: the photos cannot be used: missing, no board in them, of several cameras.
        Refusal: the views do not determine a camera.
    """
    sources = sources_of(photos)
    board = _board(sources, pattern, square, charuco, dictionary, marker)
    found = search_photos(sources, board, progress, workers)
    refuse_wrong_pattern(found, board)
    without = [LeftOut(p.name, p.detection.reason or "") for p in found if not p.detection.found]
    if len(found) - len(without) < LEAST_VIEWS:
        raise too_few(len(found), without, board, sources)
    group, others = one_camera(found)
    left_out = [*without, *(LeftOut(name, reason) for name, reason in others)]
    return calibrate_views(
        group.views, board, group.width, group.height, sheet=sheet, left_out=left_out, notes=group.notes
    )


@one_blas_thread()
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
        InputError: there are fewer than three views, or they are of two cameras, or mirrored.
        Refusal: the views do not determine a camera.
    """
    if len(views) < LEAST_VIEWS:
        raise InputError(
            f"{len(views)} views of a board do not determine a camera; give at least {LEAST_VIEWS}"
        )
    everything = data_of(views, board)
    refuse_repeats(everything)
    everything, start, foreign = _of_one_camera(everything, width, height)
    sifted, bent = _sifted(everything, start, board, width, height, sheet)
    data = everything.part(sifted.kept)
    refuse_undetermined(data, sifted.state, width, height)
    trials = try_models(data, sifted.state, width, height, shape=bent)
    if not trials:
        raise Refusal(
            "undetermined",
            f"{len(data)} views with {int(data.present.sum())} corners determine no camera; add views, with "
            "more of the board in each",
        )
    picked = chosen(trials)
    model = picked.model
    flat_fit = adjust(data, _with(sifted.state, model), replace(picked.fit.freedom, shape=False))
    flatness = examine_flatness(data, flat_fit, board)
    fit = flatness.bent_fit if sheet == "bent" and flatness.bent_fit is not None else flat_fit
    precision = precision_of(fit)
    among = choice_covariance(trials, picked, precision.dispersion)
    precision = replace(precision, covariance=precision.covariance + among)
    camera = camera_of(fit.state.intrinsics, width, height)
    refuse_unknown(fit, precision)
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
        standpoints=data.standpoints,
        bad=len(sifted.bad),
        bent_focal_change=change,
        rayless=rayless(fit.state, width, height),
    )
    return Calibration(
        camera=camera,
        board=board,
        model=model,
        precision=precision,
        data=data,
        fit=fit,
        trials=trials,
        left_out=(*left_out, *foreign, *(LeftOut(bad.name, bad.reason) for bad in sifted.bad)),
        bad=sifted.bad,
        notes=tuple(notes),
        sheet="flat" if fit is flat_fit else "bent",
        flatness=flatness,
        coverage=coverage,
        uncertainty=uncertainty,
        halves=halves,
        verdict=verdict_on(evidence),
    )


def _of_one_camera(data: Data, width: int, height: int) -> tuple[Data, State, tuple[LeftOut, ...]]:
    """The views of one camera, first values for them, and the views that are not of it, if they are few.

    Raises:
        InputError: they are many.
    """
    start = first_state(data, width, height)
    freedom = freedom_of(GENERAL, start, width, height)
    left_out: tuple[LeftOut, ...] = ()
    # Mirrored photos look like another camera's, so they are sought first.
    flipped = flipped_views(data, start, freedom, width, height)
    if flipped is not None:
        data, left_out = without_flipped(data, flipped)
        start = start.part(np.flatnonzero(flipped.flips == 0))
    mixture = two_cameras(data, start, freedom)
    if mixture is None:
        return data, start, left_out
    kept, foreign = without_foreign(data, mixture)
    return kept, start.part(np.flatnonzero(~mixture.second)), (*left_out, *foreign)


def _sifted(
    data: Data, start: State, board: Board, width: int, height: int, sheet: Sheet
) -> tuple[Sifted, bool]:
    """The views that agree, and whether the sheet is bent, so that its shape must be allowed for.

    A bent sheet passes for a lens, and its errors are so large that bad views are hidden behind them.
    """

    def is_sound(state: State) -> bool:
        return sound(state, width, height)

    sifted = sift(data, start, is_sound)
    kept = data.part(sifted.kept)
    first = adjust(kept, _with(sifted.state, GENERAL), Freedom(GENERAL.free))
    if sheet == "flat" and not examine_flatness(kept, first, board).bent:
        return sifted, False
    again = sift(kept, first.state, is_sound, shape=True)
    which = tuple(sifted.kept[k] for k in again.kept)
    flat = replace(again.state, shape=np.zeros_like(again.state.shape))
    return Sifted(which, flat, (*sifted.bad, *again.bad)), True


def _board(
    sources: Sequence[Source],
    pattern: str | tuple[int, int],
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
                "whole board shows, or give --pattern"
            )
    known = square is not None
    kind = "charuco" if charuco else "chessboard"
    board = Board(size[0], size[1], square if square is not None else 1.0, known, kind, dictionary, marker)
    if charuco:
        board.charuco()  # complains about the dictionary before any photo is read
    return board


def _with(state: State, model: LensModel) -> State:
    """A state with the coefficients that a model does not have at zero."""
    return replace(state, intrinsics=model.restricted(state.intrinsics))
