"""The drawn joints are what a lens shows, and where slabs lie evenly their grey levels tell the pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import ParamSpec, TypeVar

import cv2
import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from autoreg.answer.last_step import LOPSIDED, likeliest, rested
from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine_until_still
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector, vector_from_rotation
from autoreg.grey_levels import photometric
from autoreg.grey_levels.cell_scores import told, told_by_cells
from autoreg.grey_levels.joint_image import JointImage, Shape, with_looks
from autoreg.grey_levels.joint_pixels import CROSSING, JOINT, TONES, JointPixels, View
from autoreg.grey_levels.near_joints import R2, SHOULDER_BLURS, joint_pixels, thinned
from autoreg.grey_levels.photometric import Photometric, on_grey_levels
from autoreg.grey_levels.photometric_step import Step, first_state, stepped, stepped_on
from autoreg.ground.points import on_ground, project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid, visible_sides
from autoreg.slabs.measured_joints import without_washed_out
from autoreg.slabs.uncertainty import Settled, settle
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticScene, clean_grey, look_at_ground
from benchmarks.bound import cramer_rao
from benchmarks.last_stage import pose_error
from benchmarks.suites import limit

REACH = 12.0
PLAIN = SyntheticScene(
    camera=Camera(480, 360, 420.0, 421.0, 236.0, 182.0),
    cam_from_ground=look_at_ground(pitch_deg=38.0, height_m=1.6, heading_deg=23.0, foot_m=(0.13, 0.21)),
    spacing_m=(0.4, 0.3),
    joint_width_m=0.012,
    tone_spread=0.0,
    texture=0.0,
    blur_px=0.7,
    noise_grey=3.0,
    colour=False,
)
LENS = replace(PLAIN, camera=replace(PLAIN.camera, dist=(-0.12, 0.03, 5e-4, -4e-4)))
BOND = replace(PLAIN, shift=0.4)
STONE = replace(PLAIN, tone_spread=0.04, texture=0.03, seed=5)
# Blur and the pixel's square together.
TOTAL_BLUR = float(np.hypot(0.7, np.sqrt(1 / 12)))


P, T = ParamSpec("P"), TypeVar("T")


def remembered(function: Callable[P, T]) -> Callable[P, T]:
    """The function, asked once for the same arguments: scenes hold arrays, which have no hash."""
    known: dict[str, T] = {}

    @wraps(function)
    def asked(*args: P.args, **options: P.kwargs) -> T:
        key = repr((args, options))
        if key not in known:
            known[key] = function(*args, **options)
        return known[key]

    return asked


def grid_of(scene: SyntheticScene) -> Grid:
    return Grid(*scene.spacing_m, scene.shift)


def shape_of(scene: SyntheticScene) -> Shape:
    width = scene.joint_width_m
    return Shape(scene.cam_from_ground, grid_of(scene), (width, width), TOTAL_BLUR)


def pixels_of(scene: SyntheticScene, picture: np.ndarray, most: int = 10**6) -> JointPixels:
    shape = shape_of(scene)
    sides = visible_sides(scene.camera, shape.pose, shape.grid, min_px=4.0)
    return joint_pixels(
        picture, scene.camera, shape.pose, shape.grid, sides, shape.width, shape.blur_px, most
    )


def photo_of(scene: SyntheticScene, seed: int) -> np.ndarray:
    noise = scene.noise_grey * np.random.default_rng(seed).standard_normal((360, 480))
    return np.clip(np.rint(clean(scene) + noise), 0, 255).astype(np.float32)


@remembered
def clean(scene: SyntheticScene) -> np.ndarray:
    return clean_grey(scene)


@remembered
def fitted(scene: SyntheticScene, seed: int, free: Free = Free()) -> Fit:  # noqa: B008
    fit = refine_until_still(
        photo_of(scene, seed), scene.camera, scene.cam_from_ground, grid_of(scene),
        free=free, search=0.04, reach=REACH,
    )  # fmt: skip
    assert fit is not None
    return fit


@remembered
def answered(scene: SyntheticScene, seed: int) -> Settled:
    return rested(photo_of(scene, seed), likeliest(photo_of(scene, seed), fitted(scene, seed)), REACH)


def error_of(scene: SyntheticScene, pose: Rigid) -> np.ndarray:
    true = scene.cam_from_ground
    return np.r_[vector_from_rotation(pose.R @ true.R.T), pose.t - true.t]


def crossings_off_px(scene: SyntheticScene, pose: Rigid) -> float:
    i, j = (v.ravel() for v in np.meshgrid(np.arange(-6, 7), np.arange(0, 14)))
    ground = np.stack([(i + j * scene.shift) * scene.spacing_m[0], j * scene.spacing_m[1]], 1)
    at, true = (project_ground(scene.camera, p, ground) for p in (pose, scene.cam_from_ground))
    seen = ((true > 0) & (true < [479, 359])).all(1)
    return float(np.sqrt(np.mean(((at - true)[seen] ** 2).sum(1))))


def images_of(pixels: JointPixels, shape: Shape) -> list[JointImage]:
    return [JointImage(part, shape) for part in pixels.parts]


@pytest.mark.parametrize("scene", [PLAIN, BOND, LENS])
def test_drawn_pixels_are_those_of_the_renderer(scene: SyntheticScene) -> None:
    pixels = pixels_of(scene, clean(scene))
    images = images_of(pixels, shape_of(scene))
    tones = np.array([scene.slab_tone] * JOINT + [scene.joint_tone])
    drawn = [(image.share * tones[image.pixels.tone % TONES]).sum(0) for image in images]
    off = np.concatenate(drawn) - pixels.grey
    # The renderer's four samples of a pixel are no perfect square.
    assert np.sqrt(np.mean(off**2)) < 0.6
    assert np.abs(off).max() < 4.0


def test_shares_at_crossings_are_those_of_the_normal_distribution() -> None:
    image = images_of(pixels_of(PLAIN, clean(PLAIN)), shape_of(PLAIN))[0]
    assert image.pixels.kind == CROSSING
    some = np.arange(0, len(image.pixels), 97)
    for p, r in ((0, 0), (1, 0), (0, 1), (1, 1)):
        edge_x, edge_y = image.joints[ALONG_Y][p], image.joints[ALONG_X][r]
        sign = 1.0 if p == r else -1.0
        cosine = (edge_x.normal * edge_y.normal).sum(0) / (edge_x.size * edge_y.size)
        rho = sign * cosine[some]
        z = np.stack([edge_x.z[some], edge_y.z[some]], 1)
        exact = [
            multivariate_normal.cdf(at, cov=np.array([[1.0, c], [c, 1.0]]))
            for at, c in zip(z, rho, strict=True)
        ]
        assert image.share[p + 2 * r, some] == pytest.approx(exact, abs=1e-5)


def test_shares_are_parts_of_one() -> None:
    for image in images_of(pixels_of(BOND, clean(BOND)), shape_of(BOND)):
        assert image.share.sum(0) == pytest.approx(1.0)
        assert image.share.min() > -1e-6


@pytest.mark.parametrize("scene", [PLAIN, BOND, LENS])
def test_slopes_are_finite_differences(scene: SyntheticScene) -> None:
    shape, pixels = shape_of(scene), pixels_of(scene, clean(scene))
    tones = np.random.default_rng(0).uniform(60, 200, (pixels.blocks, TONES)).ravel()

    def drawn(shape: Shape) -> np.ndarray:
        images = images_of(pixels, shape)
        return np.concatenate([(image.share * tones[image.pixels.tone]).sum(0) for image in images])

    images = images_of(pixels, shape)
    slopes = [image.slopes(tones[image.pixels.tone]) for image in images]
    by_pose = np.concatenate([image.by_pose(own) for image, own in zip(images, slopes, strict=True)], 1)
    by_looks = np.concatenate([own.by_looks for own in slopes], 1)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-5
        ends = [
            replace(
                shape,
                pose=Rigid(
                    nearest_rotation(rotation_from_vector(s * step[:3]) @ shape.pose.R),
                    shape.pose.t + s * step[3:],
                ),
            )
            for s in (1.0, -1.0)
        ]
        numeric = (drawn(ends[0]) - drawn(ends[1])) / 2e-5
        # How the blur's size on the ground changes with the pose is left out.
        assert np.linalg.norm(by_pose[k] - numeric) < 0.04 * np.linalg.norm(numeric)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-5
        numeric = (drawn(with_looks(shape, step)) - drawn(with_looks(shape, -step))) / 2e-5
        assert np.linalg.norm(by_looks[k] - numeric) < 0.02 * np.linalg.norm(numeric)


def test_the_slope_by_the_shift_of_a_bond_is_a_finite_difference() -> None:
    pixels, shape = pixels_of(BOND, clean(BOND)), shape_of(BOND)
    tones = np.random.default_rng(0).uniform(60, 200, (pixels.blocks, TONES)).ravel()
    # Pixels know where their joints lie: those along Y in the row that they see, others beyond their line.
    row = np.floor(View.of(pixels.rays, shape.pose).ground[1] / shape.grid.spacing_y)
    row = np.where(np.arange(len(pixels)) < sum(pixels.counts[:2]), pixels.line, row)

    def drawn(more: float) -> np.ndarray:
        column, before = pixels.column + more * row, pixels.before + more * (pixels.line - 1)
        images = images_of(replace(pixels, column=column, before=before), shape)
        return np.concatenate([(image.share * tones[image.pixels.tone]).sum(0) for image in images])

    slope = np.concatenate([image.by_shift(tones[image.pixels.tone]) for image in images_of(pixels, shape)])
    numeric = (drawn(1e-6) - drawn(-1e-6)) / 2e-6
    assert np.linalg.norm(slope - numeric) < 0.01 * np.linalg.norm(numeric)


def taken(pixels: JointPixels) -> Step:
    step = stepped(pixels, first_state(pixels, shape_of(PLAIN), fitted(PLAIN, 1)))
    assert step is not None
    return step


def test_pixels_drawn_in_parts_take_the_step_of_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("autoreg.grey_levels.joint_pixels.AT_ONCE", 10**6)
    pixels = pixels_of(PLAIN, photo_of(PLAIN, 1))
    whole = taken(pixels)
    monkeypatch.setattr("autoreg.grey_levels.joint_pixels.AT_ONCE", len(pixels) // 5)
    parts = replace(pixels).parts
    assert sum(len(part) for part in parts) == len(pixels)
    assert np.array_equal(np.concatenate([part.cell for part in parts]), pixels.cell)
    assert np.array_equal(np.sum([part.counts for part in parts], 0), pixels.counts)
    pieces = taken(replace(pixels))
    assert len(whole.parts) == 3
    assert len(pieces.parts) > 5
    assert pieces.sigmas == pytest.approx(whole.sigmas, rel=1e-6)
    assert pieces.state.shape.pose.t == pytest.approx(whole.state.shape.pose.t, abs=1e-9)
    free, ask = whole.normal.free, np.random.default_rng(0).standard_normal((3, len(whole.normal.free)))
    both = [
        (*told(step, free), *told_by_cells(step, free, ask, np.zeros(len(free)))) for step in (pieces, whole)
    ]
    for one, other in zip(*both, strict=True):
        assert np.allclose(one, other, rtol=1e-6, atol=1e-6 * np.abs(other).max())


def test_what_cells_tell_adds_up_to_what_all_pixels_do() -> None:
    step = taken(pixels_of(PLAIN, photo_of(PLAIN, 1)))
    free = step.normal.free
    ask = np.random.default_rng(0).standard_normal((3, len(free)))
    information, score = told(step, free)
    scores, of_cells = told_by_cells(step, free, ask, np.zeros(len(free)))
    assert of_cells.sum(0) == pytest.approx(ask @ information, rel=1e-6, abs=1e-6 * np.abs(information).max())
    unit = np.sqrt(np.diag(information)).sum()
    assert scores.sum(0) == pytest.approx(ask @ score, rel=1e-6, abs=1e-6 * unit)
    # A step takes from every cell's score what its information makes of it.
    moved = 1e-3 * np.random.default_rng(1).standard_normal(len(free)) / np.sqrt(np.diag(information))
    after, _ = told_by_cells(step, free, ask, moved)
    assert after == pytest.approx(scores - of_cells @ moved, rel=1e-6, abs=1e-6 * np.abs(scores).max())


def test_a_step_by_the_last_derivatives_ends_where_one_by_new_ones_does() -> None:
    pixels = pixels_of(PLAIN, photo_of(PLAIN, 1))
    first = taken(pixels)
    second = stepped(pixels, first.state)
    assert second is not None
    short, full = stepped_on(second), stepped(pixels, second.state)
    assert short is not None
    assert full is not None
    # In standard deviations of the pose: weights and ridge are those of the step before.
    away = short.state.shape.pose.t - full.state.shape.pose.t
    H = full.normal.H[3:6, 3:6] / full.state.noise**2
    assert np.sqrt(away @ H @ away) < 0.2
    # It leaves what its own pose and tones leave: nothing of earlier steps is there to be taken again.
    images, tones = images_of(pixels, short.state.shape), short.state.tones.ravel()
    drawn = np.concatenate([(image.share * tones[image.pixels.tone]).sum(0) for image in images])
    off = np.concatenate(short.left) - (pixels.grey - drawn)
    assert np.abs(off).max() < 0.005 * short.state.noise


def test_pixels_are_those_near_joints_and_thinned_evenly() -> None:
    pixels, shape = pixels_of(PLAIN, clean(PLAIN)), shape_of(PLAIN)
    view, spacing = View.of(pixels.rays, shape.pose), np.array(PLAIN.spacing_m)[:, None]
    off = view.ground / spacing
    off = np.abs(off - np.rint(off)) * spacing
    size = [view.across(k, view.ground[k], pixels.per_px)[1] for k in (0, 1)]
    off_px = [off[k] * view.depth / size[k] for k in (0, 1)]
    half = [0.5 * PLAIN.joint_width_m * view.depth / size[k] for k in (0, 1)]
    assert np.all(np.minimum(off_px[0] - half[0], off_px[1] - half[1]) < SHOULDER_BLURS * TOTAL_BLUR + 1e-6)
    some = pixels_of(PLAIN, clean(PLAIN), most=len(pixels) // 4)
    assert 0.6 * len(pixels) / 4 < len(some) < 1.02 * len(pixels) / 4
    shares = np.array(pixels.counts) / len(pixels)
    assert np.array(some.counts) / len(some) == pytest.approx(shares, abs=0.01)


def test_a_few_pixels_of_a_large_picture_are_spread_over_its_joints() -> None:
    camera = PLAIN.camera.scaled(8 * 480, 8 * 360)
    scene = replace(PLAIN, camera=camera)
    pixels = pixels_of(scene, np.zeros((8 * 360, 8 * 480), np.float32), 20_000)
    assert 0.6 * 20_000 < len(pixels) < 1.02 * 20_000
    at = np.rint(camera.project(pixels.rays.T)).astype(int)
    assert len(np.unique(at, axis=0)) == len(at)
    ground = on_ground(at.astype(float), camera, PLAIN.cam_from_ground)
    off = np.abs(ground - np.rint(ground / PLAIN.spacing_m) * PLAIN.spacing_m).min(1)
    # Half a joint, and the shoulders, of a pixel each at the most.
    px_per_m = 1.0 / np.linalg.norm(
        on_ground(at + np.array([0.0, 1.0]), camera, PLAIN.cam_from_ground) - ground, axis=1
    )
    assert ((off - 0.006) * px_per_m < 2.5 * TOTAL_BLUR + 1.0).all()
    # Whatever squares they are taken from: none of their columns and rows is preferred.
    for step in (2, 3, 4, 5):
        shares = np.bincount((at % step) @ [1, step], minlength=step**2) / len(at)
        assert shares == pytest.approx(1.0 / step**2, rel=0.25)


def test_noise_is_told_as_well_by_a_few_pixels_for_each_tone() -> None:
    for seed in range(3):
        # Slabs of their own tones, so that these are fitted and not known beforehand.
        scene = replace(PLAIN, tone_spread=0.06, seed=seed)
        picture, fit = photo_of(scene, seed), fitted(scene, seed)
        pixels = pixels_of(scene, picture).thinned(12)
        state = first_state(pixels, shape_of(scene), fit)
        for _ in range(3):
            step = stepped(pixels, state)
            assert step is not None
            state = step.state
        assert len(pixels) < 14 * pixels.blocks
        assert state.noise == pytest.approx(PLAIN.noise_grey, rel=0.06)


def test_the_pose_of_a_picture_without_noise_is_exact() -> None:
    scene = replace(PLAIN, noise_grey=0.0)
    picture = clean(scene).astype(np.float32)
    fit = refine_until_still(
        picture, scene.camera, scene.cam_from_ground, grid_of(scene), free=Free(), search=0.04, reach=REACH
    )
    assert fit is not None
    found = on_grey_levels(picture, fit, 1e-4 * np.eye(6), REACH)
    assert found is not None
    assert crossings_off_px(scene, found.fit.cam_from_ground) < 0.001
    assert np.array(found.fit.strip.width) == pytest.approx(scene.joint_width_m, rel=0.01)


def test_joints_narrower_than_the_blur_are_found_from_a_strip_several_times_too_wide() -> None:
    thin = replace(PLAIN, joint_width_m=0.003, noise_grey=1.0)
    fit = fitted(thin, 0)
    assert min(fit.strip.width) > 3.5 * thin.joint_width_m
    found = on_grey_levels(photo_of(thin, 0), fit, 1e-4 * np.eye(6), REACH)
    assert found is not None
    assert np.array(found.fit.strip.width) == pytest.approx(0.003, rel=0.3)
    assert crossings_off_px(thin, found.fit.cam_from_ground) < 0.02


def test_seventeen_crossings_of_even_slabs_are_enough() -> None:
    few = replace(PLAIN, spacing_m=(1.36, 1.36))
    for seed in range(6):
        picture = photo_of(few, seed)
        places = likeliest(picture, fitted(few, seed))
        last = rested(picture, places, REACH)
        assert last.fit is not places.fit
        off = error_of(few, last.fit.cam_from_ground)
        assert off @ np.linalg.solve(last.covariance, off) < chi2.ppf(0.999, 6)


@pytest.mark.parametrize("scene", [PLAIN, *(pytest.param(s, marks=pytest.mark.slow) for s in (BOND, LENS))])
def test_grey_levels_know_the_pose_better_than_measured_places(scene: SyntheticScene) -> None:
    seeds = range(8)
    off = [crossings_off_px(scene, answered(scene, s).fit.cam_from_ground) for s in seeds]
    before = [crossings_off_px(scene, settle(fitted(scene, s)).fit.cam_from_ground) for s in seeds]
    assert np.mean(np.square(off)) < 0.75 * np.mean(np.square(before))


@pytest.mark.parametrize("scene", [PLAIN, STONE])
def test_the_covariance_is_that_of_the_errors(scene: SyntheticScene) -> None:
    normalised: list[float] = []
    stated: list[float] = []
    for seed in range(12):
        # Another noise on the same stones tells nothing of what stones do.
        drawn = replace(scene, seed=seed) if scene is STONE else scene
        places = settle(fitted(drawn, seed))
        found = on_grey_levels(photo_of(drawn, seed), places.fit, places.covariance, REACH)
        assert found is not None
        error = error_of(drawn, found.fit.cam_from_ground)
        normalised.append(error @ np.linalg.solve(found.plain[:6, :6], error))
        # The turn and the height: along the ground all joints may be off together.
        told = np.zeros((4, 6))
        told[:3, :3], told[3, 3:] = np.eye(3), drawn.cam_from_ground.R[:, 2]
        some = told @ error
        stated.append(some @ np.linalg.solve(told @ found.covariance @ told.T, some))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(normalised))
    assert low < np.sum(normalised) < high
    # These joints look just as they are drawn; that they might not makes the statement wider, not by much.
    assert np.sum(stated) > 0.25 * 4 * len(stated)


def test_along_the_ground_a_place_is_no_surer_than_that_joints_may_be_off_together() -> None:
    places = settle(fitted(PLAIN, 0))
    found = on_grey_levels(photo_of(PLAIN, 0), places.fit, places.covariance, REACH)
    assert found is not None
    along = PLAIN.cam_from_ground.R[:, :2].T @ found.covariance[3:, 3:] @ PLAIN.cam_from_ground.R[:, :2]
    plain = PLAIN.cam_from_ground.R[:, :2].T @ found.plain[3:6, 3:6] @ PLAIN.cam_from_ground.R[:, :2]
    off_m = 0.01 * PLAIN.joint_width_m
    # Both shapes of it, to one side and by how the joints are seen, at a point that is not the picture's.
    assert (np.diag(along) > np.diag(plain) + off_m**2 * 0.9).all()
    assert (np.diag(along) < np.diag(plain) + (6.0 * off_m) ** 2).all()


def test_uneven_slabs_keep_the_answer_of_their_model() -> None:
    for seed in range(2):
        scene = replace(STONE, jitter_m=0.0015, seed=seed)
        fit = fitted(scene, seed)
        settled = settle(without_washed_out(fit))
        assert on_grey_levels(photo_of(scene, seed), settled.fit, settled.covariance, REACH) is None
        assert np.array_equal(answered(scene, seed).covariance, settled.covariance)


def test_little_unevenness_that_the_first_look_misses_is_seen_in_the_grey_levels() -> None:
    scene = replace(PLAIN, jitter_m=0.0006, noise_grey=1.0, seed=3)
    fit = fitted(scene, 0)
    found = on_grey_levels(photo_of(scene, 0), fit, 1e-2 * np.eye(6), REACH)
    assert found is None


def test_a_thing_on_the_paving_does_no_harm() -> None:
    picture = photo_of(PLAIN, 1)
    picture[200:290, 180:290] = np.random.default_rng(0).uniform(0, 255, (90, 110))
    fit = refine_until_still(
        picture, PLAIN.camera, PLAIN.cam_from_ground, grid_of(PLAIN), free=Free(), search=0.04, reach=REACH
    )
    assert fit is not None
    found = rested(picture, likeliest(picture, fit), REACH)
    error = error_of(PLAIN, found.fit.cam_from_ground)
    assert error @ np.linalg.solve(found.covariance, error) < 22.5
    assert crossings_off_px(PLAIN, found.fit.cam_from_ground) < 0.02


def test_a_camera_that_is_solved_for_and_rows_are_left_alone() -> None:
    fit, picture = fitted(PLAIN, 0), photo_of(PLAIN, 0)
    freed = replace(fit, free=Free(focal=True))
    rows = replace(fit, grid=replace(fit.grid, spacing_x=None))
    for left in (freed, rows):
        assert on_grey_levels(picture, left, 1e-4 * np.eye(6), REACH) is None


def test_a_pose_that_the_measured_places_contradict_is_none() -> None:
    fit, picture = fitted(PLAIN, 0), photo_of(PLAIN, 0)
    near = replace(
        fit, cam_from_ground=Rigid(fit.cam_from_ground.R, fit.cam_from_ground.t + np.array([0.0, 0.002, 0.0]))
    )
    assert on_grey_levels(picture, near, 1e-4 * np.eye(6), REACH) is not None
    assert on_grey_levels(picture, near, 1e-9 * np.eye(6), REACH) is None


def test_the_ratio_of_the_sides_is_found_with_the_pose() -> None:
    fit, picture = fitted(PLAIN, 2, Free(ratio=True)), photo_of(PLAIN, 2)
    a, b = PLAIN.spacing_m
    off = replace(fit, grid=Grid(1.001 * a, b))
    found = on_grey_levels(picture, off, 1e-2 * np.eye(6), REACH)
    assert found is not None
    grid = found.fit.grid
    assert (grid.spacing_x or 0.0) / grid.spacing_y == pytest.approx(a / b, rel=2e-4)


def joint_strip(scene: SyntheticScene, near_m: float, far_m: float) -> np.ndarray:
    """The share of every pixel that lies in a strip beside the middle of every joint."""
    middle = 0.5 * (near_m + far_m)
    pose = scene.cam_from_ground
    there = Rigid(pose.R, pose.t + pose.R @ np.array([middle, middle, 0.0]))
    drawn = replace(
        scene, cam_from_ground=there, joint_width_m=far_m - near_m, joint_tone=255.0, slab_tone=0.0
    )  # fmt: skip
    return clean_grey(drawn) / 255.0


def error_in_sigmas(scene: SyntheticScene, picture: np.ndarray, camera: Camera) -> tuple[float, float]:
    """Normalised squared error of the last pose, and the crossings' distance from the truth in pixels."""
    fit = refine_until_still(
        picture, camera, scene.cam_from_ground, grid_of(scene), free=Free(), search=0.04, reach=REACH
    )
    assert fit is not None
    found = rested(picture, likeliest(picture, fit), REACH)
    return squares_of(scene, found), crossings_off_px(scene, found.fit.cam_from_ground)


