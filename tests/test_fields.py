"""Of two fields of paving in a photo the larger one is the answer, or the one whose slabs are asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autoreg import fields, laying
from autoreg.align import align
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fields import largest_field
from autoreg.geometry import angle_between_rotations, rotation_from_vector
from autoreg.ground.ground_frame import turned
from autoreg.ground.points import on_ground, project_ground
from autoreg.ground.sight import Sight, see
from autoreg.paving.lattice_evidence import Paving
from autoreg.rows.cross_joints import CrossJoints
from autoreg.rows.rows import Rows
from autoreg.search.find import find_paving
from autoreg.segments import Segments
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving
from autoreg.task import Task
from tests.paved import gray_of

CAMERA = Camera(900, 700, 800.0, 800.0, 449.5, 349.5)
NEAR = SyntheticScene(
    camera=CAMERA,
    cam_from_ground=look_at_ground(pitch_deg=32.0, height_m=1.7, heading_deg=12.0),
    spacing_m=(0.2, 0.1),
    shift=0.5,
    joint_width_m=0.006,
    seed=11,
)
FAR = replace(NEAR, spacing_m=(0.6, 0.3), shift=1 / 3, slab_tone=185.0, seed=12)


# Turned to the near one.
ASKEW = replace(FAR, cam_from_ground=look_at_ground(pitch_deg=32.0, height_m=1.7, heading_deg=37.0))
PORTRAIT = Camera(700, 900, 800.0, 800.0, 349.5, 449.5)
LENS = replace(CAMERA, dist=(-0.15, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def beside(near: SyntheticScene, far: SyntheticScene, border_m: float) -> np.ndarray:
    """Grey levels of one field up to so far from the camera's foot, straight ahead, and another beyond."""
    camera = near.camera
    px = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).astype(float)
    ground = on_ground(px.reshape(-1, 2), camera, near.cam_from_ground).reshape(*px.shape)
    foot = near.cam_from_ground.origin_in_a
    ahead = near.cam_from_ground.R[2, :2]
    along = (ground - foot[:2]) @ (ahead / np.linalg.norm(ahead))
    first, second = (gray_of(render_paving(scene)) for scene in (near, far))
    return np.where(along < border_m, first, second).astype(np.uint8)


# Large slabs of which few are seen, beyond bricks seen from above.
STEEP = Camera(800, 600, 860.0, 860.0, 410.0, 298.0)
BRICKS = replace(
    NEAR, camera=STEEP, cam_from_ground=look_at_ground(pitch_deg=58.0, height_m=2.0, heading_deg=9.0), seed=3
)
FEW = replace(BRICKS, spacing_m=(0.6, 0.6), shift=0.0, joint_width_m=0.014, slab_tone=185.0, seed=4)


@pytest.mark.slow
def test_few_slabs_that_were_asked_for_are_found_beside_bricks():
    found = align(beside(BRICKS, FEW, 1.2), STEEP, slab=(0.6, 0.6))
    assert found.lattice.kind == "stack"
    assert found.pose.cam_from_ground.origin_in_a[2] == pytest.approx(2.0, rel=2e-3)


@pytest.fixture(scope="module")
def two_fields() -> np.ndarray:
    return beside(NEAR, FAR, 2.4)


def found_in(gray: np.ndarray, camera: Camera = CAMERA) -> tuple[Sight, Paving]:
    sight = see(gray)
    found = find_paving(sight, camera)
    assert isinstance(found, Paving)
    return sight, found


def sides_m(paving: Paving) -> list[float]:
    """Slab sides, by the height that the scenes have their camera at."""
    height = float(paving.fit.cam_from_ground.origin_in_a[2])
    return [1.7 * (paving.grid.spacing_x or np.nan) / height, 1.7 * paving.grid.spacing_y / height]


def turn_deg(paving: Paving, scene: SyntheticScene) -> float:
    """How far a rotation is from a scene's, up to half turns of the ground."""
    poses = [turned(paving.fit.cam_from_ground, q) for q in (0, 2)]
    return float(np.rad2deg(min(angle_between_rotations(p.R, scene.cam_from_ground.R) for p in poses)))


