from dataclasses import replace

import cv2
import numpy as np
import pytest
from boards import BOARD, CAMERA, exact, poses, restless_views, views
from scipy.optimize import least_squares

from autoreg.calibration.adjustment import adjust, without_views
from autoreg.calibration.bad_views import held_out_rms, sift
from autoreg.calibration.board import Board, BoardView
from autoreg.calibration.flatness import examine_flatness
from autoreg.calibration.mixture import two_cameras
from autoreg.calibration.model_choice import choice_covariance, chosen, folds, freedom_of, try_models
from autoreg.calibration.models import GENERAL, LENS_MODELS, camera_of, intrinsics_of
from autoreg.calibration.observations import data_of
from autoreg.calibration.pipeline import calibrate_views
from autoreg.calibration.precision import precision_of
from autoreg.calibration.projection_map import difference_map, halves_differ, uncertainty_map
from autoreg.calibration.starting import first_state
from autoreg.calibration.synthetic import bent_points
from autoreg.calibration.unknowns import Freedom, State
from autoreg.camera import Camera

W, H = CAMERA.width, CAMERA.height


def fitted(seen, model=GENERAL, board=BOARD, **freedom):
    data = data_of(seen, board)
    start = first_state(data, W, H)
    start = replace(start, intrinsics=model.restricted(start.intrinsics))
    return data, adjust(data, start, Freedom(model.free, **freedom))


def test_exact_corners_give_back_the_exact_camera():
    _, fit = fitted(views(CAMERA, 6, noise_px=0.0))
    assert fit.outcome == "converged"
    np.testing.assert_allclose(fit.state.intrinsics, intrinsics_of(CAMERA), rtol=1e-5, atol=1e-4)
    assert fit.rms_px < 1e-5


@pytest.mark.parametrize("focal", [450.0, 1000.0, 5000.0])
def test_wide_and_long_lenses_are_found_without_a_hint(focal):
    camera = Camera(1280, 960, focal, focal, 640.0, 470.0)
    _, fit = fitted(views(camera, 8, noise_px=0.02), LENS_MODELS[0])
    assert abs(fit.state.intrinsics[0] / focal - 1) < 0.01


def test_the_minimum_is_opencvs():
    seen = views(CAMERA, 8)
    _, fit = fitted(seen, LENS_MODELS[4])
    places = [BOARD.points.astype(np.float32)] * len(seen)
    corners = [view.corners_px.astype(np.float32) for view in seen]
    rms, K, *_ = cv2.calibrateCamera(places, corners, (W, H), None, None)
    assert abs(fit.rms_px - rms) < 1e-4
    np.testing.assert_allclose(camera_of(fit.state.intrinsics, W, H).K, K, atol=0.05)


def test_the_covariance_is_that_of_a_general_solver():
    seen = views(CAMERA, 4)
    data, fit = fitted(seen, LENS_MODELS[2])
    free = np.flatnonzero(LENS_MODELS[2].free)
    unit = np.concatenate([np.array([1e3, 1e3, 1e3, 1e3, 1.0, 1.0]), np.ones(24)])

    def residuals(scaled):
        p = scaled * unit
        k = np.zeros(12)
        k[free] = p[:6]
        camera = camera_of(k, W, H)
        rows = []
        for v in range(4):
            pose = p[6 + 6 * v : 12 + 6 * v]
            R = cv2.Rodrigues(pose[:3])[0]
            rows.append((data.px[v] - camera.project(BOARD.points @ R.T + pose[3:])).ravel())
        return np.concatenate(rows)

    start = np.concatenate([fit.state.intrinsics[free], fit.state.poses.ravel()]) / unit
    other = least_squares(residuals, start, x_scale="jac", jac="3-point")
    J = other.jac / unit
    covariance = np.linalg.inv(J.T @ J)[:6, :6] * 2 * other.cost / (len(other.fun) - len(start))
    mine = np.linalg.inv(fit.information.sum(0)) * fit.sigma_px**2
    np.testing.assert_allclose(np.sqrt(mine.diagonal()), np.sqrt(covariance.diagonal()), rtol=0.02)


def test_the_residuals_scatter_as_the_noise_that_was_put_in():
    _, fit = fitted(views(CAMERA, 12, noise_px=0.2))
    assert fit.sigma_px == pytest.approx(0.2, rel=0.06)
    assert fit.rms_px == pytest.approx(0.2 * np.sqrt(2), rel=0.08)
    # What OpenCV's tutorial calls the mean error is smaller by the root of the number of corners.
    assert fit.mean_l2_over_n_px == pytest.approx(fit.rms_px / np.sqrt(BOARD.corners), rel=0.05)


