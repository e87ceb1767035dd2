from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import GRAVEL, HALF_BOND, STACK, THIRD_BOND

from autoreg.ground.rectify import near_reach, picture_gradient, rectify
from autoreg.paving.bond import (
    BondHypothesis,
    Courses,
    best_bonds,
    bond_hypotheses,
    bond_of_places,
    course_support,
)
from autoreg.paving.periods import PHASES, Comb
from autoreg.synthetic import SyntheticPhoto, SyntheticScene, render_paving

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
OFFSET = 0.01 * np.arange(400)


def made_courses(
    spacing: float, phase: float, shift: float, count: int = 6, *, missing: float = 0.0
) -> Courses:
    """Courses whose cross joints are certain where they are, and slabs speak a little against one."""
    rng = np.random.default_rng(0)
    llr = np.full((count, len(OFFSET)), -0.3)
    for k in range(count):
        x = np.arange(-10, 60) * spacing + phase + k * shift * spacing
        row = np.round(x[(x > 0) & (x < OFFSET[-1])] / 0.01).astype(int)
        row = row[rng.uniform(size=len(row)) >= missing]
        llr[k, np.clip(row[:, None] + [-1, 0, 1], 0, len(OFFSET) - 1)] = 3.0
    return Courses(np.arange(count, dtype=float), llr, np.ones(llr.shape, bool), llr)


@pytest.mark.parametrize("shift", [0.0, 1 / 2, 1 / 3, 2 / 3, 1 / 4])
@pytest.mark.parametrize("missing", [0.0, 0.25])
def test_the_shift_and_phase_of_a_bond_are_found(shift: float, missing: float):
    courses = made_courses(0.6, 0.17, shift, missing=missing)
    score, phase, found = best_bonds(courses, OFFSET, np.array([0.6]))[0]
    assert score > 0
    assert abs((found - shift + 0.5) % 1.0 - 0.5) <= 1.0 / PHASES
    assert abs((phase - 0.17 + 0.3) % 0.6 - 0.3) <= 1.5 * 0.6 / PHASES


@pytest.mark.parametrize("shift", [0.0, 1 / 2, 1 / 3])
def test_neither_half_nor_twice_the_spacing_wins(shift: float):
    scores = best_bonds(made_courses(0.6, 0.17, shift), OFFSET, np.array([0.3, 0.6, 1.2]))[:, 0]
    assert scores.argmax() == 1


def test_without_courses_no_spacing_has_a_score():
    none = Courses(np.zeros(0), np.zeros((0, 400)), np.zeros((0, 400), bool), np.zeros((0, 400)))
    assert np.isneginf(best_bonds(none, OFFSET, np.array([0.3, 0.6]))[:, 0]).all()


def hypotheses(photo: SyntheticPhoto, R: np.ndarray):
    picture = photo.pixels.mean(-1)
    rectified = rectify(picture_gradient(picture), photo.camera, R, reach=near_reach(photo.camera, R))
    assert rectified is not None
    return bond_hypotheses(rectified)


SCENES = [STACK, HALF_BOND, THIRD_BOND, replace(HALF_BOND, shift=1 / 4, spacing_m=(0.5, 0.3))]


@pytest.mark.parametrize("scene", SCENES, ids=["stack", "half", "third", "quarter"])
def test_the_bond_of_a_photo_is_among_the_first_hypotheses(scene: SyntheticScene):
    photo = render_paving(scene)
    height = scene.cam_from_ground.origin_in_a[2]
    eye = scene.cam_from_ground.origin_in_a[:2]
    first = hypotheses(photo, photo.cam_from_ground.R)[:2]
    assert first[0].grid.shift == pytest.approx(scene.shift, abs=0.01)

    def misses(bond: BondHypothesis) -> tuple[float, ...]:
        """Relative errors of the spacings and, in slabs, of the origin against the nearest drawn crossing."""
        grid, (a, b) = bond.grid, scene.spacing_m
        assert grid.spacing_x is not None
        found = (grid.spacing_y, grid.spacing_x) if bond.turned else (grid.spacing_x, grid.spacing_y)
        x, y = bond.origin * height + eye
        row = y / b
        column = x / a - round(row) * scene.shift
        ratios = (found[0] * height / a - 1, found[1] * height / b - 1)
        return (*ratios, row - round(row), column - round(column))

    assert min(np.abs(misses(bond)).max() for bond in first) < 0.06


