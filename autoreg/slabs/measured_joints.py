"""What a fit's joints tell the model of irregular slabs: where their middles lie, and how wide they look.

A joint that lies deeper than its slabs is seen aslant. The near slab ends where its upper edge is seen,
whatever lies behind it; but the far slab seems to begin where its lit wall does. Such a joint looks
narrower, and its middle nearer, than it is, both by the same shift. The width tells that shift, which the
pose could imitate otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.fitting.fit import Fit
from autoreg.fitting.full_width import width_from_above
from autoreg.fitting.lights import lights
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.joints.joint_looks import BLURS, DARK
from autoreg.joints.smear import alike_in_px
from autoreg.numbering import numbered
from autoreg.spread import spread_about

# Share of the largest blur that is tried, from which on the blur itself is in doubt.
MOST_BLUR = 0.85
# Joints are as wide as this share of them look at most: others are hidden in part, or their slabs lie off.
FULL_SHARE = 0.75
# Dark or light joints are none whose contrast is below this part of what the clearest of their family have,
# unless fewer than so many lines would be left.
WASHED_OUT, CLEAREST, FEWEST_LINES = 0.25, 0.8, 3
# A smaller share of stations with wide joints says nothing for the others.
LEAST_WIDE = 0.1
# A slab side's place is not known better than this, whatever its profiles say: texture, interpolation, JPEG.
SIDE_FLOOR_PX = 0.01


@dataclass(frozen=True)
class MeasuredJoints:
    """Measurements of the stations `rows` of a fit, and of the widths of those of them in `wide`.

    `off_px` is how far the middles lie off, as projected minus as measured, then by how much the joints'
    full width `width` (on the ground) exceeds the measured one; `noise_px` is their own noise.
    """

    fit: Fit
    rows: Int[np.ndarray, " n"]
    wide: Int[np.ndarray, " m"]
    width: float
    off_px: Float[np.ndarray, " k"]
    noise_px: Float[np.ndarray, " k"]

    @property
    def px_per_unit(self) -> Float[np.ndarray, " n"]:
        """Scale across each joint."""
        return self.fit.profiles.px_per_unit[self.rows]

    @property
    def shared(self) -> tuple[Int[np.ndarray, " n"], ...]:
        """Numbers of what middles have in common: the line, and the field of one slab's size."""
        grid, stations = self.fit.grid, self.fit.stations.take(self.rows)
        cell = np.floor(stations.ground / grid.slab_size)
        return numbered(stations.family, stations.line)[0], numbered(*cell.T)[0]

    @cached_property
    def lights(self) -> tuple[Bool[np.ndarray, " n"], ...]:
        """Which middles have one light."""
        return lights(self.fit, self.rows)

    def middles_only(self, effects: Float[np.ndarray, "n r"]) -> Float[np.ndarray, "k r"]:
        """Effects on the middles as such on all that is measured: they leave the widths alone."""
        return np.concatenate([effects, np.zeros((len(self.wide), effects.shape[1]))])


def without_washed_out(fit: Fit) -> Fit:
    """The fit without the joints that are hardly there, against the clearest of their family.

    Where the lit wall of the far slab hides the bed, a joint looks like its slabs; what is left is their step
    of tone, which either of the strip's edges may take for its own.
    """
    contrast = np.abs(fit.offsets.depth) / (fit.profiles.values.mean(1) + DARK)
    usable = fit.usable.copy()
    for family in (ALONG_X, ALONG_Y):
        members = np.flatnonzero(fit.usable & (fit.stations.family == family))
        if fit.strip.polarity[family] == 0 or not len(members):
            continue
        lost = contrast[members] < WASHED_OUT * np.quantile(contrast[members], CLEAREST)
        if len(np.unique(fit.stations.line[members[~lost]])) >= FEWEST_LINES:
            usable[members[lost]] = False
    # What is known of its widths stays known where nothing is lost.
    return fit if np.array_equal(usable, fit.usable) else replace(fit, usable=usable)


def measured_joints(fit: Fit, rows: Int[np.ndarray, " n"], *, widths: bool = True) -> MeasuredJoints:
    """The middles of some of a fit's stations, and the `widths` of those whose edges are told apart."""
    side = fit.stations.side
    off, claim = fit.distances_px[rows].copy(), fit.offsets.sigma_px[rows].copy()
    wide = _told_apart(fit, rows) if widths else np.zeros(0, dtype=int)
    if not len(wide):
        return MeasuredJoints(fit, rows, wide, 0.0, off, _own_noise(claim, off, side[rows]))
    both, told = rows[wide], fit.widths
    # By a strip of fixed width, a middle is that of the edge which looks right and one that is missing.
    off[wide] -= told.middle_px[both] - fit.offsets.offset_px[both]
    claim[wide] = told.sigma_middle_px[both]
    px_per_unit = fit.profiles.px_per_unit[both]
    width = float(np.quantile(told.width_px[both] / px_per_unit, FULL_SHARE))
    width = max(width, width_from_above(fit) or 0.0)
    narrower = width * px_per_unit - told.width_px[both]
    noise = _own_noise(claim, off, side[rows]), _own_noise(told.sigma_width_px[both], narrower, side[both])
    return MeasuredJoints(fit, rows, wide, width, np.r_[off, narrower], np.concatenate(noise))


def widths_told(fit: Fit) -> bool:
    """Whether the widths of a fit's joints say how far relief moves their middles."""
    return len(_told_apart(fit, np.flatnonzero(fit.usable))) > 0


def _told_apart(fit: Fit, rows: Int[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """Which of the stations see both edges of a joint that is darker, or lighter, than its slabs."""
    wide = np.flatnonzero(fit.apart[rows])
    # A picture more blurred than any blur that is tried makes thin joints look wide.
    blurred = fit.strip.blur_px >= MOST_BLUR * BLURS[-1]
    if blurred or len(wide) < LEAST_WIDE * len(rows):
        return wide[:0]
    wide = wide[np.isfinite(fit.widths.sigma_width_px[rows[wide]])]
    both, told = rows[wide], fit.widths
    for family in (ALONG_X, ALONG_Y):
        own = both[fit.stations.family[both] == family]
        if alike_in_px(told.width_px[own], told.sigma_width_px[own], fit.profiles.px_per_unit[own]):
            return wide[:0]
    return wide


def _own_noise(
    claim: Float[np.ndarray, " n"], off: Float[np.ndarray, " n"], side: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Scatter of single stations: their profiles' claim, scaled to how neighbours on one side differ."""
    claim = np.maximum(claim, 0.3 * float(np.median(claim)))
    pair = np.flatnonzero(side[1:] == side[:-1])
    if len(pair) >= 10:
        step = np.diff(off)[pair] / np.hypot(claim[pair], claim[pair + 1])
        claim = claim * spread_about(step)
    # The floor holds for a side as a whole, however many stations it has.
    return np.hypot(claim, SIDE_FLOOR_PX * np.sqrt(np.bincount(side)[side]))
