from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from paved import CAMERA, STACK

from autoreg.align import align
from autoreg.answer.full_resolution import measured_slabs
from autoreg.errors import Refusal
from autoreg.ground.points import project_ground
from autoreg.ground.sight import looks_at, see
from autoreg.image import as_gray
from autoreg.paving.bond import FALSE_ALARM_NATS
from autoreg.paving.lattice_evidence import Paving
from autoreg.paving.plane_combs import Hypothesis, PlaneCombs, comb_planes
from autoreg.rows.cross_joints import find_cross_joints, running_on
from autoreg.rows.rows import Rows, gaps_in_turn, lay_rows
from autoreg.search.find import find_paving
from autoreg.search.rows_on_planes import crossed, plain_alone
from autoreg.segments import Segments, detect_segments
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticPhoto

PX_PER_M, EXTENT_M = 160, 8.0
JOINT, SLAB = 70, 150


def seen_from_the_camera(top_view: np.ndarray) -> np.ndarray:
    """A picture of the ground as the stack photo's camera sees it; the origin is the top view's middle."""
    R, t = STACK.cam_from_ground.R, STACK.cam_from_ground.t
    half = 0.5 * top_view.shape[0] / PX_PER_M
    ground_from_px = np.array([[1 / PX_PER_M, 0, -half], [0, 1 / PX_PER_M, -half], [0, 0, 1]])
    K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    H = K @ np.column_stack([R[:, :2], t]) @ ground_from_px
    smooth = cv2.GaussianBlur(top_view, (0, 0), 1.0)
    return cv2.warpPerspective(smooth, H, (CAMERA.width, CAMERA.height), flags=cv2.INTER_AREA)


def blank() -> np.ndarray:
    rng = np.random.default_rng(0)
    size = int(EXTENT_M * PX_PER_M)
    return np.clip(rng.normal(SLAB, 4.0, (size, size)), 0, 255).astype(np.uint8)


def ashlar(
    across_m: float,
    lengths: tuple[float, float] = (0.7, 2.2),
    *,
    joint_px: int = 3,
    joint: int = JOINT,
    ground: np.ndarray | None = None,
) -> np.ndarray:
    """Unbroken joints at an even spacing, slabs of random length, in widths of a row, between them."""
    rng, picture = np.random.default_rng(1), blank() if ground is None else ground.copy()
    step, size = round(across_m * PX_PER_M), picture.shape[0]
    for y in range(0, size, step):
        picture[y : y + joint_px] = joint
        x = 0
        while x < size:
            picture[y : y + step, x : x + joint_px] = joint
            x += round(rng.uniform(*lengths) * step)
    return picture


def herringbone(across_m: float) -> np.ndarray:
    """Slabs twice as long as wide, laid in herringbone along the axes."""
    picture, step = blank(), round(across_m * PX_PER_M)
    count = picture.shape[0] // step + 2
    for i in range(-1, count):
        for j in range(-1, count):
            x, y = i * step, j * step
            if (i + j) % 4 == 0:
                cv2.rectangle(picture, (x, y), (x + 2 * step, y + step), JOINT, 3)
            if (i + j) % 4 == 2:
                cv2.rectangle(picture, (x, y), (x + step, y + 2 * step), JOINT, 3)
    return picture


def rows_in(picture: np.ndarray) -> tuple[Rows | None, PlaneCombs, Segments]:
    looks, segments = looks_at(picture), detect_segments(picture)
    planes = comb_planes(looks, segments, [(CAMERA, STACK.cam_from_ground.R)], free_focal=False)
    return lay_rows(looks.picture, planes[0], segments, (CAMERA.width, CAMERA.height)), planes[0], segments


@pytest.fixture(scope="module")
def ashlar_rows() -> Rows:
    rows, _, _ = rows_in(seen_from_the_camera(ashlar(0.3)))
    assert rows is not None
    return rows


