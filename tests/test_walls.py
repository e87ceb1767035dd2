"""Walls carry perfect lattices: the answer is the ground before them, or a refusal."""

import cv2
import numpy as np
import pytest

from autoreg.align import align
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.geometry import Rigid, angle_between_rotations
from autoreg.ground.upright import like_upright_wall, like_wall, possible_up, roll_deg
from autoreg.synthetic import look_at_ground

CAMERA = Camera.from_focal(960, 720, 900.0)
PX_PER_M, SIZE_M = 150, 12.0
SIDE_PX = int(SIZE_M * PX_PER_M)


def stones(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(150.0, 4.0, (SIDE_PX, SIDE_PX)).astype(np.float32)


def bricks() -> np.ndarray:
    """A running bond, from above or from the front."""
    picture, length, height = stones(1) - 50.0, 54, 18
    for course, y in enumerate(range(0, SIDE_PX, height)):
        picture[y : y + 2] = 160.0
        for x in range(course % 2 * length // 2, SIDE_PX, length):
            picture[y : y + height, x : x + 2] = 160.0
    return picture


def ashlar() -> np.ndarray:
    """Unbroken joints at an even spacing, slabs of random length between them."""
    rng, picture, step = np.random.default_rng(2), stones(3), round(0.16 * PX_PER_M)
    for y in range(0, SIDE_PX, step):
        picture[y : y + 3] = 70.0
        for x in np.cumsum(rng.uniform(0.9, 2.6, 60) * step).astype(int):
            picture[y : y + step, x : x + 3] = 70.0
    return picture


def rolled(pitch_deg: float) -> Rigid:
    """The pose of a camera that is not held quite level."""
    return look_at_ground(pitch_deg=pitch_deg, height_m=1.6, heading_deg=3.0, roll_deg=4.0)


def wall_beyond(ground: np.ndarray, wall: np.ndarray, pose: Rigid, wall_m: float) -> np.ndarray:
    """A photo of ground with a wall across it, which is square to the view but for a few degrees."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = CAMERA.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float)) @ pose.R
    eye = pose.origin_in_a
    to_wall = eye + rays * (wall_m / rays[:, 1:2])
    with np.errstate(divide="ignore"):
        to_ground = eye - rays * (eye[2] / rays[:, 2:])
    before = (rays[:, 2] < 0) & (to_ground[:, 1] < eye[1] + wall_m)
    px = np.where(before[:, None], to_ground[:, :2], to_wall[:, [0, 2]])
    at = (px * PX_PER_M + 0.5 * SIDE_PX).astype(np.float32).reshape(CAMERA.height, CAMERA.width, 2)
    drawn = [
        cv2.remap(cv2.GaussianBlur(each, (0, 0), 1.0), at, None, cv2.INTER_AREA, borderMode=cv2.BORDER_WRAP)
        for each in (ground, wall)
    ]
    chosen = np.where(before.reshape(drawn[0].shape), *drawn)
    noise = np.random.default_rng(4).normal(0.0, 1.5, chosen.shape)
    return np.clip(np.rint(cv2.GaussianBlur(chosen, (0, 0), 0.6) + noise), 0, 255).astype(np.uint8)


def test_a_wall_behind_bare_ground_is_refused_though_the_camera_was_rolled():
    with pytest.raises(Refusal) as refused:
        align(wall_beyond(stones(), bricks(), rolled(18.0), 3.4), None)
    assert refused.value.code == "not_ground"


@pytest.mark.parametrize(
    "camera", [CAMERA, pytest.param(None, marks=pytest.mark.slow)], ids=["camera", "no camera"]
)
def test_a_wall_that_the_camera_looks_down_on_is_no_floor_seen_upside_down(camera: Camera | None):
    photo = wall_beyond(stones(), bricks(), rolled(32.0), 3.0)
    with pytest.raises(Refusal):
        align(photo, camera)
    # Turned by half, it is a floor's.
    assert align(photo[::-1, ::-1].copy(), camera).lattice.kind == "running"


@pytest.mark.parametrize(
    ("paving", "kind"),
    [(bricks(), "running"), pytest.param(ashlar(), "rows", marks=pytest.mark.slow)],
)
def test_level_courses_seen_from_above_are_ground_for_who_vouches_for_it(paving: np.ndarray, kind: str):
    pose = look_at_ground(pitch_deg=72.0, height_m=4.0, heading_deg=0.5)
    photo = wall_beyond(paving, stones(), pose, 50.0)
    with pytest.raises(Refusal, match="--ground") as refused:
        align(photo, CAMERA)
    assert refused.value.code == "not_ground"
    found = align(photo, CAMERA, ground=True)
    assert found.lattice.kind == kind
    assert np.rad2deg(np.arccos(found.pose.cam_from_ground.R[:, 2] @ pose.R[:, 2])) < 0.1


# Nor does it make a wall the ground that somebody vouches for that.
@pytest.mark.slow
@pytest.mark.parametrize("ground", [False, True])
def test_the_ground_before_a_wall_is_found_where_the_wall_is_plainer(ground: bool):
    pose = rolled(22.0)
    found = align(wall_beyond(ashlar(), bricks(), pose, 4.2), CAMERA, ground=ground)
    assert found.lattice.kind == "rows"
    turn = min(
        np.rad2deg(angle_between_rotations(found.pose.cam_from_ground.R @ np.diag([s, s, 1.0]), pose.R))
        for s in (1.0, -1.0)
    )
    assert turn < 0.3


@pytest.mark.parametrize(
    ("pitch", "heading", "expected"),
    [(88.0, 0.0, True), (75.0, 95.0, True), (75.0, 20.0, False), (50.0, 0.0, False)],
)
def test_grounds_seen_from_the_front_and_level_look_like_walls(pitch: float, heading: float, expected: bool):
    assert like_wall(look_at_ground(pitch_deg=pitch, height_m=1.6, heading_deg=heading).R) == expected


def tiles(side_m: float, contrast: float) -> np.ndarray:
    """Square tiles, whose joints are so much darker."""
    picture, side = stones(6), round(side_m * PX_PER_M)
    picture[np.arange(SIDE_PX) % side < 2] -= contrast
    picture[:, np.arange(SIDE_PX) % side < 2] -= contrast
    return picture


def aslant(roll_deg: float) -> Rigid:
    """The pose of a camera that looks down on a wall, and past it."""
    return look_at_ground(pitch_deg=22.0, height_m=1.6, heading_deg=27.0, roll_deg=roll_deg)


@pytest.mark.parametrize("roll_deg", [0.3, pytest.param(4.5, marks=pytest.mark.slow)])
def test_the_floor_before_a_tiled_wall_that_faces_aside_is_found_where_the_wall_is_plainer(roll_deg: float):
    pose = aslant(roll_deg)
    photo = wall_beyond(tiles(0.3, 25.0), tiles(0.2, 90.0), pose, 2.6)
    found = align(photo, CAMERA).pose.cam_from_ground.R
    assert np.rad2deg(np.arccos(found[:, 2] @ pose.R[:, 2])) < 0.3


def test_a_tiled_wall_that_faces_aside_is_wondered_at_where_no_ground_is_seen_before_it():
    photo = wall_beyond(stones(), tiles(0.2, 90.0), aslant(5.0), 2.6)
    assert any("wall" in said for said in align(photo, CAMERA).warnings)
    assert not any("wall" in said for said in align(photo, CAMERA, ground=True).warnings)


@pytest.mark.parametrize(("pitch", "wondered"), [(95.0, False), (112.0, True), (60.0, False)])
def test_squares_that_recede_downwards_beyond_what_a_look_at_ones_feet_allows_are_wondered_at(
    pitch: float, wondered: bool
):
    photo = wall_beyond(tiles(0.2, 60.0), stones(), look_at_ground(pitch_deg=pitch, height_m=1.6), 50.0)
    found = align(photo, CAMERA)
    assert found.lattice.kind == "stack"
    assert any("wall" in said for said in found.warnings) == wondered


def test_courses_that_recede_downwards_are_a_walls_though_the_camera_was_rolled():
    with pytest.raises(Refusal) as refused:
        align(wall_beyond(stones(), bricks(), aslant(7.5), 2.6), CAMERA)
    assert refused.value.code == "not_ground"


@pytest.mark.parametrize(
    ("pitch", "heading", "roll", "expected"),
    [(60.0, 20.0, 10.0, False), (60.0, 3.0, 94.0, True), (60.0, 40.0, 90.0, False), (85.0, 3.0, 94.0, False)],
)
def test_what_is_ground_only_for_a_camera_rolled_far_is_like_a_wall_if_its_joints_stand_upright(
    pitch: float, heading: float, roll: float, expected: bool
):
    pose = look_at_ground(pitch_deg=pitch, height_m=1.6, heading_deg=heading, roll_deg=roll)
    assert like_upright_wall(pose.R) == expected
    assert roll_deg(pose.R) == pytest.approx(roll, abs=1.0)


@pytest.mark.parametrize(
    ("aside_deg", "possible"), [(30.0, (True, True)), (44.0, (False, True)), (50.0, (False, False))]
)
def test_joints_may_lead_from_a_ground_that_a_camera_may_see_to_one_a_little_beyond(
    aside_deg: float, possible: tuple[bool, bool]
):
    aside = np.radians(aside_deg)
    up = np.array([np.sin(aside), 0.0, -np.cos(aside)])
    assert (bool(possible_up(up)), bool(possible_up(up, np.radians(5.0)))) == possible
