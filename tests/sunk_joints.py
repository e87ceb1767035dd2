"""Drawn pavings whose joints lie deep, and how far these are measured from where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from drawn_joints import PLAIN
from paved import POSE_ALONE, gray_of
from scipy.special import ndtr

from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.fit import Fit
from autoreg.fitting.joint_parts import Side
from autoreg.fitting.refine import refine_until_still
from autoreg.ground.points import project_ground
from autoreg.ground.sides import ALONG_X, Grid
from autoreg.joints.joint_looks import Strip
from autoreg.synthetic import SyntheticScene, render_paving

# The sun stands behind the camera and lights the walls that it faces; joints along Y run along the view.
SUNK = replace(
    PLAIN,
    spacing_m=(0.4, 0.3),
    joint_depth_m=0.03,
    sun_azimuth_rad=-np.pi / 2,
    blur_px=0.7,
    samples=3,
    seed=4,
)


def fit_of(scene: SyntheticScene, width: float, polarity: tuple[int, int], reach: float) -> Fit:
    """The fit from the true pose, of joints along X that are thought to be so wide."""
    strip = Strip((width, scene.joint_width_m), scene.blur_px, polarity, polarity_known=True)
    fit = refine_until_still(
        gray_of(render_paving(scene)), scene.camera, scene.cam_from_ground, Grid(*scene.spacing_m),
        free=POSE_ALONE, search=0.0, reach=reach, strip=strip,
    )  # fmt: skip
    assert fit is not None
    return fit


def nearer(fit: Fit, scene: SyntheticScene) -> float:
    """By what share of their width the joints along X are seen nearer than they are."""
    rows = np.flatnonzero(fit.usable & (fit.stations.family == ALONG_X))
    profiles = fit.profiles.take(rows)
    true_px = project_ground(scene.camera, scene.cam_from_ground, fit.stations.ground[rows])
    off = ((profiles.centre_px - true_px) * profiles.normal).sum(1) + fit.offsets.offset_px[rows]
    way = np.sign(across_slope(fit)[rows])
    return float(np.median(-way * off / (scene.joint_width_m * profiles.px_per_unit)))


def drawn_side(
    bed: float,
    other: float,
    off_px: float,
    begins: np.ndarray,
    slope: np.ndarray,
    *,
    half_px: float,
    px_per_unit: float,
    noise: float,
) -> Side:
    """Joints that lie so far beyond where they were found, with a bed of one tone and another part beside it.

    That part `begins` at such places, in half widths from the middle.
    """
    n, blur_px = len(slope), 0.8
    away = np.tile(np.arange(-8.0, 8.5, 0.5), (n, 1))

    def beyond(edge_px: float | np.ndarray) -> np.ndarray:
        return ndtr((away - off_px - edge_px) / blur_px)

    near, inner, far = beyond(-half_px), beyond(half_px * begins[:, None]), beyond(half_px)
    tones = 1.0 + (bed - 1.0) * near + (other - bed) * inner + (1.0 - other) * far
    tones += np.random.default_rng(2).normal(0.0, noise, away.shape)
    return Side(away, tones, np.ones_like(away), np.full(n, px_per_unit), slope, blur_px)
