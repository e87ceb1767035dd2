from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from paved import STACK, fit_of, gray_of

from autoreg.align import align
from autoreg.answer.camera_refusals import (
    camera_contradicted,
    contradicted_with_slab,
    focal_untold,
    leaning,
)
from autoreg.answer.pattern_refusals import askew
from autoreg.answer.refusals import FEW_SIDES, FRONTAL_DEG, ambiguous, hardly_met, maybe_wall, no_lattice
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.ground.sides import Grid
from autoreg.paving.bond import FALSE_ALARM_NATS
from autoreg.paving.lattice_evidence import TESTED_NATS, Paving
from autoreg.paving.side_support import presence_of
from autoreg.rows.cross_joints import Lean
from autoreg.rows.turning_stones import Directions
from autoreg.synthetic import SyntheticPhoto, look_at_ground


@pytest.fixture(scope="module")
def paving(stack_photo: SyntheticPhoto) -> Paving:
    fit = fit_of(stack_photo)
    return Paving(fit, presence_of(gray_of(stack_photo), fit), (1.0, 1.0))


def test_nothing_found_is_no_lattice():
    refusal = no_lattice(None, None)
    assert (refusal.code, refusal.measured) == ("no_lattice", 0.0)
    assert refusal.limit == pytest.approx(TESTED_NATS + FALSE_ALARM_NATS, abs=0.01)


@pytest.mark.parametrize(
    ("crossing", "told"), [((0.6, 0.3), True), ((0.3, 0.1), False), ((0.75, 0.05), False)]
)
def test_joints_at_right_angles_without_an_even_spacing_are_told_of(
    crossing: tuple[float, float], told: bool
):
    refusal = no_lattice(None, None, crossing=crossing)
    assert (refusal.code, refusal.measured) == ("no_lattice", 0.0)
    assert ("90 % of the edges" in refusal.message and "several sizes" in refusal.message) == told
    assert ("better than chance" in refusal.message) != told


def test_evidence_in_one_family_alone_is_one_direction(paving: Paving):
    refusal = no_lattice(replace(paving, evidence_nats=(60.0, 2.0)), None)
    assert (refusal.code, refusal.measured) == ("one_direction", 2.0)
    assert "both directions" in refusal.message


def test_a_few_clear_sides_are_too_few(paving: Paving):
    few = paving.presence.nearest((FEW_SIDES - 2) / len(paving.presence.p))
    refusal = no_lattice(replace(paving, presence=few, evidence_nats=(11.0, 11.0)), None)
    assert refusal.code == "too_few_joints"
    assert str(len(few.p)) in refusal.message


@pytest.mark.parametrize(
    ("margin_nats", "missed", "doubted"),
    [(3.0, 0.4, True), (3.0, 0.25, False), (14.0, 0.6, False)],
)
def test_a_lattice_hardly_better_than_chance_may_not_miss_most_of_its_joints(
    paving: Paving, margin_nats: float, missed: float, doubted: bool
):
    evidence = 0.5 * (TESTED_NATS + FALSE_ALARM_NATS + margin_nats)
    refusal = hardly_met(replace(paving, evidence_nats=(evidence, evidence)), missed)
    assert (refusal is not None) == doubted
    if refusal is not None:
        assert (refusal.code, refusal.measured) == ("no_lattice", missed)
        assert "40 % of its joints" in refusal.message