def test_random_ashlar_tells_the_spacing_of_its_unbroken_joints_and_the_ground(ashlar_rows: Rows):
    assert ashlar_rows.margin_nats > 0
    fit = ashlar_rows.paving.fit
    height = float(fit.cam_from_ground.origin_in_a[2])
    assert fit.grid.spacing_x is None
    assert fit.grid.spacing_y / height == pytest.approx(0.3 / 1.6, rel=0.01)
    up = float(fit.cam_from_ground.R[:, 2] @ STACK.cam_from_ground.R[:, 2])
    assert np.rad2deg(np.arccos(np.clip(up, -1, 1))) < 0.5


@pytest.mark.parametrize("joint", [100, 190])
def test_rows_between_joints_as_wide_as_a_quarter_of_them_are_found_by_both_edges(joint: int):
    # Of smooth slabs a narrow strip along one edge fits as well; the other edge spoke against it.
    smooth = np.full_like(blank(), SLAB)
    rows, _, _ = rows_in(seen_from_the_camera(ashlar(0.3, joint_px=12, joint=joint, ground=smooth)))
    assert rows is not None
    assert rows.margin_nats > 0
    fit = rows.paving.fit
    assert fit.strip.width[0] == pytest.approx(0.25 * fit.grid.spacing_y, rel=0.15)
    assert fit.strip.polarity[0] == np.sign(joint - SLAB)
    up = float(fit.cam_from_ground.R[:, 2] @ STACK.cam_from_ground.R[:, 2])
    assert np.rad2deg(np.arccos(np.clip(up, -1, 1))) < 0.1


def test_all_rows_in_view_are_evidence_for_them(ashlar_rows: Rows):
    paving = ashlar_rows.paving
    lines = len(np.unique(paving.presence.inside(paving.presence.field).sides.line))
    # Plain to see, each joint counts as much as so many sides that hardly any control exceeds.
    assert paving.evidence_nats[0] > 6.0 * lines


def test_the_crossing_to_start_from_lies_on_an_unbroken_joint(ashlar_rows: Rows):
    line = ashlar_rows.crossing[1] / ashlar_rows.paving.grid.spacing_y
    assert line == pytest.approx(round(line), abs=1e-9)


def test_unbroken_joints_without_cross_joints_are_no_rows():
    boards = blank()
    step = round(0.3 * PX_PER_M)
    for y in range(0, boards.shape[0], step):
        boards[y : y + 3] = JOINT
    rows, _, _ = rows_in(seen_from_the_camera(boards))
    assert rows is None or rows.margin_nats < 0


