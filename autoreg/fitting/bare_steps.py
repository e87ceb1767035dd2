"""Joints of which nothing is left but a step of tone, since the near slab hides their beds.

Seen aslant, a deep joint ends where the near slab's upper rim does: beyond it the far slab's wall is seen,
and where light falls on that it looks like the slab. Which rim of a strip such a step is, its own profile
cannot say. That joints are seen across it as lines does: they have beds, and these are hidden here.
"""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from jaxtyping import Float, Int

from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.joints.edges import Offsets, fit_offsets
from autoreg.joints.joint_looks import NO_JOINT, bloom_px

# Slope of the view (ground distance across the joint over camera height) from which on the bed is hidden.
# Seen from above, a joint's middle is that of the step.
HIDDEN_SLOPE = 0.3
# Joints whose tone, beside steps up and down alike, is below this multiple of the steps have none; so many of
# either kind tell it.
BARE, FEWEST_KIND = 1.0, 8


def across_slope(fit: Fit) -> Float[np.ndarray, " n"]:
    """How far a unit of height moves each station across its joint, seen from the camera."""
    ground, eye = fit.stations.ground, fit.cam_from_ground.origin_in_a
    away = ground - eye[:2]
    return np.where(fit.stations.family == ALONG_X, away[:, 1], away[:, 0]) / eye[2]


def without_joints(fit: Fit) -> tuple[int, ...]:
    """The families of which no joints show, but steps of tone."""
    return tuple(own for own in (ALONG_X, ALONG_Y) if fit.strip.polarity[own] == 0)


def only_steps(fit: Fit) -> tuple[int, ...]:
    """The family whose joints show as steps of tone only, although those across it are dark or light."""
    bare = without_joints(fit)
    return bare if len(bare) == 1 else ()


def _bare(fit: Fit, rows: Int[np.ndarray, " n"]) -> bool:
    """Whether joints have no tone of their own, but half of a step's, as a strip beside one does."""
    depth, step = fit.offsets.depth[rows], fit.offsets.step[rows]
    kinds = [depth[step * way > 0] for way in (1.0, -1.0)]
    if min(len(kind) for kind in kinds) < FEWEST_KIND:
        return False
    own = max(abs(float(np.median(kind))) for kind in kinds)
    return own < BARE * float(np.median(np.abs(step)))


def from_near_rims(fit: Fit) -> Fit:
    """The fit with the middles of joints that are steps only measured from their near slabs' rims.

    They are as wide as the joints across them.
    """
    for own in only_steps(fit):
        rows = np.flatnonzero(fit.usable & (fit.stations.family == own))
        if not _bare(fit, rows):
            continue
        stations, profiles = fit.stations.take(rows), fit.profiles.take(rows)
        scale = profiles.px_per_unit
        across = (fit.grid.spacing_y if own == ALONG_X else fit.grid.spacing_x) or fit.grid.spacing_y
        start, half = fit.offsets.offset_px[rows], 0.5 * fit.strip.width[own] * scale
        # The strip that was fitted lies with either of its edges on the step, or about it.
        found = [
            fit_offsets(profiles, start + way * half, NO_JOINT * across * scale, fit.strip.blur_px)
            for way in (-1.0, 0.0, 1.0)
        ]
        best = np.argmax([looks.strength for looks in found], axis=0)
        columns = np.array([astuple(looks) for looks in found])
        step = Offsets(*columns[best, :, np.arange(len(rows))].T)
        bloom = bloom_px(step, stations, fit.strip, np.ones(len(rows), bool))
        beyond = np.clip(across_slope(fit)[rows] / HIDDEN_SLOPE, -1.0, 1.0)
        middle = step.offset_px - bloom + 0.5 * beyond * fit.strip.width[1 - own] * scale
        fit = fit.measured_at(rows, middle, step.sigma_px)
    return fit
