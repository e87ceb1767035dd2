from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paved import HALF_BOND, STACK, gray_of, symmetric_poses

from autoreg.alignment import Pose
from autoreg.answer.conclude import (
    Frame,
    canonical_frame,
    describe_lattice,
    fitted_joints,
    lattice_kind,
    measure_residual,
    metric_scale,
    scaled_covariance,
    unsure,
)
from autoreg.answer.slab_shape import with_slab_ratio
from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid, rotation_from_vector
from autoreg.ground.ground_frame import with_origin
from autoreg.ground.points import on_ground, project_ground
from autoreg.ground.sides import ALONG_Y, Grid
from autoreg.paving.presence import Presence
from autoreg.paving.side_support import presence_of
from autoreg.synthetic import SyntheticPhoto, look_at_ground


def presence_in(photo: SyntheticPhoto, fit: Fit) -> Presence:
    return presence_of(gray_of(photo), fit)


def seen_from(presence: Presence, fit: Fit, pose: Rigid) -> Presence:
    """The same sides with their ends told in another frame of the ground."""
    ends = presence.sides.ends
    flat = np.concatenate([ends, np.zeros((*ends.shape[:2], 1))], -1)
    moved = pose.inverse.apply(fit.cam_from_ground.apply(flat))
    return replace(presence, sides=replace(presence.sides, ends=moved[..., :2]))


def in_other_frame(fit: Fit, pose: Rigid, quarter_turns: int) -> Fit:
    """The same fit told in another of the lattice's frames."""
    grid, strip = fit.grid, fit.strip
    if quarter_turns % 2 and grid.spacing_x is not None:
        grid = Grid(grid.spacing_y, grid.spacing_x, 0.0)
        strip = replace(strip, width=strip.width[::-1], polarity=strip.polarity[::-1])
    return replace(fit, cam_from_ground=pose, grid=grid, strip=strip)


@given(
    st.integers(0, 3),
    st.floats(-3, 3),
    st.floats(-3, 3),
    st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
)
@settings(deadline=None, derandomize=True, max_examples=40)
def test_a_frames_points_and_pose_agree(turns: int, x: float, y: float, point: tuple[float, float]):
    frame = Frame(turns, np.array([x, y]))
    pose = Rigid(STACK.cam_from_ground.R, STACK.cam_from_ground.t)
    here = frame.points(np.array([point]))[0]
    moved = frame.pose(pose).apply(np.array([*here, 0.0]))
    assert moved == pytest.approx(pose.apply(np.array([*point, 0.0])), abs=1e-9)
    assert np.linalg.det(frame.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["stack", "half"])
def test_the_frame_is_the_same_whichever_equivalent_the_fit_was_told_in(
    name: str, request: pytest.FixtureRequest
):
    fit: Fit = request.getfixturevalue(f"{name}_fit")
    photo: SyntheticPhoto = request.getfixturevalue(f"{name}_photo")
    turns = (0, 1, 2, 3) if name == "stack" else (0, 2)
    poses: list[Rigid] = []
    presence = presence_in(photo, fit)
    for q, pose in zip(turns, symmetric_poses(fit.cam_from_ground, fit.grid), strict=True):
        # Whole slabs away as well.
        a, b = (fit.grid.spacing_x or 0.0), fit.grid.spacing_y
        step = (2 * b, 3 * a) if q % 2 else ((2 + 3 * fit.grid.shift) * a, 3 * b)
        other = in_other_frame(fit, with_origin(pose, *step), q)
        frame = canonical_frame(other, seen_from(presence, fit, other.cam_from_ground), None)
        poses.append(frame.pose(other.cam_from_ground))
    for pose in poses[1:]:
        assert pytest.approx(pose.R, abs=1e-9) == poses[0].R
        assert poses[0].t == pytest.approx(pose.t, abs=1e-9)


