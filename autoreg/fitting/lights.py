"""Where the sun reaches and where a shadow lies, by the tones beside the joints."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int

from autoreg.fitting.fit import Fit
from autoreg.joints.joint_looks import DARK
from autoreg.spread import spread

# They show as two groups of tones: so many stations with at least such a share in either group, whose tones
# lie apart by so much, as a logarithm, and by so many standard deviations within a group.
FEWEST, LEAST_SHARE, SHADE, SHADE_SIGMAS = 60, 0.1, 0.2, 4.0


def lights(fit: Fit, rows: Int[np.ndarray, " n"]) -> tuple[Bool[np.ndarray, " n"], ...]:
    """Which of some stations have one light: those in the sun, and those in a shadow on a part of the paving.

    It is one for all where the tones beside the joints do not fall into two groups.
    """
    tone = np.log(fit.profiles.values[rows].mean(1).astype(float) + DARK)
    every = (np.ones(len(tone), dtype=bool),)
    if len(tone) < FEWEST:
        return every
    ordered = np.sort(tone)
    count = np.arange(1, len(tone))
    # The split that leaves the least variance within its two groups (Otsu 1979).
    below, total = np.cumsum(ordered)[:-1], ordered.sum()
    between = (below / count - (total - below) / (len(tone) - count)) ** 2 * count * (len(tone) - count)
    split = ordered[int(between.argmax())]
    dark = tone <= split
    groups = tone[dark], tone[~dark]
    apart = float(np.median(groups[1]) - np.median(groups[0]))
    within = max(spread(group) for group in groups)
    if min(map(len, groups)) < LEAST_SHARE * len(tone) or apart < max(SHADE, SHADE_SIGMAS * within):
        return every
    return dark, ~dark