def test_the_error_of_the_camera_is_as_large_as_stated():
    scores = []
    for seed in range(12):
        _, fit = fitted(views(CAMERA, 8, seed=seed), LENS_MODELS[3])
        error = (fit.state.intrinsics - intrinsics_of(CAMERA))[:4]
        covariance = precision_of(fit).covariance[:4, :4]
        scores.append(error @ np.linalg.solve(covariance, error))
    # Mean of chi-square with 4 degrees of freedom over 12 runs: 4, with a standard deviation of 0.82.
    assert 2.0 < np.mean(scores) < 6.4


def test_views_that_share_errors_widen_the_intervals():
    seen = []
    rng = np.random.default_rng(0)
    for k, pose in enumerate(poses(CAMERA, 15)):
        # Each view's corners bulge together, by as much as each alone scatters.
        u = BOARD.centred
        shared = rng.normal(0, 0.3, (2, 3)) @ np.stack([u[:, 0] ** 2, u[:, 0] * u[:, 1], u[:, 1] ** 2])
        px = exact(CAMERA, pose) + shared.T + rng.normal(0, 0.1, (BOARD.corners, 2))
        seen.append(BoardView(str(k), np.arange(BOARD.corners), px))
    _, fit = fitted(seen)
    assert precision_of(fit).dispersion > 1.5
    _, fit = fitted(views(CAMERA, 15))
    assert precision_of(fit).dispersion == 1.0


def test_a_fit_without_a_view_is_foretold_to_first_order():
    seen = views(CAMERA, 10)
    data, fit = fitted(seen)
    group = np.arange(10) == 3
    foretold = without_views(fit, group).intrinsics
    again = adjust(
        data.part(np.flatnonzero(~group)), fit.state.part(np.flatnonzero(~group)), Freedom(GENERAL.free)
    )
    moved = again.state.intrinsics - fit.state.intrinsics
    sd = precision_of(fit).std_devs[GENERAL.free]
    assert np.abs((foretold - again.state.intrinsics)[GENERAL.free] / sd).max() < 0.1
    assert np.abs(moved[GENERAL.free] / sd).max() > 0.1


@pytest.mark.parametrize("kind", ["blurred", "bent", "misplaced"])
def test_a_planted_bad_view_is_found_and_no_other(kind):
    for seed in range(3):
        seen = views(CAMERA, 12, seed=seed)
        rng = np.random.default_rng(seed)
        pose = poses(CAMERA, 12, seed)[5]
        px = exact(CAMERA, pose) + rng.normal(0, 0.5 if kind == "blurred" else 0.1, (BOARD.corners, 2))
        if kind == "bent":
            px = CAMERA.project(pose.apply(bent_points(BOARD, (0.1, 0.0, -0.05))))
        if kind == "misplaced":
            px[9:18] += [4.0, 1.0]
        seen[5] = BoardView("bad.jpg", seen[5].ids, px)
        data = data_of(seen, BOARD)
        found = sift(data, first_state(data, W, H))
        assert [bad.name for bad in found.bad] == ["bad.jpg"]
        assert "times what is usual" in found.bad[0].reason


@pytest.mark.parametrize("kind", ["anywhere", "in another order", "on a line", "on one spot"])
def test_a_view_of_nonsense_is_found_and_stops_nothing(kind):
    seen = views(CAMERA, 20)
    rng = np.random.default_rng(0)
    px = {
        "anywhere": rng.uniform([0, 0], [W, H], (54, 2)),
        "in another order": rng.permutation(seen[4].corners_px),
        "on a line": np.linspace([100.0, 100.0], [900.0, 700.0], 54),
        "on one spot": np.full((54, 2), 300.0) + rng.normal(0, 1e-3, (54, 2)),
    }[kind]
    seen[4] = BoardView("nonsense.jpg", seen[4].ids, px)
    data = data_of(seen, BOARD)
    found = sift(data, first_state(data, W, H))
    if kind == "on one spot":  # a board far away: no contradiction, and no information
        assert len(found.kept) >= 19
        assert abs(found.state.intrinsics[0] - CAMERA.fx) < 3
        return
    assert [bad.name for bad in found.bad] == ["nonsense.jpg"]
    assert abs(found.state.intrinsics[0] - CAMERA.fx) < 3


def test_views_in_order_are_all_kept():
    data = data_of(views(CAMERA, 20), BOARD)
    found = sift(data, first_state(data, W, H))
    assert found.bad == ()
    assert found.kept == tuple(range(20))


def test_a_view_held_out_fits_worse_than_one_fitted():
    _, fit = fitted(views(CAMERA, 5))
    assert (held_out_rms(fit) > fit.view_rms_px).all()