@pytest.fixture
def others(monkeypatch: pytest.MonkeyPatch) -> list[Paving | None]:
    """What is found beside a known field, call by call."""
    seen: list[Paving | None] = []
    find = fields._found_in

    def watched(*asked: object) -> Paving | None:
        seen.append(find(*asked))  # pyright: ignore[reportArgumentType]
        return seen[-1]

    monkeypatch.setattr(fields, "_found_in", watched)
    return seen


def test_the_plainest_field_is_the_near_one(two_fields: np.ndarray) -> None:
    _, found = found_in(two_fields)
    assert sides_m(found) == pytest.approx([0.2, 0.1], rel=0.02)


@pytest.mark.parametrize(
    ("camera", "far", "border_m"),
    [
        (CAMERA, FAR, 2.4),
        pytest.param(CAMERA, ASKEW, 2.4, marks=pytest.mark.slow),
        pytest.param(PORTRAIT, ASKEW, 2.2, marks=pytest.mark.slow),
        pytest.param(LENS, ASKEW, 2.6, marks=pytest.mark.slow),
    ],
    ids=["in line", "askew", "portrait", "lens"],
)
def test_the_larger_field_beyond_it_is_taken(camera: Camera, far: SyntheticScene, border_m: float) -> None:
    near, far = replace(NEAR, camera=camera), replace(far, camera=camera)
    sight, found = found_in(beside(near, far, border_m), camera)
    largest = largest_field(sight, found, camera)
    assert sides_m(largest) == pytest.approx([0.6, 0.3], rel=0.02)
    assert largest.grid.shift == pytest.approx(1 / 3, abs=0.01)
    assert turn_deg(largest, far) < 0.2


@pytest.mark.slow
def test_a_field_that_is_larger_on_the_ground_and_smaller_in_the_picture_is_not_taken(
    others: list[Paving | None],
) -> None:
    sight, found = found_in(beside(NEAR, ASKEW, 3.0))
    assert largest_field(sight, found, CAMERA) is found
    assert others[0] is not None


@pytest.mark.slow
def test_fine_slabs_are_no_smaller_field_for_being_seen_less_far(others: list[Paving | None]) -> None:
    # Bricks on the left of the border, slabs on the right, as far as the picture shows them.
    pose = look_at_ground(pitch_deg=32.0, height_m=1.7, heading_deg=12.0, foot_m=(0.1, 0.23))
    slabs = replace(FAR, cam_from_ground=pose, spacing_m=(0.53, 0.37), shift=0.5)
    gray = gray_of(render_paving(NEAR))
    gray[:, 620:] = gray_of(render_paving(slabs))[:, 620:]
    sight, found = found_in(gray.astype(np.uint8))
    largest = largest_field(sight, found, CAMERA)
    assert others[0] is not None
    assert sides_m(largest) == pytest.approx([0.2, 0.1], rel=0.02)


@pytest.mark.slow
def test_a_field_on_another_plane_is_none_of_this_ground(others: list[Paving | None]) -> None:
    pose = look_at_ground(pitch_deg=34.7, height_m=1.7, heading_deg=20.0)
    ramp = replace(FAR, cam_from_ground=pose, spacing_m=(0.3, 0.3))
    sight, found = found_in(beside(NEAR, ramp, 2.2))
    assert largest_field(sight, found, CAMERA) is found
    assert others[0] is not None


@pytest.mark.slow
def test_of_two_fields_that_with_the_known_slabs_is_taken() -> None:
    sight, found = found_in(beside(replace(NEAR, spacing_m=(0.15, 0.1)), FAR, 2.4))
    assert largest_field(sight, found, CAMERA, (0.15, 0.1)) is found
    other = largest_field(sight, found, CAMERA, (0.6, 0.3))
    assert other is not found
    assert sides_m(other) == pytest.approx([0.6, 0.3], rel=0.02)