@pytest.mark.parametrize("name", ["stack", "half"])
def test_the_frame_knows_how_its_origin_moves_with_the_lattice(name: str, request: pytest.FixtureRequest):
    fit: Fit = request.getfixturevalue(f"{name}_fit")
    photo: SyntheticPhoto = request.getfixturevalue(f"{name}_photo")
    a, b = (fit.grid.spacing_x or 0.0), fit.grid.spacing_y
    far = replace(fit, cam_from_ground=with_origin(fit.cam_from_ground, (5 + 8 * fit.grid.shift) * a, 8 * b))
    presence = seen_from(presence_in(photo, fit), fit, far.cam_from_ground)
    frame = canonical_frame(far, presence, None)
    little = 1e-5
    longer = Grid(a * np.exp(0.5 * little), b * np.exp(-0.5 * little), fit.grid.shift)
    shifted = Grid(a, b, fit.grid.shift + little)
    for grid, by in ((longer, frame.by_ratio), (shifted, np.array([frame.by_shift, 0.0]))):
        moved = canonical_frame(replace(far, grid=grid), presence, None)
        assert moved.origin - frame.origin == pytest.approx(little * by, abs=1e-8)
    assert np.linalg.norm(frame.by_ratio) > 0.5


@pytest.mark.parametrize("name", ["stack", "half"])
def test_y_points_away_from_the_camera_and_the_origin_is_in_the_picture(
    name: str, request: pytest.FixtureRequest
):
    fit: Fit = request.getfixturevalue(f"{name}_fit")
    photo: SyntheticPhoto = request.getfixturevalue(f"{name}_photo")
    pose = canonical_frame(fit, presence_in(photo, fit), None).pose(fit.cam_from_ground)
    least = np.cos(np.radians(45.0)) if name == "stack" else 0.0
    ahead = pose.R[2, :2] / np.linalg.norm(pose.R[2, :2])
    assert ahead[1] > least - 1e-9
    px = photo.camera.project(pose.t)
    assert ((px > 0) & (px < [photo.camera.width, photo.camera.height])).all()


@pytest.mark.parametrize(
    ("grid", "kind"),
    [(Grid(0.6, 0.4), "stack"), (Grid(0.6, 0.4, 1 / 3), "running"), (Grid(None, 0.4), "rows")],
)
def test_a_bond_has_its_name(grid: Grid, kind: str):
    assert lattice_kind(grid) == kind


def test_the_lattice_is_described_in_metres(half_fit: Fit, half_photo: SyntheticPhoto):
    presence = presence_in(half_photo, half_fit)
    frame = canonical_frame(half_fit, presence, None)
    lattice = describe_lattice(half_fit, presence.field, frame, 2.0)
    assert (lattice.kind, lattice.shift) == ("running", 0.5)
    assert (lattice.spacing_x, lattice.spacing_y) == pytest.approx((1.2, 0.6))
    assert lattice.joint_width == pytest.approx(2.0 * HALF_BOND.joint_width_m, rel=0.35)
    # The paved polygon, halved, lies where the picture shows ground.
    pose = frame.pose(half_fit.cam_from_ground)
    px = project_ground(half_fit.camera, pose, 0.5 * lattice.extent)
    assert ((px > -60) & (px < [half_photo.camera.width + 60, half_photo.camera.height + 60])).all()


@pytest.mark.parametrize("name", ["stack", "half"])
def test_joints_are_named_by_where_they_lie(name: str, request: pytest.FixtureRequest):
    fit: Fit = request.getfixturevalue(f"{name}_fit")
    photo: SyntheticPhoto = request.getfixturevalue(f"{name}_photo")
    frame = canonical_frame(fit, presence_in(photo, fit), None)
    joints = fitted_joints(fit, frame)
    grid, pose = frame.grid(fit.grid), frame.pose(fit.cam_from_ground)
    assert grid.spacing_x is not None
    assert {joint.family for joint in joints} == {"x", "y"}
    for joint in joints:
        rays = fit.camera.unproject(joint.ends_px) @ pose.R
        eye = pose.origin_in_a
        x, y = (eye - rays * (eye[2] / rays[:, 2:]))[:, :2].T
        if joint.family == "x":
            assert y == pytest.approx([joint.index * grid.spacing_y] * 2, abs=1e-6)
        else:
            row = np.floor(y.mean() / grid.spacing_y)
            assert x == pytest.approx([(joint.index + row * grid.shift) * grid.spacing_x] * 2, abs=1e-6)
        assert joint.rms_px < 0.5
    lines = [joint.index for joint in joints if joint.family == "x"]
    assert len(lines) == len(set(lines))
    assert measure_residual(fit).joints == len(joints)