@pytest.mark.parametrize(
    ("dist", "needed"),
    [
        ((-0.15, 0.0, 0.0, 0.0, 0.0), {"k1"}),
        ((-0.28, 0.12, 0.0, 0.0, 0.0), {"k1", "k2"}),
        ((-0.28, 0.12, 0.001, -0.001, 0.0), {"k1", "k2", "p1", "p2"}),
    ],
)
def test_the_chosen_lens_model_has_every_term_that_the_lens_has(dist, needed):
    camera = Camera(W, H, 900.0, 900.0, 640.0, 480.0, dist)
    data = data_of(views(camera, 14, seed=4), BOARD)
    trials = try_models(data, first_state(data, W, H), W, H)
    found = chosen(trials)
    assert needed <= set(found.model.coefficients)
    assert "k4" not in found.model.coefficients
    # Models that lack a term foretell other views worse, by far.
    lacking = [trial.score_px for trial in trials if not needed <= set(trial.model.coefficients)]
    assert min(lacking) > 1.1 * found.score_px


@pytest.mark.slow
def test_k_is_as_far_off_as_stated_once_a_lens_model_is_chosen():
    """Terms too weak to show must not be left out: their loss is in no covariance."""
    camera = Camera(W, H, 1000.0, 1003.0, 655.0, 468.0, (-0.2, 0.05, 1e-4, -1e-4, 0.0))
    scores = []
    for seed in range(12):
        data = data_of(views(camera, 10, seed=seed), BOARD)
        trials = try_models(data, first_state(data, W, H), W, H)
        picked = chosen(trials)
        covariance = picked.precision.covariance + choice_covariance(
            trials, picked, picked.precision.dispersion
        )
        error = (picked.fit.state.intrinsics - intrinsics_of(camera))[:4]
        scores.append(error @ np.linalg.solve(covariance[:4, :4], error))
    # Mean of chi-square with 4 degrees of freedom over 12 runs: 4, with a standard deviation of 0.82.
    assert 2.0 < np.mean(scores) < 6.4


def test_a_lens_that_no_polynomial_describes_gets_the_rational_model_with_sane_terms():
    dist = (0.3, 0.02, 0.0002, -0.0001, 0.0, 0.62, 0.1, 0.0)
    camera = Camera(W, H, 700.0, 700.0, 630.0, 490.0, dist)
    data = data_of(views(camera, 15, seed=2), BOARD)
    trials = try_models(data, first_state(data, W, H), W, H)
    found = chosen(trials)
    assert found.model.name == "rational"
    assert found.fit.outcome == "converged"
    # Numerator and denominator nearly cancel; what is known beforehand keeps them from running away.
    assert np.abs(found.fit.state.intrinsics[4:]).max() < 1
    error = (found.fit.state.intrinsics - intrinsics_of(camera))[:4]
    assert np.abs(error / found.precision.std_devs[:4]).max() < 4


def test_a_bent_sheet_is_not_taken_for_a_rational_lens():
    seen = []
    rng = np.random.default_rng(3)
    for k, pose in enumerate(poses(CAMERA, 15)):
        px = CAMERA.project(pose.apply(bent_points(BOARD, (0.04, 0.0, 0.03))))
        seen.append(BoardView(str(k), np.arange(54), px + rng.normal(0, 0.1, px.shape)))
    data = data_of(seen, BOARD)
    assert chosen(try_models(data, first_state(data, W, H), W, H)).model.polynomial


def test_a_richer_models_other_opinion_widens_the_intervals_by_its_evidence():
    data = data_of(views(CAMERA, 10), BOARD)
    trials = try_models(data, first_state(data, W, H), W, H)
    by_name = {trial.model.name: trial for trial in trials}
    simple, richest = by_name["k1"], by_name["k1 k2 p1 p2 k3"]
    # Against a model that explains the corners far better, the whole difference is uncertainty.
    change = (richest.fit.state.intrinsics - simple.fit.state.intrinsics)[:4]
    widened = choice_covariance(trials, simple, 1.0)[:4, :4].diagonal()
    np.testing.assert_allclose(np.sqrt(widened), np.abs(change), rtol=0.5)
    # A simpler one says nothing that the covariance does not hold already.
    assert np.sqrt(choice_covariance(trials[:-1], richest, 1.0)).max() == 0


