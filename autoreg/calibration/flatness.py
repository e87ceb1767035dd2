"""Is the sheet flat? What is off the plane shows along the projected normal only, a lens error all round."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.calibration.adjustment import Adjustment, adjust
from autoreg.calibration.board import Board
from autoreg.calibration.observations import Data

# A view looked at so steeply that heights hardly show says nothing about them.
_LEAST_SIGHT = 0.15
_LEAST_VIEWS = 3
# Twice as much scatter along the normal as across it, beyond chance, is a sheet that is not flat.
_BENT_RATIO, _BENT_SIGMAS = 2.0, 3.0
# Heights at every corner can be told from the poses with this many tilted views.
_LEAST_SHAPE_VIEWS = 5


@dataclass(frozen=True)
class Flatness:
    """How flat the sheet was.

    Attributes:
        ratio: scatter along the sheet's projected normal over scatter across it, as mean squares; 1 if flat.
        sigmas: by how many standard errors over the views its logarithm differs from 0.
        height_squares: RMS of the heights that the residuals ask for, in sides of a square.
        agreement: mean correlation of those heights between views: 1 if the sheet kept its shape.
        bent_fit: the fit with the sheet's shape estimated, or None.
    """

    ratio: float
    sigmas: float
    height_squares: float
    agreement: float
    bent_fit: Adjustment | None

    @property
    def bent(self) -> bool:
        """Whether the sheet is not flat, beyond chance."""
        return self.ratio > _BENT_RATIO and self.sigmas > _BENT_SIGMAS


def examine_flatness(data: Data, fit: Adjustment, board: Board) -> Flatness:
    """What the residuals of a fit with a flat sheet say about the sheet."""
    along, across, height_px = _split(data, fit)
    present = fit.present
    sight = np.array([np.median(height_px[k][present[k]]) for k in range(len(data))]) / _square_px(data)
    tells = sight > _LEAST_SIGHT
    if tells.sum() < _LEAST_VIEWS:
        return Flatness(1.0, 0.0, 0.0, 0.0, None)
    energy_along = np.array([np.mean(along[k][present[k]] ** 2) for k in np.flatnonzero(tells)])
    energy_across = np.array([np.mean(across[k][present[k]] ** 2) for k in np.flatnonzero(tells)])
    logs = np.log(np.maximum(energy_along, 1e-30) / np.maximum(energy_across, 1e-30))
    # Even one view's ratio is known no better than its number of corners allows.
    least = np.sqrt(4 / np.median(present.sum(1)))
    error = max(float(np.std(logs, ddof=1)), float(least)) / np.sqrt(len(logs))
    heights = np.where(present, along / np.maximum(height_px, 1e-9), np.nan)[tells]
    bent_fit = None
    if len(data) >= _LEAST_SHAPE_VIEWS and tells.sum() >= _LEAST_VIEWS:
        bent_fit = adjust(data, fit.state, replace(fit.freedom, shape=True))
    return Flatness(
        ratio=float(energy_along.sum() / max(energy_across.sum(), 1e-30)),
        sigmas=float(logs.mean() / error),
        height_squares=float(np.sqrt(np.nanmedian(heights**2)) / 0.6745),
        agreement=_agreement(heights, data.ids[tells], board.corners),
        bent_fit=bent_fit,
    )


def _split(
    data: Data, fit: Adjustment
) -> tuple[Float[np.ndarray, "v n"], Float[np.ndarray, "v n"], Float[np.ndarray, "v n"]]:
    """Residuals along and across the projected normal, and how many pixels a square's height makes there."""
    intrinsics = fit.state.intrinsics
    K = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1.0]])
    along, across, height_px = (np.zeros(data.present.shape) for _ in range(3))
    side = _side(data)
    for k, pose in enumerate(fit.state.poses):
        J = cv2.projectPoints(data.places[k], pose[:3], pose[3:], K, intrinsics[4:])[1]
        by_place = np.asarray(J).reshape(data.present.shape[1], 2, -1)[..., 3:6] @ cv2.Rodrigues(pose[:3])[0]
        normal = by_place[..., 2] * side
        length = np.linalg.norm(normal, axis=-1)
        unit = normal / np.maximum(length, 1e-12)[:, None]
        r = fit.residuals_px[k]
        along[k] = (r * unit).sum(-1)
        across[k] = r[:, 1] * unit[:, 0] - r[:, 0] * unit[:, 1]
        height_px[k] = length
    return along, across, height_px


def _side(data: Data) -> float:
    x = np.unique(np.round(data.places[0][:, 0], 12))
    return float(np.min(np.diff(x)))


def _square_px(data: Data) -> Float[np.ndarray, " v"]:
    """Size of a square in each view's pixels: the square root of the view's area per square."""
    sizes: list[float] = []
    for k in range(len(data)):
        here = data.present[k]
        H = cv2.findHomography(data.places[k][here][:, :2], data.px[k][here])[0]
        x, y = data.places[k][here][:, :2].mean(0)
        w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        sizes.append(float(np.sqrt(abs(np.linalg.det(H) / w**3)) * _side(data)))
    return np.array(sizes)


def _agreement(heights: Float[np.ndarray, "v n"], ids: np.ndarray, corners: int) -> float:
    """Mean correlation of height maps between pairs of views, over the corners that both show."""
    maps = np.full((len(heights), corners), np.nan)
    for k in range(len(heights)):
        good = np.isfinite(heights[k])
        maps[k, ids[k][good]] = heights[k][good]
    values: list[float] = []
    for i in range(len(maps)):
        for j in range(i):
            both = np.isfinite(maps[i]) & np.isfinite(maps[j])
            if both.sum() > 5 and maps[i][both].std() > 0 and maps[j][both].std() > 0:
                values.append(float(np.corrcoef(maps[i][both], maps[j][both])[0, 1]))
    return float(np.mean(values)) if values else 0.0