def test_a_field_too_fine_for_the_whole_photo_is_no_other_one(
    two_fields: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    sight, found = found_in(two_fields)
    grid = found.grid
    assert grid.spacing_x is not None
    fine = replace(
        found.fit, grid=replace(grid, spacing_x=grid.spacing_x / 40, spacing_y=grid.spacing_y / 40)
    )
    looked = []

    def tiny(*asked: object) -> Paving:
        looked.append(asked)
        return replace(found, fit=fine)

    monkeypatch.setattr(fields, "_found_in", tiny)
    assert largest_field(sight, found, CAMERA) is found
    assert looked


def test_beside_a_field_without_edges_nothing_is_looked_for(others: list[Paving | None]) -> None:
    sight, found = found_in(beside(NEAR, NEAR, 2.4))
    assert largest_field(sight, found, CAMERA) is found
    assert not others


@pytest.mark.slow
def test_a_part_of_the_same_lattice_is_no_other_field_by_a_wrong_camera(others: list[Paving | None]) -> None:
    # By the wrong camera the lattice does not go on as itself.
    scene = replace(NEAR, cam_from_ground=look_at_ground(pitch_deg=30.0, height_m=1.7, heading_deg=70.0))
    wrong = replace(CAMERA, fx=1.2 * CAMERA.fx, fy=1.2 * CAMERA.fy)
    sight, found = found_in(gray_of(render_paving(scene)).astype(np.uint8), wrong)
    assert largest_field(sight, found, wrong) is found
    assert others[0] is not None


FIELD = np.array([[-1.0, 2.0], [1.0, 2.0], [1.0, 5.0], [-1.0, 5.0]])
LEVEL = look_at_ground(pitch_deg=20.0, height_m=1.7)


def on_the_ground(*pieces: tuple[float, float, float, float]) -> Segments:
    """Segments that are seen of pieces of the ground, from (x, y) to (x, y), in metres."""
    px = project_ground(CAMERA, LEVEL, np.array(pieces).reshape(-1, 2, 2))
    return Segments(px, np.full(len(px), 0.1), np.zeros(len(px), int))


def grating(x: float, y: float, *, both: bool = True) -> list[tuple[float, float, float, float]]:
    """Ten parallel edges beside a place, and as many that are square to them."""
    steps = [0.2 * k for k in range(10)]
    along = [(x, y + s, x + 1.8, y + s) for s in steps]
    return along + [(x + s, y, x + s, y + 1.8) for s in steps] * both


@pytest.mark.parametrize(
    ("pieces", "least", "seen"),
    [
        (grating(1.2, 2.5), 0.35, True),
        (grating(1.2, 2.5), 5.0, False),
        (grating(1.2, 2.5, both=False), 0.35, False),
        (
            grating(1.2, 2.5) + 30 * [tuple(10.0 * v for v in piece) for piece in grating(1.2, 2.5)],
            5.0,
            False,
        ),
    ],
    ids=["a field", "too little of it", "one direction", "beyond reach"],
)
def test_what_lies_beside_a_field_is_looked_at_if_it_may_be_another(
    pieces: list[tuple[float, float, float, float]], least: float, seen: bool
) -> None:
    covered = fields._Covered(LEVEL, FIELD)
    inside = grating(-0.9, 2.5)
    part = fields._part_beside(on_the_ground(*inside, *pieces), CAMERA, covered, least)
    assert (part is not None) == seen


def test_a_field_is_painted_over_in_the_tone_around_it() -> None:
    covered = fields._Covered(LEVEL, FIELD)
    gray = np.full((CAMERA.height, CAMERA.width), 120, np.uint8)
    stripes = gray.copy()
    centre = project_ground(CAMERA, LEVEL, FIELD.mean(0)[None])[0].round().astype(int)
    stripes[centre[1] - 3 : centre[1] + 3, centre[0] - 20 : centre[0] + 20] = 0
    stripes[:40] = 200
    painted = fields._painted(stripes, CAMERA, covered)
    assert (painted[:40] == 200).all()
    assert np.abs(painted[centre[1] - 20 : centre[1] + 20].astype(int) - 120).max() <= 5


def test_the_rim_of_a_field_is_left_for_what_lies_beside_it() -> None:
    covered = fields._Covered(LEVEL, FIELD).less(0.1)
    gray = np.full((CAMERA.height, CAMERA.width), 120, np.uint8)
    near, far = FIELD.min(0)[1], FIELD.max(0)[1]
    across = float(FIELD[:, 0].mean())
    rims = np.array([[across, near + 0.03], [across, far - 0.03]])
    for u, v in project_ground(CAMERA, LEVEL, rims).round().astype(int):
        gray[v - 1 : v + 2, u - 5 : u + 6] = 0
        assert (fields._painted(gray, CAMERA, covered)[v - 1 : v + 2, u - 5 : u + 6] == 0).all()


def test_the_answer_is_the_larger_field(two_fields: np.ndarray) -> None:
    answer = align(two_fields, CAMERA, slab=(0.6, 0.3))
    assert answer.lattice.kind == "running"
    assert answer.lattice.shift == pytest.approx(1 / 3, abs=0.01)
    height = float(answer.pose.cam_from_ground.origin_in_a[2])
    assert height == pytest.approx(1.7, rel=0.005)
    up = answer.pose.cam_from_ground.R[:, 2] @ NEAR.cam_from_ground.R[:, 2]
    assert np.rad2deg(np.arccos(min(up, 1.0))) < 0.1


@pytest.mark.parametrize(
    ("code", "answered"),
    [
        ("no_lattice", True),
        pytest.param("not_ground", True, marks=pytest.mark.slow),
        ("camera_contradicted", False),
    ],
)
def test_where_the_larger_field_is_refused_the_other_is_the_answer(
    two_fields: np.ndarray, monkeypatch: pytest.MonkeyPatch, code: str, answered: bool
) -> None:
    measure = laying._measured

    def of_bricks_alone(task: Task, found: Paving) -> object:
        if sides_m(found)[0] > 0.4:
            raise Refusal(code, "the slabs are refused")
        return measure(task, found)

    monkeypatch.setattr(laying, "_measured", of_bricks_alone)
    monkeypatch.setattr(laying, "find_rows", lambda *_: None)
    if answered:
        lattice = align(two_fields, CAMERA, camera_height=1.7).lattice
        assert (lattice.spacing_x, lattice.spacing_y) == pytest.approx((0.2, 0.1), rel=0.01)
    else:
        with pytest.raises(Refusal, match="slabs"):
            align(two_fields, CAMERA, camera_height=1.7)


@pytest.mark.parametrize(
    ("turn_deg", "code", "answered"),
    [
        (0.3, "no_lattice", True),
        (0.3, "one_direction", True),
        (0.3, "too_few_joints", True),
        (0.3, "not_ground", False),
        (6.0, "no_lattice", False),
    ],
)
def test_rows_in_place_of_a_lattice_that_is_not_there_lie_on_its_ground(
    two_fields: np.ndarray, monkeypatch: pytest.MonkeyPatch, turn_deg: float, code: str, answered: bool
) -> None:
    sight, found = found_in(two_fields)
    turn = rotation_from_vector(np.radians([turn_deg, 0.0, 0.0]))
    pose = replace(found.fit.cam_from_ground, R=found.fit.cam_from_ground.R @ turn)
    paving = replace(found, fit=replace(found.fit, cam_from_ground=pose))
    rows = Rows(paving, CrossJoints(np.zeros((0, 2)), 50.0), np.zeros(2))

    def measured(task: Task, what: Paving | Rows) -> object:
        raise Refusal(code, "measured as rows" if what is rows else "of several stones")

    monkeypatch.setattr(laying, "_measured", measured)
    monkeypatch.setattr(laying, "find_rows", lambda *_: rows)
    monkeypatch.setattr(laying, "maybe_wall", lambda *_: None)
    task = Task(sight, CAMERA, "file", None, None, None)
    with pytest.raises(Refusal, match="measured as rows" if answered else "several stones"):
        laying.lay_where(task, found)
