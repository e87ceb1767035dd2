"""Rows tell the focal length by their cross joints' right angles, and say how well."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from paved import gray_of

from autoreg.align import align
from autoreg.answer.full_resolution import MOST_FOCAL_SIGMA
from autoreg.answer.pattern_refusals import MOST_FANNED_DEG, fanned
from autoreg.answer.right_angles import SHARED_RAD, Squared, square_up
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine_until_still
from autoreg.geometry import Rigid, angle_between_rotations, vector_from_rotation
from autoreg.ground.points import on_ground, project_ground
from autoreg.ground.sides import Grid
from autoreg.image import as_gray
from autoreg.rows.cross_joints import change_of_lean, common_lean, off_angle, off_square
from autoreg.rows.rows import STEP_SIGMA
from autoreg.segments import Segments, detect_segments
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticPhoto, SyntheticScene, look_at_ground, render_paving
from autoreg.task import EXIF_FOCAL_SIGMA

PITCH, HEADING = np.deg2rad([36.0, 40.0])


@dataclass(frozen=True)
class Shot:
    """What differs between the photos of these tests; degrees, pixels off the middle, radians."""

    heading: float = 40.0
    seed: int = 3
    off_x: float = 0.0
    off_y: float = 0.0
    lean: float = 0.0

    @property
    def scene(self) -> SyntheticScene:
        return SyntheticScene(
            camera=Camera(800, 600, 700.0, 700.0, 399.5 + self.off_x, 299.5 + self.off_y),
            cam_from_ground=look_at_ground(
                pitch_deg=36.0, height_m=1.6, heading_deg=self.heading, foot_m=(0.13, 0.21)
            ),
            kind="rows",
            spacing_m=(0.5, 0.3),
            joint_width_m=0.012,
            turn_rad=0.006,
            lean_rad=self.lean,
            colour=False,
            seed=self.seed,
        )


# The rows of the second run nearly along the view: their cross joints are square at any focal length.
ASLANT, AWAY = Shot(), Shot(heading=88.0)
CAMERA, POSE = ASLANT.scene.camera, ASLANT.scene.cam_from_ground
# The paving that is looked at, in pixels.
FIELD_PX = np.array([[10.0, 590.0], [790.0, 590.0], [790.0, 120.0], [10.0, 120.0]])


KNOWN = Free(
    focal=True,
    centre=True,
    radial=True,
    nominal=Camera.from_focal(800, 600, 800.0),
    focal_sigma=0.5,
    centre_sigma_px=0.012 * 800,
    radial_sigma=0.1,
    aspect_sigma=0.004,
)


def with_camera(other: Camera, camera: Camera, pose: Rigid) -> Rigid:
    """The pose that leaves rows where they are in the picture when another camera is taken for the true."""
    A = np.linalg.inv(other.K) @ camera.K
    x, up = A @ pose.R[:, 0], np.linalg.inv(A).T @ pose.R[:, 2]
    x, up = x / np.linalg.norm(x), up / np.linalg.norm(up)
    R = np.column_stack([x, np.cross(up, x), up])
    # Where two rows are seen tells the height, and the place across them.
    px = project_ground(camera, pose, pose.origin_in_a[:2] + pose.R[2, :2] * np.array([[1.0], [2.0]]))
    rows = on_ground(px, camera, pose)[:, 1]
    seen = on_ground(px, other, Rigid(R, R @ [0.0, 0.0, -1.0]))[:, 1]
    height = float(np.diff(rows)[0] / np.diff(seen)[0])
    return Rigid(R, -R @ [0.0, rows[0] - height * seen[0], height])


def longer(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


@cache
def photo_of(shot: Shot) -> SyntheticPhoto:
    return render_paving(shot.scene)


@cache
def segments_of(shot: Shot) -> Segments:
    return detect_segments(as_gray(photo_of(shot).pixels))


def field_of(camera: Camera, pose: Rigid) -> np.ndarray:
    return on_ground(FIELD_PX, camera, pose)


@cache
def fitted(shot: Shot, factor: float) -> Fit:
    """The fit of the rows with a wrong focal length, and the principal point in the middle."""
    photo = photo_of(shot)
    camera = Camera.from_focal(800, 600, factor * photo.camera.fx)
    pose = with_camera(camera, photo.camera, photo.cam_from_ground)
    fit = refine_until_still(
        gray_of(photo), camera, pose, Grid(None, 0.3),
        free=Free(step_sigma=STEP_SIGMA), search=0.05, reach=12.0, field=field_of(camera, pose),
    )  # fmt: skip
    assert fit is not None
    return fit


@cache
def squared(shot: Shot, factor: float = 1.04) -> Squared:
    found = square(shot, segments_of(shot), factor)
    assert found is not None
    return found


def square(shot: Shot, segments: Segments, factor: float) -> Squared | None:
    fit = fitted(shot, factor)
    field = field_of(fit.camera, fit.cam_from_ground)
    return square_up(gray_of(photo_of(shot)), fit, segments, field, KNOWN, 12.0)


def turn_between(found: Rigid, truth: Rigid) -> np.ndarray:
    """Rotation vector between two poses, the shorter of the two that half a turn of the ground leaves."""
    halves = (np.diag([s, s, 1.0]) for s in (1.0, -1.0))
    turns = [vector_from_rotation(found.R @ (truth.R @ half).T) for half in halves]
    return min(turns, key=lambda w: float(np.linalg.norm(w)))


@pytest.mark.parametrize("factor", [0.98, 1.01, 1.03])
def test_another_focal_length_leans_all_cross_joints_alike_by_what_pitch_and_heading_say(factor: float):
    camera, pose = CAMERA, POSE
    y = np.array([1.2, 1.5])
    square = np.array([[[x, y[0]], [x, y[1]]] for x in (-1.5, -0.5, 0.4)])
    px = project_ground(camera, pose, square)
    other = longer(camera, factor)
    angle = off_angle(on_ground(px, other, with_camera(other, camera, pose)))
    assert np.ptp(angle) < 1e-9
    # The heading is that of the view against +Y, the square direction.
    expected = np.cos(PITCH) ** 2 * np.sin(2 * HEADING) * np.log(factor)
    assert abs(angle[0]) == pytest.approx(abs(expected), rel=0.05)


def test_both_edges_of_a_cross_joint_are_one_joint_and_lie_square_at_the_true_camera():
    fit = fitted(ASLANT, 1.0)
    field = field_of(fit.camera, fit.cam_from_ground)
    seen = off_square(segments_of(ASLANT), fit, field, np.radians(6.0))
    joints = len(np.unique(seen.joint))
    assert joints > 30
    assert len(seen) > 1.4 * joints
    for joint in range(joints):
        middle = seen.middle[seen.joint == joint]
        assert np.ptp(middle[:, 0]) < 0.2 * 0.3
    # Each joint is turned by 6 mrad, and its segments are short.
    assert abs(float(np.median(seen.angle))) < 3.0 * 0.006 / np.sqrt(joints)


@pytest.mark.parametrize("factor", [0.85, 1.0, 1.15])
def test_cross_joints_lean_together_by_as_much_as_the_camera_is_wrong(factor: float):
    fit = fitted(ASLANT, factor)
    lean = common_lean(segments_of(ASLANT), fit, field_of(fit.camera, fit.cam_from_ground))
    assert lean is not None
    expected = np.cos(PITCH) ** 2 * np.sin(2 * HEADING) * np.log(factor)
    assert abs(lean.angle) == pytest.approx(abs(expected), rel=0.15, abs=4 * lean.sigma)
    assert lean.sigma < 0.004


def segments_along(ground: np.ndarray) -> Segments:
    """Segments that the true camera sees along lines on the ground."""
    px = project_ground(CAMERA, POSE, ground.reshape(-1, 2)).reshape(-1, 2, 2)
    return Segments(px, np.full(len(px), 0.2), np.zeros(len(px), dtype=int))


def leaning_lines(x: np.ndarray, y: np.ndarray, lean: float | np.ndarray) -> np.ndarray:
    """Lines of half a row's width about some places, as cross joints that lean are."""
    lean = np.broadcast_to(lean, x.shape)
    away = 0.075 * np.stack([np.sin(lean), np.cos(lean)], -1)
    middle = np.stack([x, y], -1)
    return np.stack([middle - away, middle + away], 1)