def test_pieces_of_lines_that_run_on_through_several_rows_are_no_cross_joints(ashlar_rows: Rows):
    fit, field = ashlar_rows.paving.fit, ashlar_rows.paving.presence.field
    across = fit.grid.spacing_y
    rows = across * (np.round(field[:, 1].mean() / across) + np.arange(-1, 2) + 0.5)

    def evidence(place: np.ndarray) -> float:
        middle = np.stack([field[:, 0].mean() + across * place, np.tile(rows, len(place) // len(rows))], 1)
        square, aslant = np.array([[0.0, -1.0], [0.0, 1.0]]), np.array([[-0.7, -0.7], [0.7, 0.7]])
        ends = np.concatenate([middle[:, None] + 0.35 * across * way for way in (square, aslant)])
        px = project_ground(fit.camera, fit.cam_from_ground, ends.reshape(-1, 2)).reshape(-1, 2, 2)
        seen = Segments(px, np.full(len(px), 0.1), np.zeros(len(px), int))
        return find_cross_joints(seen, fit, field, (fit.camera.width, fit.camera.height)).evidence_nats

    assert evidence(np.array([-1.5, -0.2, 1.1, 2.0, -0.8, 0.5])) > FALSE_ALARM_NATS
    # The mirror image of a window's bars on boards without any cross joints.
    assert evidence(np.array([-1.0, -1.1, -0.95, 1.0, 0.9, 1.05])) < FALSE_ALARM_NATS


def test_segments_run_on_from_those_of_the_row_before_that_are_close_to_their_place():
    middle = np.array([[0.5, 0.5], [0.6, 1.4], [0.55, 2.5], [5.0, 0.5], [5.6, 1.5], [9.0, 0.5], [9.0, 2.5]])
    assert running_on(middle).tolist() == [False, True, True, False, False, False, False]
    assert running_on(-middle[::-1]).tolist() == [False, False, False, False, False, True, True]
    assert running_on(np.zeros((0, 2))).tolist() == []


def test_rows_whose_cross_joints_may_be_chance_are_refused_as_one_direction(
    ashlar_rows: Rows, monkeypatch: pytest.MonkeyPatch
):
    evidence = (60.0, 0.5)
    hardly = replace(ashlar_rows, paving=replace(ashlar_rows.paving, evidence_nats=evidence))
    monkeypatch.setattr("autoreg.search.rows_on_planes.lay_rows", lambda *_: hardly)
    monkeypatch.setattr("autoreg.search.glance.lay_combs", lambda *_: None)
    monkeypatch.setattr("autoreg.search.find.lay_lattice", lambda *_, **__: ())
    monkeypatch.setattr("autoreg.search.find._Search.further", lambda *_, **__: ())
    with pytest.raises(Refusal) as refused:
        find_paving(see(seen_from_the_camera(ashlar(0.3))), CAMERA)
    refusal = refused.value
    assert (refusal.code, refusal.measured) == ("one_direction", min(evidence))
    assert refusal.limit == pytest.approx(FALSE_ALARM_NATS, abs=0.01)


@pytest.fixture
def no_lattice_is_found(monkeypatch: pytest.MonkeyPatch):
    """As if lattices had been looked for on the clearest grounds, which takes long, in vain."""

    def clearest(search: Any, best: tuple[Paving, ...]) -> tuple[tuple[Paving, ...], list[PlaneCombs]]:
        free = search.free.focal
        return best, comb_planes(search.looks, search.segments, search.hypotheses, free_focal=free)[:2]

    monkeypatch.setattr("autoreg.search.glance.lay_combs", lambda *_: None)
    monkeypatch.setattr("autoreg.search.find._Search.clearest", clearest)


@pytest.mark.usefixtures("no_lattice_is_found")
def test_no_ground_is_turned_about_rows_whose_cross_joints_are_plain(monkeypatch: pytest.MonkeyPatch):
    def turned_about(*_: object, **__: object) -> list[Hypothesis]:
        raise AssertionError

    monkeypatch.setattr("autoreg.search.find.plain_alone", lambda _: False)
    monkeypatch.setattr("autoreg.search.find._Search.strongest", lambda *_: ((), []))
    monkeypatch.setattr("autoreg.search.find.hypothesised_thoroughly", lambda *_, **__: [])
    monkeypatch.setattr("autoreg.search.find.hypothesised_along_grain", turned_about)
    assert isinstance(find_paving(see(seen_from_the_camera(ashlar(0.3))), CAMERA), Rows)


@pytest.mark.usefixtures("no_lattice_is_found")
def test_no_lattice_is_looked_for_elsewhere_where_rows_are_plain(monkeypatch: pytest.MonkeyPatch):
    def elsewhere(*_: object, **__: object) -> tuple[tuple[Paving, ...], list[PlaneCombs]]:
        raise AssertionError

    monkeypatch.setattr("autoreg.search.find.plain_alone", lambda _: True)
    monkeypatch.setattr("autoreg.search.find._Search.strongest", elsewhere)
    sight = see(seen_from_the_camera(ashlar(0.3)))
    assert isinstance(find_paving(sight, CAMERA), Rows)
    # By a focal length that is not known, a lattice may look like rows.
    with pytest.raises(AssertionError):
        find_paving(sight, None)


@pytest.mark.parametrize(
    ("evidence", "in_columns", "plain"),
    [((60.0, 45.0), False, True), ((60.0, 35.0), False, False), ((60.0, 45.0), True, False)],
)
def test_rows_are_plain_unless_their_cross_joints_lie_in_columns(
    ashlar_rows: Rows, evidence: tuple[float, float], in_columns: bool, plain: bool
):
    assert not plain_alone([])
    rows = SimpleNamespace(
        in_columns=in_columns,
        margin_nats=50.0,
        paving=replace(ashlar_rows.paving, evidence_nats=evidence),
    )
    assert plain_alone([(cast(Rows, rows), PlaneCombs(CAMERA, STACK.cam_from_ground.R, (), ()))]) == plain


@pytest.mark.parametrize(
    ("evidence", "plain"), [((60.0, 45.0), True), ((60.0, 35.0), False), ((9.0, 45.0), False)]
)
def test_cross_joints_are_plain_only_between_rows_that_are_there(
    ashlar_rows: Rows, evidence: tuple[float, float], plain: bool
):
    rows = replace(ashlar_rows, paving=replace(ashlar_rows.paving, evidence_nats=evidence))
    assert crossed([(rows, PlaneCombs(CAMERA, STACK.cam_from_ground.R, (), ()))]) == plain


def test_joints_that_break_off_regularly_are_herringbone_and_no_rows():
    rows, _, _ = rows_in(seen_from_the_camera(herringbone(0.3)))
    assert rows is None or rows.margin_nats < 0


def pieces_of_faint_joints(gaps: bool, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half slabs of joints hardly above the noise: piece, line and p-value; with herringbone's gaps, or not.

    A gap of one slab hides one piece in eight, and a good part of the next.
    """
    rng = np.random.default_rng(seed)
    line, piece = (axis.ravel() for axis in np.mgrid[0:12, 0:40])
    p = rng.uniform(size=len(piece)) ** 6
    place = (piece - 2 * line) % 8
    hidden = (place == 6) | ((place == 7) & (rng.uniform(size=len(piece)) < 0.5))
    return piece, line, np.where(gaps & hidden, rng.uniform(high=0.9, size=len(piece)), p)


@pytest.mark.parametrize("seed", range(8))
def test_gaps_in_turn_are_told_from_joints_that_noise_hides_here_and_there(seed: int):
    assert gaps_in_turn(*pieces_of_faint_joints(True, seed))
    assert not gaps_in_turn(*pieces_of_faint_joints(False, seed))


@pytest.fixture
def a_lattice_comes_first(stack_photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch):
    """Whatever the photo, the search comes up with the lattice of another one."""
    other = find_paving(see(as_gray(stack_photo.pixels)), CAMERA)
    monkeypatch.setattr("autoreg.laying.find_paving", lambda *_, **__: other)


@pytest.mark.slow
@pytest.mark.usefixtures("a_lattice_comes_first")
def test_what_is_no_lattice_at_full_resolution_may_be_rows():
    alignment = align(seen_from_the_camera(ashlar(0.3)), CAMERA, camera_height=1.6)
    assert alignment.lattice.kind == "rows"
    assert alignment.lattice.spacing_y == pytest.approx(0.3, rel=0.01)
    up, true_up = (pose.R[:, 2] for pose in (alignment.pose.cam_from_ground, STACK.cam_from_ground))
    assert np.rad2deg(np.arccos(np.clip(up @ true_up, -1, 1))) < 0.2


@pytest.mark.slow
def test_rows_that_do_no_better_than_chance_by_the_camera_they_lead_to_are_refused(
    monkeypatch: pytest.MonkeyPatch,
):
    photo = seen_from_the_camera(ashlar(0.3))
    monkeypatch.setattr("autoreg.answer.full_resolution.line_evidence", lambda *_: (16.0, 0.0))
    with pytest.raises(Refusal) as refused:
        align(photo, CAMERA, camera_height=1.6)
    assert refused.value.code == "no_lattice"


def test_a_lattice_that_cannot_be_measured_at_full_resolution_is_refused_for_that(
    stack_photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch
):
    sight = see(as_gray(stack_photo.pixels))
    found = find_paving(sight, CAMERA)
    assert isinstance(found, Paving)
    monkeypatch.setattr("autoreg.answer.full_resolution.refine_until_still", lambda *_, **__: None)
    with pytest.raises(Refusal) as refused:
        measured_slabs(sight, as_gray(stack_photo.pixels).astype(np.float32), found, Free(), None)
    assert (refused.value.code, refused.value.measured) == ("no_lattice", None)
    assert "cannot be measured" in refused.value.message


@pytest.mark.usefixtures("a_lattice_comes_first")
def test_what_is_neither_lattice_nor_rows_is_refused_as_no_lattice(gravel_photo: SyntheticPhoto):
    with pytest.raises(Refusal) as refused:
        align(gravel_photo.pixels, gravel_photo.camera)
    assert refused.value.code == "no_lattice"
