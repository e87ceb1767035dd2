"""Joints that are heavier at regular intervals than all between them: those between may be grooves of slabs.

A slab with grooves looks like several small ones. No ratio of sides tells which of the two `--slab` means
where the grooves divide it into parts of its own shape, and all lengths are wrong by how many they are if it
was the other one. But joints are wider and darker than grooves are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.joints.profiles import STEP_PX

# Intervals that are looked for, in joints.
PERIODS = (2, 3, 4, 5, 6)
# A heavier joint has so many times the tone and width of any between it and the next one. Worn and overgrown
# ones differ by as much, but not in turn. Where hardly anything is between them the second number is told.
HEAVIER, MOST_TIMES = 1.5, 100.0
# The probability that some joints in turn are the heaviest of all around them, where they differ by chance.
BY_CHANCE = 1e-3
# A line's weight is the median of so many stations or more. Beyond a joint and its blur the tone of its slabs
# is taken from a stretch of so many pixels, of which so many samples at least are there.
FEWEST_STATIONS, BLURS, SLAB_PX, LEAST_SAMPLES = 3, 2.0, 4.0, 4


class Heavier(NamedTuple):
    """Every `period`th joint is so many `times` as heavier as those between; a period of 1 is none."""

    period: int
    times: float


NONE = Heavier(1, 1.0)


def heavier_lines(fit: Fit) -> Heavier:
    """The joints of a stack bond that are heavier in turn, one way or both ways, surely not by chance."""
    if fit.grid.spacing_x is None or fit.grid.shift:
        return NONE
    weight, families = _weights(fit), list[tuple[np.ndarray, np.ndarray]]()
    for family in (ALONG_X, ALONG_Y):
        rows = np.flatnonzero((fit.stations.family == family) & np.isfinite(weight))
        families.append(_of_lines(fit.stations.line[rows], weight[rows]))
    return in_turn(families)


def _weights(fit: Fit) -> Float[np.ndarray, " n"]:
    """Each station's tone off its slabs' over its width, on the ground; NaN where that is not known.

    Where the joint is predicted: grooves may be too faint to be measured.
    """
    profiles, family = fit.profiles, fit.stations.family
    sign = np.array(fit.strip.polarity)[family]
    half = 0.5 * np.array(fit.strip.width)[family] * profiles.px_per_unit + BLURS * fit.strip.blur_px
    off = np.abs(profiles.at_px)
    inner = off <= half[:, None]
    outer = ~inner & (off <= np.minimum(profiles.room_px, half + SLAB_PX)[:, None])
    known = (sign != 0) & (outer.sum(1) >= LEAST_SAMPLES)
    slabs = (profiles.values * outer).sum(1) / np.maximum(outer.sum(1), 1)
    beyond = ((profiles.values - slabs[:, None]) * inner).sum(1)
    return np.where(known, sign * beyond * STEP_PX / profiles.px_per_unit, np.nan)


def _of_lines(
    line: Int[np.ndarray, " n"], weight: Float[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """The lines with enough stations, and their weights."""
    lines, count = np.unique(line, return_counts=True)
    lines = lines[count >= FEWEST_STATIONS]
    return lines, np.array([np.median(weight[line == each]) for each in lines])


def in_turn(families: list[tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]]) -> Heavier:
    """The interval at which lines are heavier than all between them.

    `families` holds the numbers and the weights of each family's lines.
    """
    for period in PERIODS:
        found = [own for family in families if (own := _at_period(*family, period)) is not None]
        chance = len(PERIODS) * float(np.prod([each for each, _ in found]))
        if found and chance < BY_CHANCE:
            return Heavier(period, max(times for _, times in found))
    return NONE


def _at_period(
    line: Int[np.ndarray, " k"], weight: Float[np.ndarray, " k"], period: int
) -> tuple[float, float] | None:
    """How likely the lines in turn would be the heaviest by chance, and by how much they are; None if not."""
    for phase in range(period):
        own = np.flatnonzero(line % period == phase)
        apart = np.abs(line[own, None] - line)
        beside = (apart > 0) & (apart < period)
        # At the rim there may be none on one side.
        told = beside.sum(1) >= period - 1
        own, beside = own[told], beside[told]
        between = np.where(beside, weight, 0.0).max(1, initial=0.0)
        times = weight[own] / np.maximum(between, np.abs(weight[own]) / MOST_TIMES + 1e-9)
        if len(own) and times.min() > HEAVIER:
            return period * float(np.prod(1.0 / (1.0 + beside.sum(1)))), float(np.median(times))
    return None