def test_a_lattice_that_is_found_is_asked_whether_its_joints_are_met(
    stack_photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("autoreg.answer.refusals.DOUBTFUL_NATS", np.inf)
    monkeypatch.setattr("autoreg.answer.refusals.MOST_OF_DOUBTFUL", -1.0)
    # Its joints in one direction would be taken for rows.
    monkeypatch.setattr("autoreg.laying.find_rows", lambda *_: None)
    with pytest.raises(Refusal, match="are not there"):
        align(stack_photo.pixels, STACK.camera)


def test_an_ambiguous_photo_names_both_lattices(paving: Paving):
    a, b = STACK.spacing_m
    other = replace(paving, fit=replace(paving.fit, grid=Grid(2 * a, b, 0.5)))
    refusal = ambiguous(paving, other)
    assert refusal.code == "ambiguous"
    assert "stack bond of" in refusal.message
    assert "running bond with shift 0.50" in refusal.message


@pytest.mark.parametrize(("told_ratio", "blamed"), [(1.8, True), (4.0, False)])
def test_a_camera_is_blamed_for_slabs_of_other_sides_if_its_focal_length_may_be_the_reason(
    paving: Paving, told_ratio: float, blamed: bool
):
    fit = paving.fit
    refusal = contradicted_with_slab(fit, (told_ratio, 1.0), 1.2 * fit.camera.fx)
    assert fit.grid.ratio == pytest.approx(1.5, rel=0.01)
    assert (refusal is not None) == blamed
    if refusal is not None:
        assert refusal.code == "camera_contradicted"
        assert "1.500" in refusal.message
        assert "1.800" in refusal.message


@pytest.mark.parametrize(("given", "seen", "blamed"), [(1000.0, 1030.0, False), (1000.0, 1200.0, True)])
def test_a_camera_is_blamed_for_another_focal_length(given: float, seen: float, blamed: bool):
    refusal = camera_contradicted(Camera.from_focal(800, 600, given), seen)
    assert (refusal is not None) == blamed
    if refusal is not None:
        assert refusal.code == "camera_contradicted"
        assert np.isclose([refusal.measured or 0.0, refusal.limit or 0.0], [seen, given]).all()


@pytest.mark.parametrize(("off_px", "blamed"), [(10.0, False), (80.0, True)])
def test_a_camera_is_blamed_for_a_principal_point_far_off_the_middle(off_px: float, blamed: bool):
    camera = replace(Camera.from_focal(800, 600, 1000.0), cx=399.5 - off_px)
    refusal = camera_contradicted(camera, 1010.0)
    assert (refusal is not None) == blamed
    if refusal is not None:
        assert refusal.code == "camera_contradicted"
        assert refusal.measured == pytest.approx(off_px / 800)
        assert "--crop" in refusal.message


@pytest.mark.parametrize(
    ("pitch", "heading", "shift", "refused"),
    [(80.0, 1.0, 0.5, True), (80.0, 20.0, 0.5, False), (55.0, 1.0, 0.5, False), (80.0, 1.0, 0.0, False)],
)
def test_level_courses_seen_from_the_front_may_be_a_wall(
    paving: Paving, pitch: float, heading: float, shift: float, refused: bool
):
    pose = look_at_ground(pitch_deg=pitch, height_m=1.6, heading_deg=heading)
    refusal = maybe_wall(replace(paving.fit, cam_from_ground=pose, grid=Grid(0.2, 0.1, shift)))
    assert (refusal is not None) == refused
    if refusal is not None:
        assert refusal.code == "not_ground"
        assert "wall" in refusal.message


@pytest.mark.parametrize(("sigma_deg", "refused"), [(0.5, False), (3.0, True)])
def test_courses_that_are_seen_from_the_front_as_likely_as_not_may_be_those_of_a_wall(
    paving: Paving, sigma_deg: float, refused: bool
):
    pose = look_at_ground(pitch_deg=90.0 - FRONTAL_DEG - 3.0, height_m=1.6, heading_deg=0.0)
    fit = replace(paving.fit, cam_from_ground=pose, grid=Grid(0.2, 0.1, 0.5))
    # Turned about the view or sideways, courses are as much aslant as before.
    sigmas = np.radians([sigma_deg, 20.0, 20.0])
    covariance = np.diag([*sigmas**2, 1.0, 1.0, 1.0])
    assert maybe_wall(fit) is None
    assert (maybe_wall(fit, covariance) is not None) == refused


@pytest.mark.parametrize("kind", ["rows", "slabs"])
@pytest.mark.parametrize("told", [True, False])
def test_paving_that_leaves_the_focal_length_open_says_how_far_and_asks_for_the_camera(kind, told):
    refusal = focal_untold(kind, 1234.0 if told else None, 0.213 if told else np.inf, 0.05)
    assert (refusal.code, refusal.measured, refusal.limit) == ("ambiguous", 0.213 if told else None, 0.05)
    assert "--camera" in refusal.message
    assert ("21 %" in refusal.message) == told
    assert ("1234 px" in refusal.message) == told
    assert ("rows" in refusal.message) == (kind == "rows")
    assert "--slab" not in refusal.message


def test_a_focal_length_that_is_left_open_may_be_told_by_a_slab():
    assert "--slab" in focal_untold("slabs", 1970.0, 0.26, 0.25, slab_helps=True).message


@pytest.mark.parametrize(("degrees", "sigma_deg"), [(1.3, 0.1), (8.0, 3.0)])
def test_joints_that_lean_little_or_unsurely_are_not_refused(degrees: float, sigma_deg: float):
    lean = Lean(*np.radians([-degrees, sigma_deg]))
    assert leaning(lean, Camera.from_focal(800, 600, 700.0), "file") is None


@pytest.mark.parametrize(
    ("source", "code", "word"),
    [
        ("file", "camera_contradicted", "this camera"),
        ("exif", "camera_contradicted", "EXIF"),
        ("photo", "no_lattice", "every focal length"),
    ],
)
def test_joints_that_lean_together_blame_whoever_told_the_focal_length(
    source: Literal["file", "exif", "photo"], code: str, word: str
):
    refusal = leaning(Lean(*np.radians([-6.97, 0.02])), Camera.from_focal(800, 600, 700.0), source)
    assert refusal is not None
    assert (refusal.code, refusal.measured) == (code, 6.97)
    assert word in refusal.message


def test_joints_of_which_many_run_along_the_lattice_are_not_askew_for_what_is_strewn_over_them():
    def scattered(along: float) -> Directions:
        return Directions(0.0, np.radians(9.0), along, 120, np.radians(6.0), np.radians(5.0), 0.5)

    refusal = askew((scattered(0.15), scattered(0.15)))
    assert refusal is not None
    assert refusal.measured == pytest.approx(9.0)
    assert askew((scattered(0.15), scattered(0.4))) is None
    assert askew((scattered(0.15), None)) is None
