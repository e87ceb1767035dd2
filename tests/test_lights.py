from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.fit import Fit
from autoreg.fitting.full_width import width_from_above
from autoreg.fitting.lights import lights
from autoreg.joints.widths import Widths


def lit(fit: Fit, share: np.ndarray) -> Fit:
    """The fit in other light, by the share of it that falls on each station."""
    values = (fit.profiles.values * share[:, None]).astype(np.float32)
    return replace(fit, profiles=replace(fit.profiles, values=values))


def test_a_shadow_on_a_part_of_the_paving_is_another_light(stack_fit: Fit):
    place = stack_fit.stations.ground[:, 0]
    shaded = place < np.quantile(place, 0.4)
    rows = np.arange(len(shaded))
    dark, bright = lights(lit(stack_fit, np.where(shaded, 0.55, 1.0)), rows)
    assert np.array_equal(dark, shaded)
    assert np.array_equal(bright, ~shaded)


def test_light_that_falls_off_evenly_or_on_few_joints_is_one(stack_fit: Fit):
    place = stack_fit.stations.ground[:, 0]
    rows = np.arange(len(place))
    falling = 0.55 + 0.45 * (place - place.min()) / np.ptp(place)
    few = np.where(place < np.quantile(place, 0.05), 0.55, 1.0)
    for share in (np.ones(len(place)), falling, few):
        (every,) = lights(lit(stack_fit, share), rows)
        assert every.all()
    assert len(lights(stack_fit, rows[:20])) == 1


def seen_as(fit: Fit, width: np.ndarray) -> Fit:
    """The fit with joints that look so wide on the ground."""
    fit, n = replace(fit), len(width)
    noise = np.random.default_rng(0).normal(1.0, 0.05, n)
    px = width * noise * fit.profiles.px_per_unit
    seen = Widths(fit.offsets.offset_px, px, np.full(n, 0.05), np.full(n, 0.05))
    fit.__dict__.update(apart=fit.usable, widths=seen)
    return fit


def test_joints_that_look_narrower_aslant_tell_how_wide_they_look_from_above(stack_fit: Fit):
    slope = np.abs(across_slope(stack_fit))
    near = slope < 1.0
    assert np.mean(slope[near & stack_fit.usable] < 0.3) > 0.15
    stack_fit = replace(stack_fit, usable=stack_fit.usable & near)
    told = width_from_above(seen_as(stack_fit, 0.01 * np.maximum(1.0 - 0.4 * slope, 0.2)))
    assert told == pytest.approx(0.01, rel=0.06)
    assert width_from_above(seen_as(stack_fit, np.full(len(slope), 0.01))) is None
    assert width_from_above(seen_as(stack_fit, 0.01 * (1.0 + 0.1 * slope))) is None
    few = replace(stack_fit, usable=stack_fit.usable & (np.arange(len(slope)) < 15))
    assert width_from_above(seen_as(few, 0.01 * (1.0 - 0.1 * slope))) is None