def test_views_that_repeat_one_another_are_known_and_held_out_together():
    seen = views(CAMERA, 4)
    again = BoardView("again.jpg", seen[1].ids, seen[1].corners_px + 0.5)
    part = BoardView("part.jpg", seen[2].ids[:30], seen[2].corners_px[:30])
    data = data_of([*seen, again, part], BOARD)
    assert list(data.standpoint) == [0, 1, 2, 3, 1, 2]
    assert data.standpoints == 4
    held_out = folds(data.standpoint)
    assert np.sum(held_out, axis=0).tolist() == [1] * 6
    for group in held_out:
        assert group[1] == group[4]
        assert group[2] == group[5]


def test_errors_that_repeated_views_share_count_once():
    """Twelve pictures of each of five bent places are no more than five."""
    rng = np.random.default_rng(0)
    bulges = [rng.normal(0, 0.3, (2, 3)) for _ in range(5)]
    u = BOARD.centred
    shapes = np.stack([u[:, 0] ** 2, u[:, 0] * u[:, 1], u[:, 1] ** 2])
    seen = [
        BoardView(
            f"{k}-{j}",
            np.arange(54),
            exact(CAMERA, pose) + (bulges[k] @ shapes).T + rng.normal(0, 0.1, (54, 2)),
        )
        for k, pose in enumerate(poses(CAMERA, 5))
        for j in range(12)
    ]
    _, many = fitted(seen, LENS_MODELS[2])
    _, few = fitted(seen[::12], LENS_MODELS[2])
    ratio = precision_of(many).std_devs[:4] / precision_of(few).std_devs[:4]
    assert (ratio > 0.4).all()  # independent views would make it 0.29


def mixture_of(seen):
    data = data_of(seen, BOARD)
    start = first_state(data, W, H)
    return two_cameras(data, start, freedom_of(GENERAL, start, W, H))


@pytest.mark.parametrize(
    "other",
    [
        Camera(W, H, 1050.0, 1053.0, 655.0, 468.0, CAMERA.dist),
        Camera(W, H, 1000.0, 1003.0, 655.0, 468.0, (-0.1, 0.02, 0.0, 0.0, 0.0)),
        Camera(W, H, 1300.0, 1300.0, 640.0, 480.0),
    ],
)
@pytest.mark.parametrize("nonsense", [False, True])
def test_two_cameras_are_told_apart_view_by_view(other, nonsense):
    seen = [*views(CAMERA, 10), *views(other, 7, seed=5)]
    if nonsense:
        px = np.random.default_rng(0).uniform([0, 0], [W, H], (54, 2))
        seen[3] = BoardView("nonsense.jpg", seen[3].ids, px)
    found = mixture_of(seen)
    assert found is not None
    assert list(found.second) == [False] * 10 + [True] * 7
    assert abs(found.cameras[1].state.intrinsics[0] / other.fx - 1) < 0.005


@pytest.mark.parametrize(
    "kind",
    [
        "clean",
        "bent",
        *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("focusing", "moving sensor")),
    ],
)
def test_one_camera_is_never_taken_for_two(kind):
    for seed in range(3):
        assert mixture_of(restless_views(CAMERA, 14, kind, seed)) is None


def bent_views(camera, count, seed, bend=(0.03, 0.01, -0.02)):
    rng = np.random.default_rng(seed)
    return [
        BoardView(
            f"view{k}.jpg",
            np.arange(54),
            camera.project(pose.apply(bent_points(BOARD, bend))) + rng.normal(0, 0.1, (54, 2)),
        )
        for k, pose in enumerate(poses(camera, count, seed))
    ]


@pytest.mark.parametrize("others", [5, 9])
def test_two_cameras_are_told_apart_behind_a_bent_sheet(others):
    other = replace(CAMERA, fx=1.2 * CAMERA.fx, fy=1.2 * CAMERA.fy)
    found = mixture_of([*bent_views(CAMERA, 11, 0), *bent_views(other, others, 5)])
    assert found is not None
    assert list(found.second) == [False] * 11 + [True] * others


def test_a_bad_view_is_found_behind_a_bent_sheet():
    seen = bent_views(CAMERA, 14, 2)
    seen[5].corners_px[9:18] += [3.0, 0.0]
    found = calibrate_views(seen, BOARD, W, H)
    assert [out.name for out in found.left_out] == ["view5.jpg"]
    clean = data_of(bent_views(CAMERA, 14, 2), BOARD)
    assert sift(clean, first_state(clean, W, H), shape=True).bad == ()


