"""What a calibration gives: the camera, and everything that is known about how well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from autoreg.calibration.adjustment import Adjustment
from autoreg.calibration.bad_views import BadView
from autoreg.calibration.board import Board
from autoreg.calibration.coverage import Coverage
from autoreg.calibration.flatness import Flatness
from autoreg.calibration.model_choice import Trial
from autoreg.calibration.models import LensModel
from autoreg.calibration.observations import Data
from autoreg.calibration.precision import Precision
from autoreg.calibration.projection_map import HalvesDiffer, PictureMap
from autoreg.calibration.verdict import Verdict
from autoreg.camera import Camera

Sheet = Literal["flat", "bent"]


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