def test_a_bond_seen_from_its_side_is_turned(half_photo: SyntheticPhoto):
    best = hypotheses(half_photo, half_photo.cam_from_ground.R @ QUARTER)[0]
    height = HALF_BOND.cam_from_ground.origin_in_a[2]
    assert best.turned
    assert best.grid.shift == pytest.approx(0.5)
    assert best.grid.spacing_x == pytest.approx(0.6 / height, rel=0.03)
    assert best.grid.spacing_y == pytest.approx(0.3 / height, rel=0.03)


def test_gravel_has_no_bond_worth_a_brick_laid_one(gravel_photo: SyntheticPhoto, half_photo: SyntheticPhoto):
    chance = hypotheses(gravel_photo, GRAVEL.cam_from_ground.R)
    laid = hypotheses(half_photo, HALF_BOND.cam_from_ground.R)
    assert not chance or chance[0].score < 0.3 * laid[0].score


def test_hypotheses_come_best_first(half_photo: SyntheticPhoto):
    scores = [h.score for h in hypotheses(half_photo, half_photo.cam_from_ground.R)]
    assert len(scores) > 1
    assert scores == sorted(scores, reverse=True)


def test_courses_lie_between_the_unbroken_joints(half_photo: SyntheticPhoto):
    camera, R = half_photo.camera, half_photo.cam_from_ground.R
    rectified = rectify(picture_gradient(half_photo.pixels.mean(-1)), camera, R, reach=near_reach(camera, R))
    assert rectified is not None
    eye = half_photo.cam_from_ground.origin_in_a
    b = 0.3 / eye[2]
    courses = course_support(rectified.y, Comb(b, float(-eye[1] / eye[2] % b), 0.0))
    assert len(courses.index) >= 3
    # A cross joint of one course is none of its neighbour's: in half bond they alternate.
    step = 0.6 / eye[2]
    first = round(float((eye[1] / eye[2] + (-eye[1] / eye[2] % b)) / b))
    strength: tuple[list[float], list[float]] = ([], [])
    for course, z, seen in zip(courses.index, courses.z, courses.seen, strict=True):
        own = (np.arange(-20, 20) + 0.5 * (course + first)) * step - eye[0] / eye[2]
        for kind, places in enumerate((own, own + 0.5 * step)):
            at = np.searchsorted(rectified.y.offset, places)
            at = at[(at > 1) & (at < len(z) - 2)]
            strength[kind].extend(z[at[seen[at], None] + np.arange(-2, 2)].max(1))
    assert len(strength[0]) > 8
    assert np.median(strength[0]) > 3.0 * max(float(np.median(strength[1])), 1.0)


def made_places(
    shift: float, *, seen: float, jitter: float = 0.01, stray: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Places and courses of some cross joints of 0.5 x 0.2 slabs, the first at 0.13, and of strays."""
    rng = np.random.default_rng(7)
    course, column = (v.ravel() for v in np.meshgrid(np.arange(-3, 15), np.arange(-6, 7)))
    kept = rng.uniform(size=len(course)) < seen
    course, column = course[kept], column[kept]
    along = 0.13 + 0.5 * (column + shift * course) + jitter * rng.standard_normal(len(course))
    inside = np.abs(along) < 2.5
    strays = rng.uniform(-2.5, 2.5, stray), rng.integers(-3, 15, stray)
    return np.r_[along[inside], strays[0]], np.r_[course[inside], strays[1]]


@pytest.mark.parametrize("shift", [0.0, 1 / 4, 1 / 3, 1 / 2, 3 / 4])
@pytest.mark.parametrize(("seen", "stray"), [(1.0, 0), (0.3, 0), (0.5, 40)])
def test_a_few_places_of_cross_joints_tell_their_bond(shift: float, seen: float, stray: int):
    found = bond_of_places(*made_places(shift, seen=seen, stray=stray), 0.2)
    assert found is not None
    grid, phase = found
    assert grid.spacing_x == pytest.approx(0.5, rel=0.02)
    assert grid.spacing_y == 0.2
    assert abs((grid.shift - shift + 0.5) % 1.0 - 0.5) < 0.011
    # Course 0's joints near the middle of the places are where they ought to be.
    assert abs((phase - 0.13 + 0.25) % 0.5 - 0.25) < 0.05


@pytest.mark.parametrize("seed", range(8))
def test_places_without_a_law_tell_no_bond(seed: int):
    rng = np.random.default_rng(seed)
    assert bond_of_places(rng.uniform(-2.5, 2.5, 80), rng.integers(0, 15, 80), 0.2) is None


def test_no_places_or_all_at_one_tell_no_bond():
    assert bond_of_places(np.zeros(0), np.zeros(0, int), 0.2) is None
    assert bond_of_places(np.full(9, 0.3), np.arange(9), 0.2) is None
