"""The tone in which a colour photo shows its joints: luminance, or another mixture of its channels.

Sand between grey slabs and mortar between red bricks may be as light as what they divide, and then only shade
and dirt beside the joints show, which lie aside of them. In another mixture of the channels the joints differ
from all slabs, however light these are, and shade is as good as gone. Which one it is, Fisher's linear
discriminant tells (R. A. Fisher, The use of multiple measurements in taxonomic problems, 1936) from the mean
profile across the joints of a lattice that luminance shows, even if it lies beside them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.linalg
from jaxtyping import Float, UInt8

from autoreg.fitting.fit import Fit
from autoreg.image import is_colourless
from autoreg.joints.profiles import STEP_PX, sample_profiles

# Grey levels of a BGR picture, as OpenCV makes them.
LUMINANCE = np.array([0.114, 0.587, 0.299])
# Another tone must show the joints of the family that it shows worse so many times as clearly, and so clearly
# against the noise of a single profile, since what is no joint shows in some tone a little, too.
LEAST_GAIN, LEAST_CLEAR = 1.5, 0.6
# How far profiles reach: so many widths of the joints, and pixels, and no less and no more than these.
REACH_WIDTHS, REACH_PX, LEAST_REACH_PX, MOST_REACH_PX = 2.0, 4.0, 8.0, 30.0
# Their ends, so many pixels long, show the slabs.
END_PX = 2.0
# Families with fewer stations tell nothing; of more stations in all some are looked at, and of the picture's
# pixels every so many either way.
FEWEST, ENOUGH, EVERY = 20, 600, 4
# What rounding to grey levels adds to the noise of each channel.
ROUNDED = 0.3
# A tone spans so many grey levels, its noise so many, at the most.
SPAN, NOISE_GREY = 220.0, 8.0


@dataclass(frozen=True)
class Tone:
    """Grey levels of a BGR picture: the sum of its channels by `weights`, and `offset`."""

    weights: Float[np.ndarray, "3"]
    offset: float

    def of(self, colour: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
        """The picture in this tone."""
        return np.asarray(cv2.transform(colour, np.append(self.weights, self.offset)[None]), np.uint8)


def clearest_tone(colour: UInt8[np.ndarray, "h w 3"], fit: Fit, size: tuple[int, int]) -> Tone | None:
    """The tone in which the joints of a fit show best, darker than the slabs; None if luminance is as good.

    Args:
        colour: the photo (BGR).
        fit: a lattice, or rows, that were fitted to its luminance.
        size: width and height at which it is looked at.
    """
    small = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
    if is_colourless(small):
        return None
    signals, noise = _profiles(small.astype(np.float32), fit)
    if not signals:
        return None

    def clearness(weights: Float[np.ndarray, "3"]) -> float:
        return min(float(np.mean((signal @ weights) ** 2)) for signal in signals) / float(
            weights @ noise @ weights
        )

    scatters = [signal.T @ signal for signal in signals]
    scatters.append(np.sum([scatter / max(np.trace(scatter), 1e-12) for scatter in scatters], axis=0))
    best = max((scipy.linalg.eigh(scatter, noise)[1][:, -1] for scatter in scatters), key=clearness)
    if clearness(best) < max(LEAST_CLEAR**2, LEAST_GAIN**2 * clearness(LUMINANCE)):
        return None
    peak = signals[0] @ best
    best = -np.sign(peak[np.abs(peak).argmax()]) * best
    some = small[::EVERY, ::EVERY].reshape(-1, 3)
    low, high = np.quantile(some @ best, [0.01, 0.99])
    scale = min(SPAN / (high - low), NOISE_GREY / float(np.sqrt(best @ noise @ best)))
    return Tone(scale * best, 127.5 - scale * 0.5 * float(low + high))


def _profiles(
    small: Float[np.ndarray, "h w 3"], fit: Fit
) -> tuple[list[Float[np.ndarray, "p 3"]], Float[np.ndarray, "3 3"]]:
    """Mean profile across the joints of each family, off the slabs beside them, and the slabs' covariance.

    What slabs on both sides of a joint differ by is noise, as their texture is.
    """
    height, width, _ = small.shape
    camera = fit.camera.scaled(width, height)
    stations = fit.stations.take(np.arange(0, len(fit.stations), 1 + len(fit.stations) // ENOUGH))
    joint_px = max(fit.strip.width) * float(np.median(fit.profiles.px_per_unit)) * width / fit.camera.width
    reach = float(np.clip(REACH_WIDTHS * joint_px + REACH_PX, LEAST_REACH_PX, MOST_REACH_PX))
    values = np.stack(
        [
            sample_profiles(
                np.ascontiguousarray(small[..., channel]), camera, fit.cam_from_ground, stations, reach
            ).values
            for channel in range(3)
        ],
        2,
    ).astype(float)
    end = round(END_PX / STEP_PX)
    near, far = values[:, :end], values[:, -end:]
    before, beyond = near.mean(1), far.mean(1)
    rough = np.concatenate([near - before[:, None], far - beyond[:, None]]).reshape(-1, 3)
    apart = 0.5 * (beyond - before)
    noise = apart.T @ apart / len(apart) + rough.T @ rough / len(rough) + ROUNDED**2 * np.eye(3)
    off = values - 0.5 * (before + beyond)[:, None]
    families = [np.flatnonzero(stations.family == family) for family in np.unique(stations.family)]
    return [off[rows].mean(0) for rows in families if len(rows) >= FEWEST], noise
