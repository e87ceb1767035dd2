from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_sides import made_presence, presence_with
from paved import CAMERA, STACK, fit_of, gray_of

from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid, nearest_rotation
from autoreg.ground.ground_frame import with_origin
from autoreg.ground.points import inside_convex, on_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid, slab_sides
from autoreg.joints.joint_looks import Strip
from autoreg.paving.lattice_choice import BETWEEN
from autoreg.paving.lattice_evidence import line_evidence
from autoreg.paving.presence import GROUND_COST, Presence, p_llr
from autoreg.paving.side_support import CLOSE, PAIRED_COST, looked_at_closer, presence_of
from autoreg.synthetic import SyntheticPhoto, SyntheticScene, look_at_ground, render_paving
from benchmarks.suites.robust import square_seen

DARK = Strip((0.01, 0.01), 0.8, (-1, -1))


class Laid(NamedTuple):
    camera: Camera
    cam_from_ground: Rigid
    grid: Grid
    strip: Strip = DARK


def presence_in(photo: SyntheticPhoto, grid: Grid, strip: Strip = DARK) -> Presence:
    return presence_of(gray_of(photo), Laid(photo.camera, photo.cam_from_ground, grid, strip))


def test_the_sides_of_the_photographed_lattice_are_there(stack_photo: SyntheticPhoto):
    presence = presence_in(stack_photo, Grid(0.6, 0.4))
    assert len(presence.p) > 60
    for family in (ALONG_X, ALONG_Y):
        assert np.mean(presence.p[presence.sides.family == family] < 0.1) > 0.9


def test_the_sides_that_a_lattice_too_fine_puts_between_the_joints_are_not(stack_photo: SyntheticPhoto):
    presence = presence_in(stack_photo, Grid(0.3, 0.4))
    columns = presence.sides.family == ALONG_Y
    odd = columns & (presence.sides.line % 2 == 1)
    assert np.median(presence.p[columns & ~odd]) < 0.05
    assert np.median(presence.p[odd]) > 0.3


def test_on_gravel_the_p_values_are_uniform(gravel_photo: SyntheticPhoto):
    p = presence_in(gravel_photo, Grid(0.37, 0.31), replace(DARK, polarity=(0, 0))).p
    assert len(p) > 150
    for level in (0.1, 0.3, 0.5, 0.8):
        # Sides beside one another see the same stones, so that the spread is wider than a binomial's.
        assert np.mean(p <= level) == pytest.approx(level, abs=0.1)


def test_sides_with_a_light_line_beside_a_dark_one_are_there():
    # A light bed, and on its far side the wall in the shade.
    scene = SyntheticScene(kind="gravel", noise_grey=0.0)
    u, v = np.meshgrid(np.arange(scene.camera.width), np.arange(scene.camera.height))
    ground = on_ground(np.stack([u, v], -1).astype(float), scene.camera, scene.cam_from_ground)
    rng = np.random.default_rng(3)
    slabs = 110.0 + 36.0 * cv2.GaussianBlur(rng.normal(size=u.shape), (0, 0), 1.0)
    joints, away = np.zeros(u.shape), (ground[..., 1] / 0.4 + 0.5) % 1.0 - 0.5
    joints[(away > -0.02) & (away <= 0.0)] = 45.0
    joints[(away > 0.0) & (away < 0.02)] = -45.0
    picture = cv2.GaussianBlur((slabs + joints).astype(np.float32), (0, 0), 0.8)
    laid = Laid(scene.camera, scene.cam_from_ground, Grid(0.6, 0.4), Strip((0.016, 0.016), 0.8, (0, 0)))
    presence = presence_of(picture, laid, paired=True)
    along, across = (presence.p[presence.sides.family == family] for family in (ALONG_X, ALONG_Y))
    # As steps, or strips of one tone, a quarter of them are.
    assert np.mean(along < 0.1) > 0.6
    assert np.mean(across < 0.1) < 0.25
    # One of the families is found to look so, which has its price.
    assert presence.looks_nats == pytest.approx(PAIRED_COST)
    assert presence_of(picture, laid).looks_nats == 0.0
    assert presence_of(picture, laid._replace(strip=DARK), paired=True).looks_nats == 0.0