def squares_of(scene: SyntheticScene, found: Settled | Photometric) -> float:
    """Normalised squared error of a pose."""
    error = error_of(scene, found.fit.cam_from_ground)
    return float(error @ np.linalg.solve(found.covariance, error))


@pytest.mark.parametrize("darker", [8.0, 40.0])
def test_a_shadow_in_the_joints_does_not_pass_for_another_place(darker: float) -> None:
    half = 0.5 * PLAIN.joint_width_m
    # What would be half a pixel and more by the joints' grey centroid, with all joints agreeing.
    shaded = clean(PLAIN) - darker * joint_strip(PLAIN, 0.0, half)
    noise = PLAIN.noise_grey * np.random.default_rng(2).standard_normal(shaded.shape)
    picture = np.clip(np.rint(shaded + noise), 0, 255).astype(np.float32)
    # Joints with unlike halves may be sunk, and so their rougher measured places have the last word.
    squares, off_px = error_in_sigmas(PLAIN, picture, PLAIN.camera)
    assert squares < chi2.ppf(0.95, 6)
    assert off_px < 0.16


def test_a_lens_that_is_a_little_off_is_no_surer_pose() -> None:
    told = replace(PLAIN.camera, dist=(5e-4, 0.0, 0.0, 0.0))
    squares, _ = error_in_sigmas(PLAIN, photo_of(PLAIN, 3), told)
    assert squares < 22.5