def test_joints_lie_on_the_lattice_that_the_last_solve_left(stack_fit: Fit):
    # Its stations were laid on a lattice of another shape.
    grid, ground = stack_fit.grid, stack_fit.stations.ground
    laid = replace(stack_fit, stations=replace(stack_fit.stations, ground=ground * [1.001, 0.999]))
    for joint in fitted_joints(laid, Frame(0, np.zeros(2))):
        ends = on_ground(joint.ends_px, laid.camera, laid.cam_from_ground)
        across, spacing = (1, grid.spacing_y) if joint.family == "x" else (0, grid.spacing_x)
        assert ends[:, across] == pytest.approx([joint.index * (spacing or 0.0)] * 2, abs=1e-9)


def test_short_cross_joints_are_named_as_well_and_end_where_they_were_measured(
    half_fit: Fit, half_photo: SyntheticPhoto
):
    # One station on each side, as the short sides of slabs seen from afar have.
    first = np.unique(half_fit.stations.side, return_index=True)[1]
    fit = replace(half_fit, usable=half_fit.usable & np.isin(np.arange(len(half_fit.usable)), first))
    frame = canonical_frame(fit, presence_in(half_photo, fit), None)
    cross = [joint for joint in fitted_joints(fit, frame) if joint.family == "y"]
    told = fit.usable & (fit.stations.family == ALONG_Y) & (np.abs(fit.distances_px) < 3.0 * fit.sigma_px)
    assert len(cross) == told.sum() > 10
    seen = [on_ground(joint.ends_px, fit.camera, fit.cam_from_ground) for joint in cross]
    length = sorted(float(np.linalg.norm(ends[1] - ends[0])) for ends in seen)
    assert length == pytest.approx(sorted(2.0 * fit.stations.half_length[told]), rel=1e-6)


def test_the_residual_is_that_of_the_joints_that_fit(stack_fit: Fit):
    residual = measure_residual(stack_fit)
    assert 0 < residual.median_px < residual.rms_px < residual.p95_px < 0.5
    assert 0.8 < residual.inlier_fraction <= 1.0
    assert residual.samples == round(residual.inlier_fraction * len(stack_fit.stations))
    far = stack_fit.distances_px + np.where(np.arange(len(stack_fit.stations)) % 10 == 0, 50.0, 0.0)
    spoilt = measure_residual(replace(stack_fit, distances_px=far))
    assert spoilt.rms_px < 1.1 * residual.rms_px
    assert spoilt.inlier_fraction < residual.inlier_fraction


def test_the_scale_comes_from_what_is_given(stack_fit: Fit):
    height = float(stack_fit.cam_from_ground.origin_in_a[2])
    assert metric_scale(stack_fit, (0.8, 1.2), None) == (pytest.approx(2.0), "slab")
    assert metric_scale(stack_fit, (1.2, 0.8), None) == (pytest.approx(2.0), "slab")
    assert metric_scale(stack_fit, None, 3.0) == (pytest.approx(3.0 / height), "camera_height")
    scale, source = metric_scale(stack_fit, None, None)
    assert source == "none"
    assert scale * (0.6 + 0.4) / 2 == pytest.approx(1.0)


def test_a_pose_is_as_sure_as_its_covariance_says_and_warns_where_that_is_too_little():
    pose = look_at_ground(pitch_deg=35.0, height_m=1.6, heading_deg=20.0, roll_deg=3.0, foot_m=(0.2, 0.1))
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(6, 6))
    moves = rng.normal(size=(4000, 6)) @ root.T
    heights = [Rigid(rotation_from_vector(m[:3]) @ pose.R, pose.t + m[3:]).origin_in_a[2] for m in moves]
    sure = Pose(pose, root @ root.T)
    assert sure.sigma_height == pytest.approx(np.std(heights), rel=0.05)
    assert sure.sigma_turn == pytest.approx(np.linalg.norm(root[:3], 2))
    assert unsure(sure, "photo", slab_told=False) == ()
    less = Pose(pose, (0.06 / sure.sigma_turn) ** 2 * sure.covariance)
    assert "± 3.4°" in unsure(less, "photo", slab_told=False)[0]
    assert "--slab" not in unsure(less, "exif", slab_told=True)[0]
    assert unsure(less, "file", slab_told=False) == ()


