from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import skimage.data
from paved import CHECKER, HALF_BOND, STACK, THIRD_BOND, board_in_a_room, misses

import autoreg
from autoreg.alignment import Alignment
from autoreg.camera import Camera
from autoreg.camera_files import read_camera
from autoreg.errors import Refusal
from autoreg.geometry import Rigid
from autoreg.ground.sight import see
from autoreg.image import as_gray
from autoreg.lattice import Lattice
from autoreg.laying import camera_to_blame
from autoreg.paving.lattice_evidence import Paving
from autoreg.synthetic import SyntheticPhoto, SyntheticScene, look_at_ground, render_paving
from autoreg.task import Task

ROOT = Path(__file__).resolve().parents[1]
FIXTURES = ROOT / "fixtures"
SCENES = ROOT.parent / "shared" / "scenes"
HERRINGBONE = ROOT.parent / "shared" / "photos" / "refuse" / "hg_herringbone_18.jpg"


@dataclass(frozen=True)
class Told:
    """A photo of a folder of ray-traced scenes, with what its truth says."""

    photo: SyntheticPhoto
    slab: tuple[float, float]


def ray_traced(folder: Path, name: str) -> Told:
    truth = json.loads((folder / f"{name}.truth.json").read_text())
    pixels = cv2.imread(str(folder / f"{name}.jpg"))
    assert pixels is not None
    a, b = truth["slab"]
    lattice = Lattice("running" if truth["bond"] else "stack", a, b, truth["bond"], 0.01, np.zeros((0, 2)))
    camera = read_camera(folder / f"{name}.camera.json")
    pose = Rigid(np.array(truth["R"]), np.array(truth["t"]))
    return Told(SyntheticPhoto(pixels, camera, pose, lattice), (a, b))


def spacing_of(found: Alignment) -> tuple[float, float]:
    assert found.lattice.spacing_x is not None
    return found.lattice.spacing_x, found.lattice.spacing_y


def miss_of(found: Alignment, photo: SyntheticPhoto) -> tuple[float, float]:
    return misses(found.pose.cam_from_ground, spacing_of(found), photo)


PAVED = {
    "stack": STACK,
    "half bond": HALF_BOND,
    "third bond": THIRD_BOND,
    "checker": CHECKER,
    "light joints": replace(STACK, joint_tone=215.0, slab_tone=120.0, seed=5),
}


@cache
def drawn(name: str) -> SyntheticPhoto:
    return render_paving(PAVED[name])


@cache
def aligned(name: str) -> Alignment:
    """The alignment of a synthetic scene whose camera and slab are told."""
    photo = drawn(name)
    return autoreg.align(photo.pixels, photo.camera, slab=PAVED[name].spacing_m)


@pytest.mark.parametrize("name", PAVED)
def test_each_bond_is_found_with_its_pose(name: str):
    scene = PAVED[name]
    found = aligned(name)
    angle_deg, crossing_px = miss_of(found, drawn(name))
    assert angle_deg < 0.02
    assert crossing_px < 0.2
    assert found.lattice.kind == ("running" if scene.shift else "stack")
    assert found.lattice.shift == pytest.approx(scene.shift)
    # Neither half nor twice the slabs: the scale is the slab's, so it shows in the height.
    assert sorted(spacing_of(found)) == pytest.approx(sorted(scene.spacing_m), rel=1e-6)
    assert found.pose.cam_from_ground.origin_in_a[2] == pytest.approx(1.6, rel=0.002)
    assert found.camera.source == "file"
    assert found.camera.consistent
    assert found.residual.rms_px < 0.1