def test_what_crosses_a_lattice_between_its_joints_does_not_tell_how_they_lean():
    # Courses 0.3 wide, slabs 0.5 long; the shadows of bars cross them everywhere.
    fit = replace(fitted(ASLANT, 1.0), grid=Grid(0.5, 0.3), camera=CAMERA, cam_from_ground=POSE)
    field = field_of(CAMERA, POSE)
    rng = np.random.default_rng(5)
    column, row = (k.ravel() for k in np.meshgrid(np.arange(-2, 3), np.arange(4, 9)))
    joints = leaning_lines(0.5 * column, 0.3 * row + 0.15, 0.002 * rng.standard_normal(25))
    bars = leaning_lines(rng.uniform(-1, 1, 80), 0.3 * rng.integers(4, 9, 80) + 0.15, np.radians(6.0))
    lean = common_lean(segments_along(np.concatenate([joints, bars])), fit, field)
    assert lean is not None
    assert abs(lean.angle) < np.radians(0.5)
    # As joints of the lattice they lean.
    leaning = leaning_lines(0.5 * column, 0.3 * row + 0.15, np.radians(6.0))
    lean = common_lean(segments_along(leaning), fit, field)
    assert lean is not None
    assert abs(lean.angle) == pytest.approx(np.radians(6.0), abs=np.radians(0.2))