def test_rows_are_scaled_by_a_square_and_by_the_side_that_their_slabs_tell(stack_fit: Fit):
    rows = replace(stack_fit, grid=Grid(None, 0.4))
    assert metric_scale(rows, (0.6, 0.4), None, longer=True) == (pytest.approx(1.0), "slab")
    assert metric_scale(rows, (0.4, 0.6), None, longer=False) == (pytest.approx(1.5), "slab")
    with pytest.raises(Refusal, match="width of a row"):
        metric_scale(rows, (0.45, 0.4), None, longer=True)
    assert metric_scale(rows, (0.2, 0.2), None) == (pytest.approx(0.5), "slab")
    assert metric_scale(rows, None, None) == (pytest.approx(2.5), "none")
    with pytest.raises(Refusal, match="width of a row") as caught:
        metric_scale(rows, (0.6, 0.4), None)
    assert caught.value.code == "ambiguous"


@pytest.mark.parametrize(("one", "other"), [(0.6, 0.4), (0.4, 0.6), (0.5, 0.5), (0.2, 0.9)])
def test_a_known_ratio_keeps_the_area_and_which_side_is_longer(stack_fit: Fit, one: float, other: float):
    grid = with_slab_ratio(stack_fit, (one, other)).grid
    assert grid.spacing_x is not None
    assert grid.spacing_x * grid.spacing_y == pytest.approx(0.24)
    assert grid.spacing_x / grid.spacing_y == pytest.approx(max(one, other) / min(one, other))
    rows = replace(stack_fit, grid=Grid(None, 0.4))
    assert with_slab_ratio(rows, (one, other)) is rows


def test_a_height_that_is_given_is_known_and_the_rest_moves_with_it():
    rng = np.random.default_rng(3)
    half = 0.002 * rng.normal(size=(6, 6))
    C = half @ half.T
    spread = np.zeros((8, 8))
    spread[:6, :6] = C
    R = rotation_from_vector(np.array([2.2, 0.3, 0.1]))
    pose = Rigid(R, R @ np.array([0.4, 0.3, -1.7]))
    scale = 1.55 / float(pose.origin_in_a[2])
    held = scaled_covariance(spread, pose, Grid(0.6, 0.4), scale, "camera_height")
    assert Pose(Rigid(R, scale * pose.t), held).sigma_height == pytest.approx(0.0, abs=1e-9)
    # As many small motions say.
    moved: list[np.ndarray] = []
    for motion in rng.multivariate_normal(np.zeros(6), C, 4000):
        near = Rigid(rotation_from_vector(motion[:3]) @ R, pose.t + motion[3:])
        moved.append(1.55 / float(near.origin_in_a[2]) * near.t - scale * pose.t)
    assert np.sqrt(np.diag(np.cov(np.array(moved).T))) == pytest.approx(np.sqrt(np.diag(held)[3:]), rel=0.06)
    plain = scaled_covariance(spread, pose, Grid(0.6, 0.4), 2.0, "slab")
    assert plain[3:, 3:] == pytest.approx(4.0 * C[3:, 3:])


def test_joints_that_lie_off_together_still_carry_the_fit(stack_fit: Fit):
    plain = measure_residual(stack_fit)
    together = replace(stack_fit, distances_px=stack_fit.distances_px + 20.0 * stack_fit.sigma_px)
    moved = measure_residual(together)
    assert moved.inlier_fraction > 0.5
    assert moved.rms_px > 10.0 * plain.rms_px
    assert fitted_joints(together, Frame(0, np.zeros(2)))
