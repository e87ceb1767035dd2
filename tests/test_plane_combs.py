from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import CAMERA, HALF_BOND, STACK, gray_of

from autoreg.align import align
from autoreg.camera import Camera
from autoreg.geometry import angle_between_rotations
from autoreg.ground.rectify import near_reach, rectify
from autoreg.ground.sight import Look, Looks, Sight, see
from autoreg.paving.lattice_evidence import Paving
from autoreg.paving.periods import Comb, best_combs
from autoreg.paving.plane_combs import OTHER_FOCALS, PlaneCombs, comb_planes, sharpened, with_other_focals
from autoreg.search import find, glance
from autoreg.search import planes as search_planes
from autoreg.search.hypotheses import hypothesised
from autoreg.segments import Segments
from autoreg.synthetic import SyntheticPhoto, render_paving
from benchmarks.suites.robust import angle_up_to_quarter_turns, soft_light

# Long bricks, whose short joints tell little of where they vanish.
BRICKS = replace(HALF_BOND, spacing_m=(0.4, 0.1), joint_width_m=0.006)
# Tiles with joints that are hardly darker than they are.
FAINT = replace(STACK, spacing_m=(0.3, 0.3), slab_tone=150.0, joint_tone=125.0, joint_width_m=0.006)


@pytest.fixture(scope="module")
def photo() -> SyntheticPhoto:
    return render_paving(BRICKS)


@pytest.fixture(scope="module")
def sight(photo: SyntheticPhoto) -> Sight:
    return see(photo.pixels.mean(-1).astype(np.uint8))


@pytest.fixture(scope="module")
def plane(photo: SyntheticPhoto, sight: Sight) -> PlaneCombs:
    hypothesis = (photo.camera, photo.cam_from_ground.R)
    return comb_planes(sight.looks, sight.segments.take(np.zeros(0, int)), [hypothesis], free_focal=False)[0]


def by_focal(sight: Sight, plane: PlaneCombs, focal_px: float) -> PlaneCombs:
    """The plane by another focal length, which must be one of those that are looked at."""
    others = with_other_focals(sight.looks, plane)
    return next(other for other in others if other.camera.fx == pytest.approx(focal_px))


def end_px(camera: Camera, direction: np.ndarray) -> np.ndarray:
    image = camera.K @ direction
    return image[:2] / image[2]


def horizon(camera: Camera, up: np.ndarray) -> np.ndarray:
    line = np.linalg.inv(camera.K).T @ up
    return line / np.linalg.norm(line[:2])


def test_by_another_focal_length_the_horizon_and_the_clearer_joints_end_stay(sight: Sight, plane: PlaneCombs):
    found = with_other_focals(sight.looks, plane)
    factors = sorted(other.camera.fx / plane.camera.fx for other in found)
    assert factors == pytest.approx(OTHER_FOCALS)
    assert [p.score for p in found] == sorted((p.score for p in found), reverse=True)
    clearer = 0 if plane.x[0].score > plane.y[0].score else 1
    for other in found:
        assert np.abs(other.R.T @ other.R - np.eye(3)).max() < 1e-12
        assert np.linalg.det(other.R) == pytest.approx(1.0)
        assert other.camera.fy / other.camera.fx == pytest.approx(plane.camera.fy / plane.camera.fx)
        before_px, after_px = (end_px(p.camera, p.R[:, clearer]) for p in (plane, other))
        assert after_px == pytest.approx(before_px, abs=1e-6)
        lines = [horizon(p.camera, p.R[:, 2]) for p in (plane, other)]
        assert lines[0] == pytest.approx(lines[1], abs=1e-9)


def test_the_true_focal_length_is_among_those_of_a_plane_that_has_a_wrong_one(
    sight: Sight, plane: PlaneCombs
):
    wrong = by_focal(sight, plane, 0.8 * plane.camera.fx)
    right = by_focal(sight, wrong, plane.camera.fx)
    assert np.rad2deg(angle_between_rotations(right.R, plane.R)) < 1e-6
    assert right.score > wrong.score


def test_a_lattice_is_found_by_another_focal_length_than_that_of_the_segments(
    photo: SyntheticPhoto, sight: Sight, plane: PlaneCombs, monkeypatch: pytest.MonkeyPatch
):
    free, _ = hypothesised(sight.segments, sight.size, None)
    wrong = by_focal(sight, plane, 0.6 * plane.camera.fx)
    monkeypatch.setattr(find, "hypothesised", lambda *_, **__: (free, [(wrong.camera, wrong.R)]))
    # Neither are the joints lined up by the segments.
    monkeypatch.setattr(search_planes, "sharpened", lambda *_, **__: [wrong])
    found = find.find_paving(sight, None)
    assert isinstance(found, Paving)
    assert found.grid.shift == pytest.approx(0.5)
    assert (found.grid.spacing_x or 0.0) / found.grid.spacing_y == pytest.approx(4.0, rel=0.02)
    camera = found.fit.camera
    assert camera.fx / camera.width == pytest.approx(photo.camera.fx / photo.camera.width, rel=0.02)


def test_where_the_clearest_ground_shows_the_lattice_plainly_no_other_one_is_sharpened(
    photo: SyntheticPhoto, sight: Sight, monkeypatch: pytest.MonkeyPatch
):
    asked: list[int] = []

    def counted(
        looks: Looks, segments: Segments, planes: list[PlaneCombs], *count: int, free_focal: bool
    ) -> list[PlaneCombs]:
        asked.append(len(planes))
        return sharpened(looks, segments, planes, *count, free_focal=free_focal)

    monkeypatch.setattr(glance, "promising_plane", lambda *_: None)
    monkeypatch.setattr(search_planes, "sharpened", counted)
    found = find.find_paving(sight, photo.camera)
    assert isinstance(found, Paving)
    assert found.plain
    assert found.grid.shift == pytest.approx(0.5)
    assert asked == [1]
    asked.clear()
    monkeypatch.setattr(Paving, "plain", property(lambda _: False))
    again = find.find_paving(sight, photo.camera)
    assert isinstance(again, Paving)
    assert again.margin_nats == pytest.approx(found.margin_nats, abs=1.0)
    assert len(asked) == 2


def in_soft_light(photo: SyntheticPhoto) -> np.ndarray:
    return soft_light(gray_of(photo).astype(np.uint8), 45.0, np.random.default_rng(1))


def test_faint_joints_under_soft_light_are_plain_without_it():
    sight = see(in_soft_light(render_paving(FAINT)))
    R = FAINT.cam_from_ground.R
    seen = [best_combs_of(look, R) for look in (sight.looks.fine, sight.looks.unshaded)]
    spacing = 0.3 / float(FAINT.cam_from_ground.origin_in_a[2])
    shaded, clear = (min(combs[0].score for combs in families) for families in seen)
    assert clear > 2.0 * shaded
    assert [combs[0].spacing for combs in seen[1]] == pytest.approx([spacing, spacing], rel=0.01)


def best_combs_of(look: Look, R: np.ndarray) -> tuple[tuple[Comb, ...], tuple[Comb, ...]]:
    rectified = rectify(look.gradient, CAMERA, R, reach=near_reach(CAMERA, R), size=look.lines)
    assert rectified is not None
    return best_combs(rectified.x, local=True), best_combs(rectified.y, local=True)


@pytest.mark.slow
def test_a_floor_with_faint_joints_is_aligned_under_soft_light():
    gray = in_soft_light(render_paving(FAINT))
    found = align(gray, CAMERA, slab=FAINT.spacing_m).pose.cam_from_ground
    assert angle_up_to_quarter_turns(found, FAINT.cam_from_ground) < 0.05