def test_too_few_cross_joints_tell_no_lean():
    fit = fitted(ASLANT, 1.0)
    field = field_of(fit.camera, fit.cam_from_ground)
    assert common_lean(segments_of(ASLANT).take(np.arange(0)), fit, field) is None


@pytest.mark.parametrize("turn_deg", [0.0, 6.0, 18.0])
def test_cross_joints_that_turn_from_row_to_row_are_those_of_fans(turn_deg: float):
    fit = fitted(ASLANT, 1.0)
    field = field_of(fit.camera, fit.cam_from_ground)
    seen = off_square(segments_of(ASLANT), fit, field, np.radians(20.0))
    rows = seen.middle[:, 1]
    # Each segment is turned about its middle, by as much as its row is from the middle row.
    turn = np.radians(turn_deg) * (rows - np.median(rows)) / np.ptp(rows)
    ends = on_ground(seen.ends_px, fit.camera, fit.cam_from_ground)
    away = ends - ends.mean(1, keepdims=True)
    c, s = np.cos(turn), np.sin(turn)
    R = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], 1)
    turned = ends.mean(1, keepdims=True) + np.einsum("nij,nkj->nki", R, away)
    ends_px = project_ground(fit.camera, fit.cam_from_ground, turned)
    n = len(ends_px)
    change = change_of_lean(Segments(ends_px, np.full(n, 0.2), np.zeros(n, int)), fit, field)
    assert change is not None
    # The outer thirds' middles lie about two thirds of all rows apart.
    assert np.degrees(abs(change.angle)) == pytest.approx(0.66 * turn_deg, rel=0.2, abs=0.5)
    refusal = fanned(change)
    assert (refusal is not None) == (turn_deg > 1.5 * MOST_FANNED_DEG)


def test_no_cross_joints_tell_no_turn():
    fit = fitted(ASLANT, 1.0)
    field = field_of(fit.camera, fit.cam_from_ground)
    assert change_of_lean(segments_of(ASLANT).take(np.arange(0)), fit, field) is None
    assert fanned(None) is None