def test_the_stated_covariance_is_of_the_size_of_the_error():
    found, photo = aligned("stack"), drawn("stack")
    covariance = found.pose.covariance
    assert covariance == pytest.approx(covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0
    angle_deg, _ = miss_of(found, photo)
    sigma_deg = np.rad2deg(np.sqrt(np.trace(covariance[:3, :3])))
    assert 0.1 * angle_deg < sigma_deg < 0.1


def test_the_same_photo_gives_the_same_answer_twice():
    photo = drawn("stack")
    once, again = aligned("stack"), autoreg.align(photo.pixels, photo.camera, slab=(0.4, 0.6))
    # The order in which the slab's sides are told does not matter either.
    assert (once.pose.cam_from_ground.R == again.pose.cam_from_ground.R).all()
    assert (once.pose.cam_from_ground.t == again.pose.cam_from_ground.t).all()
    assert once.residual == again.residual
    assert len(once.joints) == len(again.joints)


@pytest.mark.slow
def test_a_board_in_a_room_is_found_and_its_rim_is_no_joint():
    pose = look_at_ground(pitch_deg=50.0, height_m=4.5, heading_deg=20.0, foot_m=(0.13, 0.21))
    photo = render_paving(replace(CHECKER, cam_from_ground=pose))
    side = np.array(CHECKER.spacing_m)
    ray = photo.cam_from_ground.R[2]
    eye = photo.cam_from_ground.origin_in_a
    middle = np.round((eye[:2] - ray[:2] * eye[2] / ray[2]) / side) * side
    # A seventh of the picture; the rim lies a little beyond where the next joint would be.
    board = board_in_a_room(photo, middle - side * [3.55, 2.55], middle + side * [3.55, 2.55])
    found = autoreg.align(board, photo.camera, slab=CHECKER.spacing_m)
    angle_deg, _ = miss_of(found, photo)
    assert angle_deg < 0.03
    assert found.camera.consistent


def test_without_a_camera_the_photos_own_joints_tell_its_focal_length():
    photo = drawn("stack")
    found = autoreg.align(photo.pixels, None, slab=STACK.spacing_m)
    assert found.camera.source == "photo"
    assert found.camera.camera.fx == pytest.approx(photo.camera.fx, rel=0.05)
    assert found.camera.consistent is None
    angle_deg, _ = miss_of(found, replace(photo, camera=found.camera.camera))
    assert angle_deg < 1.5


@pytest.mark.slow
def test_an_exif_that_a_crop_has_falsified_is_not_followed():
    photo = drawn("stack")
    found = autoreg.align(photo.pixels, None, exif_focal_px=0.6 * photo.camera.fx)
    assert found.camera.source == "photo"
    assert found.camera.camera.fx == pytest.approx(photo.camera.fx, rel=0.1)
    assert any("EXIF" in warning for warning in found.warnings)


def test_who_tells_the_slab_tells_which_of_two_lattices_it_is(monkeypatch: pytest.MonkeyPatch):
    photo = drawn("stack")

    def every_other_row(_: np.ndarray, paving: Paving) -> Paving:
        grid = paving.fit.grid
        return replace(paving, fit=replace(paving.fit, grid=replace(grid, spacing_y=2.0 * grid.spacing_y)))

    monkeypatch.setattr("autoreg.answer.full_resolution.of_joints_alone", every_other_row)
    assert autoreg.align(photo.pixels, photo.camera, slab=STACK.spacing_m).lattice.kind == "stack"
    with pytest.raises(Refusal, match="two lattices") as caught:
        autoreg.align(photo.pixels, photo.camera)
    assert caught.value.code == "ambiguous"


def test_a_focal_length_from_the_joints_allows_for_the_unknown_principal_point():
    """A few pixels from the middle, which no photo tells, move the focal length by a per cent."""
    plain = STACK.camera
    camera = replace(plain, cx=plain.cx + 0.012 * plain.width, cy=plain.cy - 0.012 * plain.width)
    photo = render_paving(replace(STACK, camera=camera))
    found = autoreg.align(photo.pixels, None, slab=STACK.spacing_m).camera
    assert found.focal_from_photo_px is not None
    assert found.focal_from_photo_sigma_px is not None
    assert abs(found.focal_from_photo_px - camera.fx) < 3.0 * found.focal_from_photo_sigma_px
    assert found.focal_from_photo_sigma_px < 0.05 * camera.fx


def test_slabs_seen_from_straight_above_do_not_tell_the_height_of_an_unknown_camera():
    board = skimage.data.checkerboard()
    with pytest.raises(Refusal, match="--camera") as caught:
        autoreg.align(board, None)
    assert caught.value.code == "ambiguous"
    found = autoreg.align(board, Camera.from_focal(200, 200, 300.0), slab=(0.25, 0.25))
    assert found.pose.cam_from_ground.origin_in_a[2] == pytest.approx(3.0, rel=0.01)


@cache
def seen_from_aside(heading_deg: float, joint_width_m: float, seed: int) -> SyntheticPhoto:
    pose = look_at_ground(
        pitch_deg=38.0, height_m=1.6, heading_deg=heading_deg, roll_deg=1.0, foot_m=(0.1, 0.2)
    )
    return render_paving(
        SyntheticScene(
            camera=Camera.from_focal(1024, 768, 896.0),
            cam_from_ground=pose,
            joint_width_m=joint_width_m,
            colour=False,
            seed=seed,
        )
    )


def test_wide_joints_are_not_taken_by_one_edge():
    photo = seen_from_aside(74.0, 0.04, 2)
    found = autoreg.align(photo.pixels, photo.camera, slab=(0.4, 0.4))
    assert found.lattice.joint_width == pytest.approx(0.04, rel=0.05)
    angle_deg, crossing_px = miss_of(found, photo)
    assert angle_deg < 0.02
    assert crossing_px < 0.2


@pytest.mark.slow
def test_a_skew_stack_seen_through_a_wrong_camera_is_no_running_bond():
    photo = seen_from_aside(37.0, 0.01, 1)
    wrong = Camera.from_focal(1024, 768, 0.8 * 896.0)
    with pytest.raises(Refusal) as caught:
        autoreg.align(photo.pixels, wrong, slab=(0.4, 0.4))
    assert caught.value.code == "camera_contradicted"
    assert caught.value.measured == pytest.approx(896.0, rel=0.01)


def test_a_camera_is_to_blame_for_sides_that_the_joints_have_by_their_own_one():
    photo = seen_from_aside(37.0, 0.01, 1)
    sight = see(as_gray(photo.pixels))
    cut = replace(photo.camera, cx=photo.camera.cx + 245.0, cy=photo.camera.cy - 180.0)
    blamed = camera_to_blame(Task(sight, cut, "file"), slab=(0.4, 0.4))
    assert blamed is not None
    assert blamed.code == "camera_contradicted"
    assert "principal point" in blamed.message
    assert "--crop" in blamed.message
    # By no camera do square slabs have other sides, and by the right one there is nothing to blame.
    assert camera_to_blame(Task(sight, cut, "file"), slab=(0.6, 0.4)) is None
    assert camera_to_blame(Task(sight, photo.camera, "file"), slab=(0.4, 0.4)) is None
    assert camera_to_blame(Task(sight, None, "photo"), slab=(0.6, 0.4)) is None


def test_ground_without_a_lattice_is_refused_by_name(gravel_photo: SyntheticPhoto):
    with pytest.raises(Refusal) as caught:
        autoreg.align(gravel_photo.pixels, gravel_photo.camera, slab=(0.4, 0.4))
    assert caught.value.code in {"no_lattice", "one_direction", "too_few_joints", "not_ground"}
    assert caught.value.exit_code == 3
    assert len(caught.value.message) > 40


OTHER_THINGS = ("brick",)
OTHERS_THAT_TAKE_LONG = ("grass", "gravel", "chelsea", "page", "stereo_motorcycle")


@pytest.mark.parametrize(
    "name", [*OTHER_THINGS, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS_THAT_TAKE_LONG)]
)
def test_real_pictures_of_other_things_are_refused(name: str):
    """Those that scikit-image brings along: a brick wall, a cat, grass, a scanned page, ..."""
    loaded = getattr(skimage.data, name)()
    picture = np.asarray(loaded[0] if isinstance(loaded, tuple) else loaded, np.uint8)
    with pytest.raises(Refusal) as caught:
        autoreg.align(picture[..., 2::-1] if picture.ndim == 3 else picture, None)
    assert caught.value.code in {"no_lattice", "one_direction", "too_few_joints", "not_ground"}