def test_a_joint_of_the_other_tone_is_not_there(stack_photo: SyntheticPhoto):
    light = presence_in(stack_photo, Grid(0.6, 0.4), replace(DARK, polarity=(1, 1)))
    assert np.mean(light.p < 0.1) < 0.3


def test_a_camera_that_looks_at_the_sky_sees_no_side():
    up = look_at_ground(pitch_deg=-40.0, height_m=1.6)
    flat = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    assert len(presence_of(flat, Laid(CAMERA, up, Grid(0.4, 0.4))).p) == 0


@pytest.mark.parametrize("missed", [0.1, 0.4, 0.7])
def test_chance_is_worth_one_on_average(missed: float):
    # The substitution p = q^5 takes out the density's pole at zero.
    q = np.linspace(1e-6, 1.0, 200_001)
    assert np.trapezoid(np.exp(p_llr(q**5, missed)) * 5 * q**4, q) == pytest.approx(1.0, abs=1e-3)


@given(st.floats(1e-4, 1.0), st.floats(1e-4, 1.0))
@settings(deadline=None, derandomize=True, max_examples=40)
def test_a_smaller_p_value_speaks_more_for_a_side(p: float, q: float):
    low, high = p_llr(np.array([max(p, q), min(p, q)]), 0.25)
    assert low <= high


def test_places_behind_the_camera_are_no_evidence():
    # A wide lens rolled over long slabs: beside some sides at the rim lies what it cannot see.
    camera = Camera(948, 632, 374.5, 374.5, 473.5, 315.5, (-0.0842, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    R = nearest_rotation(
        np.array(
            [[0.96533, 0.22682, -0.12918], [-0.09928, -0.13866, -0.98535], [-0.24141, 0.96402, -0.11133]]
        )
    )
    strip = Strip((0.0346, 0.0162), 0.53, (0, -1))
    seen = Laid(camera, Rigid(R, np.array([1.261, 1.3305, -1.592])), Grid(4.3063, 1.0708), strip)
    picture = np.random.default_rng(0).normal(120.0, 20.0, (632, 948)).astype(np.float32)
    presence = presence_of(picture, seen, BETWEEN, only=ALONG_Y)
    assert len(presence.p) > 20
    assert np.isfinite(presence.p).all()
    assert presence.p.min() > 0.001


def test_the_nearest_share_is_that_of_the_largest_sides(stack_photo: SyntheticPhoto):
    presence = presence_in(stack_photo, Grid(0.6, 0.4))
    near = presence.nearest(0.25)
    assert len(near.p) == round(0.25 * len(presence.p))
    assert near.size_px.min() >= np.sort(presence.size_px)[-len(near.p)]


def test_the_field_is_where_the_sides_are_there_and_convex():
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    middle = sides.ends.mean(1)
    paved = (middle < 5.01).all(1)
    field = made_presence(paved).field
    assert inside_convex(middle[paved & (middle > 0.9).all(1) & (middle < 4.1).all(1)], field, 0.0).all()
    beyond = inside_convex(middle, field, 0.0) & ~(middle < 7.1).all(1)
    assert not beyond.any()
    edge = np.roll(field, -1, axis=0) - field
    turn = edge[:, 0] * np.roll(edge[:, 1], -1) - edge[:, 1] * np.roll(edge[:, 0], -1)
    assert (turn > 0).all()


def test_a_lone_side_far_off_does_not_stretch_the_field():
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    middle = sides.ends.mean(1)
    paved = (middle < 4.01).all(1)
    presence = presence_with(sides, np.where(paved, 0.01, 0.9))
    p = presence.p.copy()
    p[np.linalg.norm(middle, axis=1).argmax()] = 0.01
    assert replace(presence, p=p).field == pytest.approx(presence.field)


def test_sides_with_no_more_support_than_what_lies_beside_them_are_clutter():
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 12.0))
    middle, rng = sides.ends.mean(1), np.random.default_rng(0)
    paved = (middle < 6.01).all(1)
    # Beside smooth slabs everything in clutter has more support than most controls of the photo.
    p = np.where(paved, 0.01, rng.uniform(0.0, 0.15, len(sides)))
    beaten = np.where(paved, 0.0, rng.uniform(0.0, 1.0, len(sides)))
    presence = presence_with(sides, p, beaten)
    field = presence.field
    assert inside_convex(middle[(middle < 5.6).all(1) & (middle > 0.4).all(1)], field, 0.0).all()
    assert field.max() < 7.2