def test_a_flat_sheet_is_flat_and_a_bent_one_is_not():
    data, fit = fitted(views(CAMERA, 12))
    flat = examine_flatness(data, fit, BOARD)
    assert not flat.bent
    assert flat.ratio == pytest.approx(1.0, abs=0.35)
    rng = np.random.default_rng(1)
    places = bent_points(BOARD, (0.02, 0.01, -0.015))
    seen = [
        BoardView(str(k), np.arange(54), CAMERA.project(pose.apply(places)) + rng.normal(0, 0.1, (54, 2)))
        for k, pose in enumerate(poses(CAMERA, 12))
    ]
    data, fit = fitted(seen)
    found = examine_flatness(data, fit, BOARD)
    assert found.bent
    assert found.agreement > 0.5
    # The sheet's shape, estimated along, explains the corners down to their noise, and mends the camera.
    assert found.bent_fit is not None
    assert found.bent_fit.sigma_px == pytest.approx(0.1, rel=0.1)
    truth = intrinsics_of(CAMERA)[0]
    assert abs(found.bent_fit.state.intrinsics[0] - truth) < abs(fit.state.intrinsics[0] - truth)
    heights = (data.basis @ found.bent_fit.state.shape)[0]
    plane = np.column_stack([np.ones(54), BOARD.centred])
    true_heights = places[:, 2] - plane @ np.linalg.lstsq(plane, places[:, 2], rcond=None)[0]
    assert np.abs(heights - true_heights).max() < 0.2 * np.abs(true_heights).max()


def test_the_uncertainty_map_is_the_scatter_of_many_calibrations():
    model, maps, differences = LENS_MODELS[2], None, []
    camera = Camera(W, H, 1000.0, 1000.0, 645.0, 475.0, (-0.2, 0.05, 0.0, 0.0, 0.0))
    for seed in range(16):
        rng = np.random.default_rng(seed)
        seen = [
            BoardView(str(k), np.arange(54), exact(camera, pose) + rng.normal(0, 0.1, (54, 2)))
            for k, pose in enumerate(poses(camera, 8, seed=9))
        ]
        data, fit = fitted(seen, model)
        anchors = data.px[data.present]
        if maps is None:
            maps = uncertainty_map(fit.state.intrinsics, precision_of(fit).covariance, anchors, W, H)
        differences.append(difference_map(fit.state.intrinsics, intrinsics_of(camera), anchors, W, H).px)
    scatter = np.sqrt(np.mean(np.square(differences), axis=0))
    # The map is the worst direction's, so the distance lies between it and root two of it.
    ratio = scatter / maps.px
    assert 0.7 < np.median(ratio) < 1.6
    # Both grow from the middle to the corners.
    assert maps.px[0, 0] > 2 * np.median(maps.px)


def test_cameras_that_differ_by_a_rotation_alone_do_not_differ():
    one = intrinsics_of(Camera(W, H, 1000.0, 1000.0, 640.0, 480.0))
    anchors = np.random.default_rng(0).uniform([0, 0], [W, H], (200, 2))
    assert difference_map(one, one, anchors, W, H).px.max() < 1e-9
    moved = one + np.array([0, 0, 10.0, 0] + [0] * 8)
    # A principal point off by 10 px is mostly a rotation, and shows only towards the edges.
    assert difference_map(one, moved, anchors, W, H).median_px < 3
    longer = one + np.array([10.0, 10.0, 0, 0] + [0] * 8)
    edge = difference_map(one, longer, anchors, W, H).px[0, 0]
    assert edge == pytest.approx(0.01 * np.hypot(640, 480), rel=0.1)


def test_two_halves_differ_as_much_as_the_covariance_expects():
    data, fit = fitted(views(CAMERA, 16), LENS_MODELS[3])
    covariance = precision_of(fit).covariance
    halves = halves_differ(data, fit, covariance, data.px[data.present], W, H)
    assert 0.4 < halves.excess < 2.2
    few = data_of(views(CAMERA, 5), BOARD)
    assert halves_differ(few, fit, covariance, few.px[few.present], W, H) is None


def test_views_with_different_corners_are_adjusted_together():
    seen = views(CAMERA, 8)
    seen[2] = BoardView("part.jpg", seen[2].ids[10:40], seen[2].corners_px[10:40])
    data, fit = fitted(seen)
    assert data.present.sum() == 8 * 54 - 24
    assert fit.view_rms_px[2] < 0.3
    assert (fit.residuals_px[2][30:] == 0).all()


def test_a_state_that_is_no_camera_diverges_by_name():
    data = data_of(views(CAMERA, 3), BOARD)
    state = State(np.full(12, np.nan), np.zeros((3, 6)), np.zeros(data.basis.shape[-1]))
    assert adjust(data, state, Freedom(GENERAL.free)).outcome == "diverged"


def test_a_square_board_of_odd_size_is_adjusted_too():
    board = Board(7, 7, 0.02, True)
    _, fit = fitted(views(CAMERA, 8, board=board), GENERAL, board)
    assert fit.outcome == "converged"
