"""Joints tell where their middles lie and how wide they look; both together tell what relief does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from autoreg.answer.last_step import likeliest
from autoreg.camera import Camera
from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine_until_still
from autoreg.geometry import vector_from_rotation
from autoreg.ground.points import project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.image import as_gray
from autoreg.joints.joint_looks import width_px_of
from autoreg.joints.widths import Widths
from autoreg.paving.corrections import recentred
from autoreg.slabs import slab_effects
from autoreg.slabs.measured_joints import MeasuredJoints, measured_joints, widths_told, without_washed_out
from autoreg.slabs.slab_effects import (
    BLURRED_ASIDE,
    RIM_ASIDE,
    RIM_BELOW,
    STEPS_RELIEF,
    STEPS_TOGETHER,
    TOGETHER,
    common_effects,
    relief_effects,
    rim_effects,
)
from autoreg.slabs.slab_equations import RELIEFS, Sizes, SlabEquations
from autoreg.slabs.slab_model import estimate_motion
from autoreg.slabs.uncertainty import Settled, settle
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving

SCENE = SyntheticScene(
    camera=Camera.from_focal(1200, 900, 1300.0),
    cam_from_ground=look_at_ground(pitch_deg=50.0, height_m=1.6, heading_deg=33.0, foot_m=(0.13, 0.21)),
    spacing_m=(0.4, 0.4),
    joint_width_m=0.012,
    colour=False,
    jitter_m=0.0005,
)


@cache
def fitted(width: int = 1200, joint_width_m: float = 0.012) -> Fit:
    camera = SCENE.camera.scaled(width, width * 3 // 4)
    photo = render_paving(replace(SCENE, camera=camera, joint_width_m=joint_width_m))
    fit = refine_until_still(
        as_gray(photo.pixels).astype(np.float32), camera, SCENE.cam_from_ground, Grid(0.4, 0.4),
        free=Free(), search=0.08, reach=12.0,
    )  # fmt: skip
    assert fit is not None
    return fit


def with_lit_walls(fit: Fit, share: float) -> Fit:
    """The fit as it would be measured if far edges of joints along Y were seen nearer, as lit walls are."""
    stations = fit.stations
    away = stations.ground[:, 0] - fit.cam_from_ground.origin_in_a[0]
    steep = np.abs(away) / fit.cam_from_ground.origin_in_a[2]
    expected = width_px_of(fit.strip, stations, fit.profiles)
    nearer = share * expected * np.minimum(steep / 1.0, 1.0) * (stations.family == ALONG_Y)
    moved = -0.5 * np.sign(away) * nearer
    return seen_as(fit, moved, nearer)


def with_dark_walls(fit: Fit, share: float) -> Fit:
    """The fit as if joints' middles were seen nearer until their beds are hidden, and half of that as widths.

    What is left of a bed beside a dark wall is the darkest part of a joint, and all is wall in the end.
    """
    stations, eye = fit.stations, fit.cam_from_ground.origin_in_a
    axis = np.where(stations.family == ALONG_Y, 0, 1)
    away = np.take_along_axis(stations.ground - eye[:2], axis[:, None], 1)[:, 0]
    hump = np.interp(np.abs(away) / eye[2], [0.0, 0.8, 2.0], [0.0, 1.0, 0.0])
    moved = -share * hump * np.sign(away) * width_px_of(fit.strip, stations, fit.profiles)
    return seen_as(fit, moved, np.abs(moved))


def seen_as(fit: Fit, moved_px: np.ndarray, narrower_px: np.ndarray) -> Fit:
    """The fit as if its joints had been measured elsewhere, and narrower."""
    widths = fit.widths
    seen = replace(
        fit,
        offsets=replace(fit.offsets, offset_px=fit.offsets.offset_px + moved_px),
        # Distances are counted from the measured place to the projected one.
        distances_px=fit.distances_px - moved_px,
    )
    seen.__dict__["widths"] = Widths(
        widths.middle_px + moved_px,
        widths.width_px - narrower_px,
        widths.sigma_middle_px,
        widths.sigma_width_px,
    )
    return seen


def withheld(fit: Fit) -> Fit:
    """The fit without what its widths tell."""
    blind = replace(fit)
    unknown = np.full(len(fit.stations), np.inf)
    blind.__dict__["widths"] = replace(fit.widths, sigma_middle_px=unknown, sigma_width_px=unknown)
    return blind


def joints_moved_px(fit: Fit, other: Fit) -> float:
    """How far the joints of two fits lie apart in the picture (RMS)."""
    ground, normal = fit.stations.ground[fit.usable], fit.profiles.normal[fit.usable]
    a, b = (project_ground(f.camera, f.cam_from_ground, ground) for f in (fit, other))
    return float(np.sqrt(np.mean(((a - b) * normal).sum(1) ** 2)))


def test_measured_widths_are_those_of_the_drawn_joints():
    fit = fitted()
    joints = measured_joints(fit, np.flatnonzero(fit.usable))
    assert len(joints.wide) > 0.5 * len(joints.rows)
    assert joints.width == pytest.approx(0.012, rel=0.1)
    assert len(joints.off_px) == len(joints.noise_px) == len(joints.rows) + len(joints.wide)


def test_joints_thinner_than_the_blur_tell_no_widths():
    fit = fitted()
    assert widths_told(fit)
    assert not widths_told(replace(fit, strip=replace(fit.strip, blur_px=8.0)))


def test_tiles_that_meet_without_a_joint_tell_no_widths():
    fit = fitted()
    assert not widths_told(replace(fit, strip=replace(fit.strip, polarity=(0, 0))))


def faded(fit: Fit, lines: int) -> Fit:
    """The fit with all joints along Y but some lines as faint as those that a lit wall hides."""
    stations = fit.stations
    along_y = fit.usable & (stations.family == ALONG_Y)
    kept = np.unique(stations.line[along_y])[:lines]
    faint = along_y & ~np.isin(stations.line, kept)
    depth = np.where(faint, 0.05 * fit.offsets.depth, fit.offsets.depth)
    return replace(fit, offsets=replace(fit.offsets, depth=depth))


def test_joints_that_are_hardly_there_are_left_out():
    fit = fitted()
    assert np.array_equal(without_washed_out(fit).usable, fit.usable)
    faint = faded(fit, 5)
    left = without_washed_out(faint).usable
    clear = np.abs(faint.offsets.depth) > 0.5 * np.median(np.abs(fit.offsets.depth))
    assert np.array_equal(left, fit.usable & clear)
    assert left.sum() < fit.usable.sum()


def test_a_family_that_is_faint_as_a_whole_is_kept():
    few = faded(fitted(), 2)
    assert np.array_equal(without_washed_out(few).usable, few.usable)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_lit_walls_that_the_widths_tell_hardly_move_the_pose(share: float, monkeypatch: pytest.MonkeyPatch):
    fit = fitted()
    lit, plain = with_lit_walls(fit, share), settle(fit).fit
    # Without a model of relief, joints are moved by about half of what is missing of them.
    unaware = recentred(lit)
    moved_px = joints_moved_px(settle(lit).fit, plain)
    assert moved_px < 0.4 * joints_moved_px(unaware, plain)
    # Nor is it only what is expected of walls that tells them.
    monkeypatch.setattr(slab_effects, "HIDING", 0.0)
    assert moved_px < 0.6 * joints_moved_px(settle(withheld(lit)).fit, plain)


def test_what_relief_does_beyond_its_model_counts_less_where_slabs_lie_aside():
    lit = with_lit_walls(fitted(), 0.5)
    sides = lit.stations.side
    aside_m = 0.003 * np.random.default_rng(4).standard_normal(sides.max() + 1)
    rough = seen_as(lit, aside_m[sides] * lit.profiles.px_per_unit, np.zeros(len(sides)))
    even, uneven = settle(lit).scatter, settle(rough).scatter
    assert uneven.aside > 3.0 * even.aside
    assert even.misfit > 1.2
    assert 1.0 <= uneven.misfit < 1.1


def test_widths_have_half_a_say():
    lit = with_lit_walls(fitted(), 0.5)
    known = lit.free.prior(lit.camera, lit.grid)
    told, alone = (estimate_motion(lit, lit.free.mask, known, widths=widths) for widths in (True, False))
    apart = told.parameters - alone.parameters
    halfway = lit.moved(0.5 * (told.parameters + alone.parameters)).cam_from_ground
    settled = settle(lit)
    far = 0.05 * float(np.linalg.norm(apart[3:6]))
    assert far > 0
    assert np.linalg.norm(settled.fit.cam_from_ground.t - halfway.t) < far
    # How far the two are apart is not known any better.
    turned = 0.5 * apart[:3]
    surer = 0.5 * (told.covariance + alone.covariance)[:3, :3]
    assert np.linalg.eigvalsh(settled.covariance[:3, :3] - surer).min() > -1e-3 * np.trace(surer)
    assert turned @ np.linalg.solve(settled.covariance[:3, :3], turned) < 1.0


def test_lit_walls_leave_the_stated_covariance_true():
    plain, lit = settle(fitted()), settle(with_lit_walls(fitted(), 0.5))
    away = np.r_[
        vector_from_rotation(lit.fit.cam_from_ground.R @ plain.fit.cam_from_ground.R.T),
        lit.fit.cam_from_ground.t - plain.fit.cam_from_ground.t,
    ]
    # Chi-square of 6 degrees of freedom: 99.9 % lie below 22.5.
    assert away @ np.linalg.solve(lit.covariance, away) < 22.5


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_widths_whose_relief_moves_joints_by_more_than_half_of_themselves_have_no_say(
    share: float, monkeypatch: pytest.MonkeyPatch
):
    def carried_away(fit: Fit, *, widths: bool = True) -> Settled:
        return replace(settle(fit, widths=widths), relieved=share * SCENE.joint_width_m)

    monkeypatch.setattr("autoreg.answer.last_step.settle", carried_away)
    fit, still_picture = fitted(), np.zeros((900, 1200), np.float32)
    found = likeliest(still_picture, fit).fit.cam_from_ground
    believed = settle(fit).fit if share < 0.5 else recentred(settle(fit, widths=False).fit)
    assert np.array_equal(found.t, believed.cam_from_ground.t)


@pytest.mark.parametrize("share", [0.05, 0.1])
def test_dark_walls_that_hide_the_bed_hardly_move_the_pose(share: float):
    fit = fitted()
    plain, dark = settle(fit).fit, settle(with_dark_walls(fit, share)).fit
    # A tenth of the median joint is 0.56 px here; shifts that only grow with the slope leave 0.67 px.
    assert joints_moved_px(plain, dark) < 0.15


@pytest.mark.parametrize(
    ("effects", "change"),
    [(lambda joints: relief_effects(joints)[0], STEPS_RELIEF), (common_effects, STEPS_TOGETHER / TOGETHER)],
)
def test_a_family_of_steps_only_is_moved_less_by_relief_and_more_by_what_is_not_known(
    effects: Callable[[MeasuredJoints], np.ndarray], change: float
):
    fit = fitted()
    joints = measured_joints(fit, np.flatnonzero(fit.usable))
    along_x = fit.stations.family[joints.rows] == ALONG_X

    def sizes(polarity: tuple[int, int]) -> np.ndarray:
        told = replace(joints, fit=replace(fit, strip=replace(fit.strip, polarity=polarity)))
        return np.linalg.norm(effects(told)[: len(joints.rows)], axis=1)

    lined, steps = sizes((-1, -1)), sizes((0, -1))
    assert np.median(steps[along_x] / lined[along_x]) == pytest.approx(change, rel=0.35)
    assert np.allclose(steps[~along_x], lined[~along_x], rtol=0.05)
    # Tiles without any joints have no beds to hide.
    assert np.allclose(sizes((0, 0)), lined)


def test_joints_that_are_nothing_but_blur_may_lie_off_farther_together():
    fit = fitted()
    joints = measured_joints(fit, np.flatnonzero(fit.usable))
    full = joints.width * joints.px_per_unit

    def sizes(blur_px: float) -> np.ndarray:
        told = replace(joints, fit=replace(fit, strip=replace(fit.strip, blur_px=blur_px)))
        return np.linalg.norm(common_effects(told)[: len(joints.rows)], axis=1) / full

    sharp, blurred = sizes(0.05), sizes(50.0)
    assert np.sqrt(blurred**2 - sharp**2) == pytest.approx(BLURRED_ASIDE, rel=0.1)


@pytest.mark.parametrize("widths", [True, False])
def test_motion_and_likelihood_are_those_of_a_dense_solution_with_all_effects_means(widths: bool):
    fit = fitted()
    free, rows = Free(), np.flatnonzero(fit.usable)[::7]
    prior, sizes = free.prior(fit.camera), Sizes(0.0006, 0.25, 0.3, 0.5, together=1.0, drift=0.7)
    model = SlabEquations(fit, free.mask, prior, 0.0, rows, widths)
    model.factor(sizes)
    p = len(model.free)
    V = np.diag(model.D) + (model.Z.toarray() * model.scale**2) @ model.Z.toarray().T
    off, given = model.columns[:, -1], np.linalg.inv(V)
    values: list[tuple[float, float]] = []
    for together in (1.0, 3.0):
        model.factor(sizes._replace(together=together))
        for relief, value, moved, covariance in zip(RELIEFS, *model.solve(), strict=True):
            size = np.ones(len(model.columns[0]) - 1)
            for mask, own in (
                (model.relief, relief),
                (model.common, together),
                (model.course, sizes.place * sizes.course),
                (model.drift, sizes.place * sizes.drift),
            ):
                size[p:][mask] = own
            X = model.columns[:, :-1] * size
            mean = np.zeros(len(size))
            mean[p:][model.relief] = model.expected
            # A pose that the joints leave free is held by next to nothing.
            little = 1e-10 * np.einsum("ni,nm,mi->i", X, given, X)[:p]
            known = np.diag(np.r_[little, np.ones(len(size) - p)])
            H = X.T @ given @ X + known
            x = np.linalg.solve(H, known @ mean - X.T @ given @ off)
            left, away = off + X @ x, x - mean
            assert moved == pytest.approx(x[:p], rel=1e-5, abs=1e-7 * float(np.abs(x[:p]).max()))
            assert np.allclose(covariance, np.linalg.inv(H)[:p, :p], rtol=1e-5)
            likely = -0.5 * (left @ given @ left + away @ known @ away + np.linalg.slogdet(H)[1])
            values.append((value, float(likely)))
    ours, dense = (np.array(each) - each[0] for each in zip(*values, strict=True))
    assert ours == pytest.approx(dense, abs=1e-4 * float(np.abs(dense).max()))


def test_walls_are_expected_to_let_joints_look_narrower_and_nearer():
    fit = fitted()
    joints = measured_joints(fit, np.flatnonzero(fit.usable))
    effects, expected = relief_effects(joints)
    # What the effects explain is taken from the distances.
    moved, count = -effects @ expected, len(joints.rows)
    away = fit.stations.ground[joints.rows] - fit.cam_from_ground.origin_in_a[:2]
    family = fit.stations.family[joints.rows]
    away = np.where(family == ALONG_X, away[:, 1], away[:, 0]) / fit.cam_from_ground.origin_in_a[2]
    share = moved[:count] * np.sign(away) / (0.012 * joints.px_per_unit)
    seen_nearer = measured_joints(with_lit_walls(fit, 0.3), np.flatnonzero(fit.usable)).off_px - joints.off_px
    along_y = family == ALONG_Y
    assert np.sign(moved[:count][along_y]) @ np.sign(seen_nearer[:count][along_y]) > 0.9 * along_y.sum()
    assert (np.diff(np.abs(share)[np.argsort(np.abs(away))]) > -0.02).all()
    narrower, told = moved[count:], seen_nearer[count:]
    some = along_y[joints.wide]
    assert np.sign(narrower[some]) @ np.sign(told[some]) > 0.9 * some.sum()


def test_bevelled_rims_may_lay_joints_aside_and_below_their_slabs():
    fit = fitted()
    joints = measured_joints(fit, np.flatnonzero(fit.usable))
    n = len(joints.rows)
    effects = rim_effects(joints)
    aside, below, along_x = effects[:n, :2], effects[:n, 2], fit.stations.family[joints.rows] == ALONG_X
    width_px = joints.width * joints.px_per_unit
    assert aside[along_x] == pytest.approx(np.outer(RIM_ASIDE * width_px[along_x], [1, 0]))
    assert aside[~along_x] == pytest.approx(np.outer(RIM_ASIDE * width_px[~along_x], [0, 1]))
    # What lies lower by a length is seen nearer by so much times the slope of the view.
    slope = across_slope(fit)[joints.rows]
    assert below == pytest.approx(RIM_BELOW * width_px * slope)
    assert not effects[n:].any()
    steps = replace(joints, fit=replace(fit, strip=replace(fit.strip, polarity=(0, -1))))
    assert not rim_effects(steps)[:n][along_x].any()
    assert rim_effects(steps)[:n][~along_x] == pytest.approx(effects[:n][~along_x])
