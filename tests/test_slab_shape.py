"""What the ratio of a slab's sides tells of a camera that is not known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autoreg.align import align
from autoreg.answer.slab_shape import plausible_focal, seen_alike, strain
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.geometry import angle_between_rotations
from autoreg.ground.points import project_ground
from autoreg.image import as_gray
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving

CAMERA = Camera.from_focal(960, 720, 760.0)
# A photo taken squarely to the slabs: nothing in it tells the focal length from their length.
SQUARELY = SyntheticScene(
    camera=CAMERA,
    cam_from_ground=look_at_ground(pitch_deg=38.0, height_m=1.6, foot_m=(0.1, 0.2)),
    spacing_m=(0.6, 0.3),
    shift=0.5,
    colour=False,
    seed=3,
)
ASLANT = replace(
    SQUARELY,
    cam_from_ground=look_at_ground(pitch_deg=38.0, height_m=1.6, heading_deg=25.0, foot_m=(0.1, 0.2)),
)


@cache
def picture(*, aslant: bool) -> np.ndarray:
    return as_gray(render_paving(ASLANT if aslant else SQUARELY).pixels)


@given(
    pitch=st.floats(20.0, 70.0),
    across=st.booleans(),
    longer=st.floats(0.7, 1.4),
    focal=st.floats(500.0, 1500.0),
)
def test_a_ground_seen_squarely_looks_as_a_longer_one_does_by_another_lens(
    pitch: float, across: bool, longer: float, focal: float
) -> None:
    camera = Camera.from_focal(960, 720, focal)
    pose = look_at_ground(pitch_deg=pitch, height_m=1.5, heading_deg=90.0 * across, foot_m=(0.3, -0.2))
    factors = np.array([1.1, 1.1 * longer] if across else [longer, 1.0])
    other = seen_alike(camera, pose, factors)
    if other is None:
        # So long a lens would be needed that the view would have no perspective left.
        assert longer != 1.0
        return
    ground = np.array([[x, y] for x in (-1.0, 0.5, 2.0) for y in (-0.5, 1.0, 2.5)])
    was, now = project_ground(camera, pose, ground), project_ground(*other, ground * factors)
    in_front = np.isfinite(was).all(1) & np.isfinite(now).all(1)
    # Places beside the camera are seen far outside the picture.
    assert now[in_front] == pytest.approx(was[in_front], rel=1e-9, abs=1e-6)


def test_the_same_shape_asks_for_the_same_camera() -> None:
    camera, pose = seen_alike(CAMERA, ASLANT.cam_from_ground, np.array([1.3, 1.3])) or (None, None)
    assert camera is not None
    assert pose is not None
    assert camera.fx == pytest.approx(CAMERA.fx)
    assert angle_between_rotations(pose.R, ASLANT.cam_from_ground.R) < 1e-9
    assert pose.t == pytest.approx(1.3 * ASLANT.cam_from_ground.t)


@pytest.mark.slow
def test_a_slab_tells_the_focal_length_of_a_photo_taken_squarely() -> None:
    found = align(picture(aslant=False), None, slab=(0.6, 0.3))
    assert found.camera.camera.fx == pytest.approx(CAMERA.fx, rel=0.02)
    true = SQUARELY.cam_from_ground
    assert found.pose.cam_from_ground.origin_in_a[2] == pytest.approx(true.origin_in_a[2], rel=0.02)
    assert np.rad2deg(found.pose.sigma_turn) < 2.0
    assert found.warnings == ()


@pytest.mark.slow
@pytest.mark.parametrize(("heading_deg", "right"), [(2.0, -14.0), (3.0, 16.0)])
def test_a_slab_tells_a_lens_out_of_the_middle_of_a_photo_taken_almost_squarely(
    heading_deg: float, right: float
) -> None:
    # Joints that run together a little tell a wrong focal length where the middle is taken for the lens's.
    scene = replace(
        SQUARELY,
        camera=replace(CAMERA, fx=900.0, fy=900.0, cx=CAMERA.cx + right, cy=CAMERA.cy - 6.0),
        cam_from_ground=look_at_ground(
            pitch_deg=35.0, height_m=1.6, heading_deg=heading_deg, foot_m=(0.1, 0.2)
        ),
        spacing_m=(0.4, 0.4),
        shift=0.0,
        joint_width_m=0.012,
        seed=4,
    )
    found = align(as_gray(render_paving(scene).pixels), None, slab=(0.4, 0.4))
    assert found.camera.camera.fx == pytest.approx(900.0, rel=0.01)
    turn = angle_between_rotations(found.pose.cam_from_ground.R, scene.cam_from_ground.R)
    assert np.rad2deg(turn) < 1.0


@pytest.mark.slow
def test_a_wrong_slab_is_refused_where_the_joints_tell_the_focal_length() -> None:
    with pytest.raises(Refusal, match="--camera") as caught:
        align(picture(aslant=True), None, slab=(0.6, 0.4))
    assert caught.value.code == "slab_mismatch"
    with pytest.raises(Refusal, match="belongs to this photo") as caught:
        align(picture(aslant=False), CAMERA, slab=(0.9, 0.3))
    assert caught.value.code == "slab_mismatch"


def test_focal_lengths_are_judged_by_what_is_known_beforehand() -> None:
    large = replace(CAMERA, width=1920, height=1440, fx=1920.0, fy=1920.0)
    known = Free(focal=True, nominal=large, focal_sigma=0.5)
    for times, plausible in ((0.2, False), (0.4, True), (1.0, True), (3.0, True), (4.3, False)):
        camera = Camera.from_focal(960, 720, 960.0 * times)
        assert plausible_focal(camera, known) is plausible
        assert plausible_focal(camera, Free())


def test_a_principal_point_far_off_makes_an_answer_less_sure_and_a_usual_one_does_not() -> None:
    known = Free(focal=True, centre=True, nominal=CAMERA, focal_sigma=0.5, centre_sigma_px=20.0)
    assert strain(CAMERA, known) == 1.0
    assert strain(replace(CAMERA, cx=CAMERA.cx + 25.0), known) == 1.0
    assert strain(replace(CAMERA, cx=CAMERA.cx + 60.0, cy=CAMERA.cy - 80.0), known) == pytest.approx(12.5)
    # One that is given is known.
    assert strain(replace(CAMERA, cx=CAMERA.cx + 90.0), Free()) == 1.0