def test_a_blank_photo_is_refused_by_name():
    camera = Camera.from_focal(320, 240, 300.0)
    with pytest.raises(Refusal, match=r"within 0\.0 of 255 grey levels"):
        autoreg.align(np.full((240, 320), 128, np.uint8), camera, slab=(0.4, 0.4))


@pytest.mark.parametrize("name", ["terrace", "running_bond"])
def test_the_fixtures_are_aligned_with_what_povray_drew(name: str):
    told = ray_traced(FIXTURES, name)
    found = autoreg.align(told.photo.pixels, told.photo.camera, slab=told.slab)
    angle_deg, crossing_px = miss_of(found, told.photo)
    assert angle_deg < 0.1
    assert crossing_px < 1.0
    assert found.lattice.shift == pytest.approx(0.5 if name == "running_bond" else 0.0)
    assert sorted(spacing_of(found)) == pytest.approx(sorted(told.slab))


def test_the_crazy_paving_of_the_fixtures_is_refused():
    told = ray_traced(FIXTURES, "crazy_paving")
    with pytest.raises(Refusal):
        autoreg.align(told.photo.pixels, told.photo.camera, slab=told.slab)


@pytest.mark.skipif(not SCENES.is_dir(), reason="needs the ray-traced scenes beside the repository")
@pytest.mark.parametrize("name", ["open-easy-0", "open-lens"])
def test_ray_traced_scenes_are_aligned(name: str):
    told = ray_traced(SCENES, name)
    found = autoreg.align(told.photo.pixels, told.photo.camera, slab=told.slab)
    angle_deg, crossing_px = miss_of(found, told.photo)
    assert angle_deg < 0.1
    assert crossing_px < 1.5


@pytest.mark.slow
@pytest.mark.skipif(not HERRINGBONE.is_file(), reason="needs the photos beside the repository")
@pytest.mark.parametrize("part", [np.s_[:716], np.s_[308:]], ids=["left", "right"])
def test_parts_of_a_herringbone_drive_are_refused(part: slice):
    gray = cv2.imread(str(HERRINGBONE), cv2.IMREAD_GRAYSCALE)
    assert gray is not None
    with pytest.raises(Refusal):
        autoreg.align(np.ascontiguousarray(gray[:, part]), None)