def test_a_field_in_a_corner_of_the_picture_is_among_the_possible_ones():
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 20.0))
    middle = sides.ends.mean(1)
    paved = (middle > 13.0).all(1)
    p = np.where(paved, 0.005, np.random.default_rng(0).uniform(size=len(sides)))
    *others, (box, price) = presence_with(sides, p).possible_fields
    assert paved[box].mean() > 0.95
    assert box[paved].mean() > 0.8
    # All choices together must not be likelier than one: these, and the boxes of the ground.
    prices = [cost for _, cost in others]
    chances = np.exp(-np.array(prices)).sum() + 38 * np.exp(-price) + 66**2 * np.exp(-GROUND_COST)
    assert chances <= 1.0 + 1e-9


def terrace(low: tuple[float, float]) -> tuple[np.ndarray, Fit, np.ndarray]:
    """Small slabs in a part of the picture and gravel around them; the fit of the lattice; which part."""
    scene = replace(STACK, spacing_m=(0.3, 0.2))
    photo, gravel = render_paving(scene), render_paving(replace(scene, kind="gravel"))
    middle = on_ground(np.array(low), CAMERA, scene.cam_from_ground)
    paved = square_seen(CAMERA, scene.cam_from_ground, middle, 0.15)
    return np.where(paved, gray_of(photo), gray_of(gravel)), fit_of(photo), paved


def test_a_small_field_is_clearer_among_its_own_controls():
    picture, fit, paved = terrace((380.0, 300.0))
    presence = presence_of(picture, fit)
    closer = looked_at_closer(picture, fit, presence, CLOSE)
    assert len(closer.p) < 0.2 * len(presence.p)
    u, v = np.round(closer.at_px).astype(int).T
    rim = cv2.dilate(paved.astype(np.uint8), np.ones((9, 9))) > 0
    # The box ends at cuts, not where the slabs do.
    assert rim[v, u].mean() > 0.65
    plain, alone = (sum(line_evidence(seen, fit.grid)) for seen in (presence, closer))
    assert alone - GROUND_COST > plain + 15.0


def test_no_part_of_gravel_is_a_small_field(gravel_photo: SyntheticPhoto, stack_fit: Fit):
    # Among so many boxes the likeliest has some support, which its price outweighs.
    gray, gained = gray_of(gravel_photo), []
    for side in (0.2, 0.25, 0.3, 0.35, 0.4, 0.5):
        fit = replace(stack_fit, grid=Grid(side, 0.8 * side))
        closer = looked_at_closer(gray, fit, presence_of(gray, fit), CLOSE)
        gained.append(sum(line_evidence(closer, fit.grid)) - GROUND_COST)
    assert max(gained) < 4.0
    assert np.median(gained) < 0.0


def test_no_sides_span_no_field():
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 3.0)).take(np.zeros(0, int))
    with pytest.raises(ValueError, match="no sides"):
        _ = presence_with(sides, np.zeros(0)).field


def test_the_origin_moves_on_the_ground_and_the_camera_stays(stack_fit: Fit):
    pose = stack_fit.cam_from_ground
    moved = with_origin(pose, 0.6, -0.4)
    assert (moved.R == pose.R).all()
    assert moved.apply(np.zeros(3)) == pytest.approx(pose.apply(np.array([0.6, -0.4, 0.0])))
    assert moved.origin_in_a == pytest.approx(pose.origin_in_a - [0.6, -0.4, 0.0])


def test_the_same_photo_gives_the_same_p_values_twice(stack_photo: SyntheticPhoto):
    once, again = (presence_in(stack_photo, Grid(*STACK.spacing_m)) for _ in range(2))
    assert (once.p == again.p).all()