@pytest.mark.parametrize("factor", [0.9, 1.04, 1.15])
def test_the_true_focal_length_is_found_from_any_that_is_about_right(factor: float):
    found = squared(ASLANT, factor)
    off = np.log(found.settled.fit.camera.fx / CAMERA.fx)
    assert abs(off) < 2.5 * found.sigma_log_focal
    assert found.sigma_log_focal < 0.04
    # Wherever it begins, the same evidence leads to the same answer.
    same = np.log(found.settled.fit.camera.fx / squared(ASLANT).settled.fit.camera.fx)
    assert abs(same) < 0.5 * found.sigma_log_focal


@pytest.mark.slow
def test_the_stated_uncertainty_is_that_of_the_errors():
    focal, turn = [], []
    random = np.random.default_rng(5)
    for seed in range(6):
        x, y = random.normal(0.0, KNOWN.centre_sigma_px, 2)
        shot = Shot(40.0, 40 + seed, float(x), float(y), float(random.normal(0.0, SHARED_RAD)))
        found = squared(shot)
        fit, truth = found.settled.fit, photo_of(shot)
        focal.append(np.log(fit.camera.fx / truth.camera.fx) / found.sigma_log_focal)
        error = turn_between(fit.cam_from_ground, truth.cam_from_ground)
        turn.append(error / np.sqrt(np.diag(found.settled.covariance)[:3]))
    assert 0.4 < np.sqrt(np.mean(np.square(focal))) < 1.6
    assert 0.4 < np.sqrt(np.mean(np.square(turn))) < 1.6


def test_what_all_cross_joints_may_share_bounds_the_focal_length():
    least = SHARED_RAD / (np.cos(PITCH) ** 2 * np.sin(2 * HEADING))
    assert squared(ASLANT).sigma_log_focal > least


def test_rows_that_run_away_from_the_camera_leave_the_focal_length_open():
    assert squared(AWAY).sigma_log_focal > 0.15


def test_unbroken_joints_alone_lead_nowhere():
    assert square(ASLANT, segments_of(ASLANT).take(np.arange(5)), 1.0) is None


@pytest.mark.slow
def test_an_aligned_photo_of_rows_carries_the_uncertainty_of_its_focal_length():
    found = align(photo_of(ASLANT).pixels, None, slab=(0.3, 0.3))
    assert found.lattice.kind == "rows"
    assert found.camera.source == "photo"
    focal, sigma = found.camera.focal_from_photo_px, found.camera.focal_from_photo_sigma_px
    assert focal is not None
    assert sigma is not None
    assert focal == found.camera.camera.fx
    assert abs(focal - CAMERA.fx) < 2.5 * sigma
    assert sigma < MOST_FOCAL_SIGMA * focal
    pose = found.pose
    error = turn_between(pose.cam_from_ground, POSE)
    assert (np.abs(error) < 3.0 * np.sqrt(np.diag(pose.covariance)[:3])).all()
    # With the camera the same pose is known far better.
    given = align(photo_of(ASLANT).pixels, CAMERA, slab=(0.3, 0.3)).pose
    spread = [float(np.sqrt(np.trace(p.covariance[:3, :3]))) for p in (pose, given)]
    assert spread[0] > 10 * spread[1]
    between = angle_between_rotations(given.cam_from_ground.R, pose.cam_from_ground.R)
    assert between < 4 * spread[0]


@pytest.mark.slow
def test_a_photo_whose_rows_leave_it_open_is_refused_and_asks_for_the_camera():
    with pytest.raises(Refusal) as refused:
        align(photo_of(AWAY).pixels, None)
    reason = refused.value
    assert reason.code == "ambiguous"
    assert reason.limit == MOST_FOCAL_SIGMA == EXIF_FOCAL_SIGMA
    assert reason.measured is not None
    assert reason.measured > MOST_FOCAL_SIGMA
    assert "--camera" in reason.message
    assert align(photo_of(AWAY).pixels, AWAY.scene.camera).lattice.kind == "rows"
