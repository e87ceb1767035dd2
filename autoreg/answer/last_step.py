"""The last step of a fit: the likeliest pose over uneven slabs, or that of the grey levels of even ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.grey_levels import photometric
from autoreg.joints.smear import smeared
from autoreg.paving.corrections import recentred
from autoreg.slabs import slab_effects
from autoreg.slabs.measured_joints import measured_joints, widths_told, without_washed_out
from autoreg.slabs.uncertainty import Settled, settle

# Slabs whose places scatter by more than this, as seen across a joint of median size, need not be tried. In
# noise even ones seem to by half of it, one photo in some hundreds by 0.04; the grey levels themselves tell
# whether slabs are even.
UNEVEN_PX = 0.06
# Joints that look narrower by more than this share of their width at a slope of one are sunk. Prints may seem
# so by up to 0.06.
SUNK = 0.1
# Dark walls leave the widths of sunk joints alone, but not their looks: their far and near halves differ by
# more than this share of the contrast (by 0.03 to 0.3, where those of flat ones do by a thousandth).
LOPSIDED = 0.02
# What is seen of a joint lies within it. Widths whose relief moves the joints by more than this share of
# themselves (RMS; by 0.03 at the median of drawn and ray-traced pavings, by 0.45 at the most) are those of
# something else, such as of the part of a bed that lies in shadow.
MOST_RELIEF = 0.5


def likeliest(picture: Float[np.ndarray, "h w"], fit: Fit) -> Settled:
    """The fit at its likeliest pose by the measured places of its joints, and the scatter of its slabs.

    The model of irregular slabs knows the turn better, and the place as well where the joints' widths tell
    how far the relief of sunk joints moves them. Without these a relief is hard to tell from a shift of all
    joints, and the plain joints know the place better.
    """
    if fit.grid.spacing_x is None:
        return settle(fit, widths=_sharp(picture, fit))
    fit = without_washed_out(fit)
    widths = widths_told(fit) and _sharp(picture, fit)
    if widths:
        settled, joints = settle(fit), measured_joints(fit, np.flatnonzero(fit.usable))
        if settled.relieved < MOST_RELIEF * joints.width:
            return replace(settled, narrowing=slab_effects.narrowing(joints))
    settled = settle(fit, widths=False)
    return replace(settled, fit=recentred(settled.fit))


def _sharp(picture: Float[np.ndarray, "h w"], fit: Fit) -> bool:
    """Whether joints are as wide as they look: a smear would be taken for relief."""
    return not fit.strip.smeared and not smeared(picture, fit.profiles.centre_px[fit.usable])


def rested(
    picture: Float[np.ndarray, "h w"],
    settled: Settled,
    reach: float,
    field: Float[np.ndarray, "k 2"] | None = None,
) -> Settled:
    """A fit from its likeliest pose brought to its last one.

    Where the slabs lie so evenly that the picture's grey levels can tell no difference, these tell the pose,
    unless the joints' widths, or their looks, tell that they are sunk. Where nothing tells whether they are,
    it is no surer than that of sunk ones.
    """
    fit = settled.fit
    if fit.grid.spacing_x is None:
        return settled
    # The grey levels are held against flat joints in a still picture, and sunk ones look much like these at
    # another pose.
    if settled.narrowing > SUNK or fit.strip.smeared:
        return settled
    if settled.scatter.aside * float(np.median(fit.profiles.px_per_unit[fit.usable])) > UNEVEN_PX:
        return settled
    # Joints that may be sunk a little may be off as much as sunk ones.
    together = slab_effects.TOGETHER if settled.scatter.relief > 0 else photometric.TOGETHER
    exact = photometric.on_grey_levels(picture, fit, settled.covariance, reach, field, together)
    if exact is None:
        return settled
    least, most = exact.lopsided
    if least > LOPSIDED:
        return settled
    # Of a large picture's pixels a few are looked at, and the measured places may know more. The turn tells:
    # what all joints may be off by together, which only the places' covariance allows for, hardly turns them.
    turn = np.s_[:3, :3]
    if np.linalg.slogdet(exact.plain[turn])[1] > np.linalg.slogdet(settled.covariance[turn])[1]:
        return replace(settled, spread=settled.spread + exact.doubted)
    spread = exact.spread
    if most > LOPSIDED or settled.scatter.relief > 0:
        # In noise, where joints are narrower than the blur, and where they are filled nearly to the top, flat
        # ones cannot be told from sunk ones.
        spread = spread + settled.spread + np.outer(exact.away, exact.away)
    return replace(settled, fit=exact.fit, spread=spread)