@pytest.mark.parametrize("told", [True, False], ids=["camera", "no camera"])
def test_boards_are_refused_for_having_one_direction(told: bool):
    # Far from where any of them ends.
    pose = Rigid(STACK.cam_from_ground.R, STACK.cam_from_ground.apply(np.array([250.0, 0.0, 0.0])))
    photo = render_paving(replace(STACK, spacing_m=(500.0, 0.15), cam_from_ground=pose))
    with pytest.raises(Refusal) as refusal:
        autoreg.align(photo.pixels, photo.camera if told else None)
    assert refusal.value.code == "one_direction"
    assert "joints in both directions" in refusal.value.message


@pytest.mark.parametrize(
    "slab", [(0.6, -0.4), (0.6, float("nan")), (0.0, 0.4), (1e300, 1e300), (True, True), ("0.6", "0.4")]
)
def test_a_slab_has_two_lengths_that_slabs_may_have(slab: Any):
    photo = drawn("stack")
    with pytest.raises(ValueError, match=r"slab: two lengths in metres are wanted, .* from 1e-06 to 1e\+06"):
        autoreg.align(photo.pixels, photo.camera, slab=slab)


@pytest.mark.parametrize("height", [0.0, -1.5, float("inf"), 1e300, True, "1.5"])
def test_a_camera_stands_at_a_height_that_cameras_may_have(height: Any):
    photo = drawn("stack")
    with pytest.raises(ValueError, match=r"camera_height: must be a length in metres"):
        autoreg.align(photo.pixels, photo.camera, camera_height=height)


@pytest.mark.parametrize(
    ("pitch", "told", "shift", "joint_mm"),
    [((0.61, 0.41), "0.610x0.410", 0.0, 10), ((0.205, 0.105), "0.205x0.105", 0.5, 5)],
)
def test_sides_without_their_joints_leave_the_pose_right_and_are_put_right_in_words(
    pitch: tuple[float, float], told: str, shift: float, joint_mm: int
):
    joint = 1e-3 * joint_mm
    scene = replace(STACK, spacing_m=pitch, shift=shift, joint_width_m=joint, seed=8)
    photo = render_paving(scene)
    slab = (pitch[0] - joint, pitch[1] - joint)
    found = autoreg.align(photo.pixels, photo.camera, slab=slab)
    assert found.camera.consistent
    a, b = spacing_of(found)
    assert max(a, b) / min(a, b) == pytest.approx(pitch[0] / pitch[1], rel=1e-3)
    assert a * b == pytest.approx(slab[0] * slab[1])
    # In the unit of the slabs as they were told, nothing but the scale is off.
    scale = float(np.sqrt(pitch[0] * pitch[1] / (slab[0] * slab[1])))
    pose = found.pose.cam_from_ground
    angle_deg, crossing_px = misses(Rigid(pose.R, scale * pose.t), (scale * a, scale * b), photo)
    assert angle_deg < 0.01
    assert crossing_px < 0.1
    (warning,) = found.warnings
    assert told in warning
    assert float(warning.split("with joints ")[1].split()[0]) == pytest.approx(joint_mm, abs=0.3)


@pytest.mark.parametrize(("side", "consistent"), [(0.596, True), (0.585, False)])
def test_a_slab_of_another_shape_is_named_and_the_pose_follows_the_joints(side: float, consistent: bool):
    photo = drawn("stack")
    found = autoreg.align(photo.pixels, photo.camera, slab=(side, 0.4))
    a, b = spacing_of(found)
    assert max(a, b) / min(a, b) == pytest.approx(1.5, rel=1e-3)
    # Shorter slabs than there are leave out no joint: they, or the camera, are wrong.
    (warning,) = found.warnings
    assert "measure a slab" in warning
    assert found.camera.consistent is consistent


def test_equal_sides_are_equal_with_their_joints_and_without():
    photo = drawn("checker")
    found = autoreg.align(photo.pixels, photo.camera, slab=(0.399, 0.399))
    a, b = spacing_of(found)
    assert a == pytest.approx(b)
    assert not found.warnings


def test_a_slab_that_was_told_exactly_is_taken_at_its_word():
    found = aligned("stack")
    a, b = spacing_of(found)
    assert max(a, b) / min(a, b) == pytest.approx(1.5, abs=1e-4)
    assert not found.warnings


def test_a_photo_that_does_not_stand_upright_is_refused_with_the_turn_that_it_needs():
    photo = drawn("stack")
    turned = np.ascontiguousarray(np.rot90(photo.pixels, -1))
    with pytest.raises(Refusal) as refused:
        autoreg.align(turned, photo.camera.turned(1), slab=(0.6, 0.4))
    assert refused.value.code == "not_ground"
    assert refused.value.measured == 270