def test_slabs_a_third_of_a_millimetre_off_are_seen_by_what_neighbours_share() -> None:
    squares: list[float] = []
    for seed in range(3):
        scene = replace(PLAIN, jitter_m=0.0002, noise_grey=4.0, seed=seed)
        squares.append(error_in_sigmas(scene, photo_of(scene, seed), scene.camera)[0])
    assert np.mean(squares) < chi2.ppf(0.999, 18) / 3


def test_an_enlarged_picture_claims_no_more_than_it_knows() -> None:
    small = replace(PLAIN, camera=PLAIN.camera.scaled(240, 180))
    noise = 2.0 * np.random.default_rng(5).standard_normal((180, 240))
    seen = np.clip(np.rint(clean(small) + noise), 0, 255).astype(np.uint8)
    picture = cv2.resize(seen, (480, 360), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    assert error_in_sigmas(PLAIN, picture, PLAIN.camera)[0] < 22.5


def test_measured_places_stay_where_few_of_the_pixels_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    fit, picture = fitted(PLAIN, 0), photo_of(PLAIN, 0)
    monkeypatch.setattr(photometric, "MOST_PIXELS", 1500)
    few = rested(picture, likeliest(picture, fit), REACH)
    monkeypatch.undo()
    many = rested(picture, likeliest(picture, fit), REACH)
    places = settle(fit)
    assert np.array_equal(few.fit.cam_from_ground.R, places.fit.cam_from_ground.R)
    assert not np.array_equal(many.fit.cam_from_ground.R, places.fit.cam_from_ground.R)
    # What may be wrong with the drawing may be wrong with the places, too.
    assert np.linalg.eigvalsh(few.covariance - places.covariance).min() > -1e-15


def test_pixels_of_a_large_mask_are_those_of_all_its_rows_at_once() -> None:
    mask = np.zeros((700, 300), np.uint8)
    mask[20:650:7, 10:280] = 1
    v, u = np.nonzero(mask)
    at = np.stack([u, v], 1)
    assert np.array_equal(thinned(mask, 10**6), at)
    some = thinned(mask, 2000)
    assert np.array_equal(some, at[np.mod(at @ np.array(R2), 1.0) < 2000 / len(at)])
    assert len(some) == pytest.approx(2000, rel=0.02)


def sunk(depth_m: float, azimuth_deg: float) -> SyntheticScene:
    """Even slabs with joints in the sun."""
    return replace(
        PLAIN,
        cam_from_ground=look_at_ground(pitch_deg=45.0, height_m=1.4, heading_deg=23.0, foot_m=(0.13, 0.21)),
        spacing_m=(0.3, 0.3),
        joint_depth_m=depth_m,
        sun_elevation_rad=0.8,
        sun_azimuth_rad=float(np.deg2rad(azimuth_deg)),
    )


def sunk_and_drawn_flat(depth_m: float, azimuth_deg: float) -> tuple[Settled, Photometric, float]:
    """Sunk joints' measured places, which stay, and the grey levels' answer with its normalised error."""
    scene = sunk(depth_m, azimuth_deg)
    settled = likeliest(photo_of(scene, 1), fitted(scene, 1))
    drawn = on_grey_levels(photo_of(scene, 1), settled.fit, settled.covariance, REACH)
    # Joints that are drawn flat fit the picture well enough to be believed, at a pose that is wrong.
    assert drawn is not None
    assert squares_of(scene, settled) < chi2.ppf(0.95, 6)
    assert rested(photo_of(scene, 1), settled, REACH) is settled
    return settled, drawn, squares_of(scene, drawn)


@pytest.mark.parametrize("azimuth_deg", [45.0, 200.0])
def test_even_slabs_with_sunk_joints_are_left_to_their_measured_places(azimuth_deg: float):
    settled, _, squares = sunk_and_drawn_flat(0.006, azimuth_deg)
    assert squares > chi2.ppf(0.9999, 6)
    assert settled.narrowing > 0.12


@pytest.mark.parametrize("azimuth_deg", [90.0, 270.0])
def test_sunk_joints_that_look_no_narrower_are_told_by_their_unlike_halves(azimuth_deg: float):
    settled, drawn, squares = sunk_and_drawn_flat(0.004, azimuth_deg)
    assert squares > chi2.ppf(0.99, 6)
    # The widths say nothing.
    assert settled.narrowing < 0.1
    assert drawn.lopsided[0] > 0.05


@pytest.mark.parametrize(("depth_m", "azimuth_deg", "noise_grey"), [(0.006, 90.0, 8.0), (0.006, 90.0, 12.0)])
def test_joints_that_noise_hides_the_relief_of_are_as_unsure_as_sunk_ones(
    depth_m: float, azimuth_deg: float, noise_grey: float
) -> None:
    scene = replace(sunk(depth_m, azimuth_deg), noise_grey=noise_grey)
    settled = likeliest(photo_of(scene, 1), fitted(scene, 1))
    drawn = on_grey_levels(photo_of(scene, 1), settled.fit, settled.covariance, REACH)
    assert drawn is not None
    least, most = drawn.lopsided
    assert least < LOPSIDED < most
    # The truth is outside of what is stated where joints are as they are drawn.
    assert squares_of(scene, drawn) > chi2.ppf(0.95, 6)
    last = rested(photo_of(scene, 1), settled, REACH)
    assert np.array_equal(last.fit.cam_from_ground.R, drawn.fit.cam_from_ground.R)
    assert squares_of(scene, last) < chi2.ppf(0.95, 6)
    assert np.linalg.eigvalsh(last.covariance - settled.covariance).min() > -1e-15


def test_the_motion_that_is_told_leads_from_the_fit_to_the_answer() -> None:
    settled = settle(fitted(PLAIN, 0))
    drawn = on_grey_levels(photo_of(PLAIN, 0), settled.fit, settled.covariance, REACH)
    assert drawn is not None
    before, after = settled.fit.cam_from_ground, drawn.fit.cam_from_ground
    turn = vector_from_rotation(after.R @ before.R.T)
    assert drawn.away[:3] == pytest.approx(turn, rel=1e-3)
    assert drawn.away[3:6] == pytest.approx(after.t - before.t, rel=1e-9)


def test_flat_joints_have_halves_alike() -> None:
    settled = settle(fitted(PLAIN, 0))
    drawn = on_grey_levels(photo_of(PLAIN, 0), settled.fit, settled.covariance, REACH)
    assert drawn is not None
    assert drawn.lopsided[0] < 0.002


@pytest.mark.slow
def test_even_slabs_that_noise_and_blur_make_look_uneven_are_told_by_their_grey_levels():
    blurred = next(case for case in limit.cases(quick=False) if (case.axis, case.value) == ("blur", 1.5))
    scene = blurred.scene
    # Of two hundred such draws this one's joints scatter most, by 0.036 px.
    found = limit.fitted(blurred, clean_grey(scene), 106)
    assert found is not None
    off = pose_error(found, scene.cam_from_ground) / cramer_rao(scene).sigma(blurred.noise_grey)
    assert np.abs(off).max() < 4.0
