"""The last step of a fit: the likeliest pose over uneven slabs, or that of the grey levels of even ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from autoreg.corrections import recentred
from autoreg.photometric import on_grey_levels
from autoreg.refine import Fit
from autoreg.uncertainty import Settled, settle

# Slabs whose places scatter by more than this, as seen across a joint of median size, need not be tried.
UNEVEN_PX = 0.04


def rested(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    reach: float,
    field: Float[np.ndarray, "k 2"] | None = None,
) -> Settled:
    """The fit at its last pose, with that pose's covariance, and the scatter of its slabs.

    The model of irregular slabs knows the turn better, the plain joints the place: the relief of sunk joints
    that it allows for is hard to tell from a shift of them all. Where the slabs lie so evenly that the
    picture's grey levels can tell no difference, these tell the pose.
    """
    settled = settle(fit)
    if fit.grid.spacing_x is None:
        return settled
    settled = replace(settled, fit=recentred(settled.fit))
    if settled.scatter.place * float(np.median(fit.profiles.px_per_unit[fit.usable])) > UNEVEN_PX:
        return settled
    exact = on_grey_levels(picture, settled.fit, settled.covariance, reach, field)
    if exact is None:
        return settled
    # Of a large picture's pixels a few are looked at, and the measured places may know more.
    if np.linalg.slogdet(exact.plain)[1] > np.linalg.slogdet(settled.covariance)[1]:
        return replace(settled, covariance=settled.covariance + exact.doubted)
    return replace(settled, fit=exact.fit, covariance=exact.covariance)
