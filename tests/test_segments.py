"""Segments: where edges are found, on which side it is dark, and how well the stated noise fits."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.ground.sight import see
from autoreg.segments import SegmentOptions, Segments, begin_detection, detect_segments

SIZE = 400


def dark_bar(
    angle, offset_px, half_width_px, *, size=SIZE, noise=2.0, seed=0, dark=60.0, bright=180.0, blur=0.7
):
    """A dark bar through the picture's middle, moved by `offset_px` along its normal; area-sampled 4 x 4."""
    grid = (np.arange(size * 4) + 0.5) / 4 - 0.5
    normal = np.array([np.cos(angle), np.sin(angle)])
    across = normal[0] * grid[None, :] + normal[1] * grid[:, None] - bar_centre(angle, offset_px, size)
    picture = np.where(np.abs(across) < half_width_px, dark, bright)
    picture = picture.reshape(size, 4, size, 4).mean((1, 3))
    picture = cv2.GaussianBlur(picture, (0, 0), blur)
    picture = picture + np.random.default_rng(seed).normal(0, noise, picture.shape)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8), normal


def bar_centre(angle, offset_px, size=SIZE):
    return (np.cos(angle) + np.sin(angle)) * size / 2 + offset_px


def long_ones(segments, length_px=80.0):
    return segments.take(segments.length_px > length_px)


@pytest.mark.parametrize("scale", [1.0, 0.71, 0.5, 0.33])
def test_edges_are_not_shifted_at_any_reduction(scale):
    options = SegmentOptions(megapixels=SIZE**2 * scale**2 / 1e6, levels=1)
    normals, errors = [], []
    for k in range(16):
        angle, offset, half = 0.2 + np.pi * k / 16, 3.7 * np.sin(5 * k), 18.0 + 0.31 * k
        picture, normal = dark_bar(angle, offset, half, seed=k)
        found = long_ones(detect_segments(picture, options=options))
        across = found.ends_px.mean(1) @ normal - bar_centre(angle, offset)
        assert (across > 0).any()
        assert (across < 0).any()
        # A common shift moves both edges; a bias outwards moves them apart.
        errors.append([np.mean(across[across > 0]) - half, np.mean(across[across < 0]) + half])
        normals.append(normal)
    errors = np.array(errors)
    shift_px = np.linalg.lstsq(np.array(normals), errors.mean(1), rcond=None)[0]
    outwards_px = 0.5 * (errors[:, 0] - errors[:, 1]).mean()
    assert np.abs(shift_px).max() < 0.02
    assert abs(outwards_px) < 0.05


@settings(deadline=None, derandomize=True, max_examples=25)
@given(angle=st.floats(0.0, np.pi), offset=st.floats(-20.0, 20.0))
def test_the_dark_side_lies_to_the_right_of_each_segment(angle, offset):
    picture, normal = dark_bar(angle, offset, 20.0)
    found = long_ones(detect_segments(picture))
    assert len(found) >= 2
    step = found.ends_px[:, 1] - found.ends_px[:, 0]
    right = np.stack([-step[:, 1], step[:, 0]], 1)
    to_bar = bar_centre(angle, offset) - found.ends_px.mean(1) @ normal
    assert ((right @ normal) * to_bar > 0).all()


def test_an_edge_that_all_levels_see_is_told_once():
    picture, normal = dark_bar(0.3, 0.0, 20.0)
    options = SegmentOptions(megapixels=SIZE**2 / 1e6)
    levels = [
        detect_segments(cv2.resize(picture, None, fx=f, fy=f, interpolation=cv2.INTER_AREA), options=options)
        for f in (1.0, 0.5)
    ]
    assert all(len(long_ones(found, 80.0)) >= 2 for found in levels)
    found = detect_segments(picture, options=options)
    told_px = found.length_px[np.abs(found.ends_px.mean(1) @ normal - bar_centre(0.3, 0.0)) < 25].sum()
    whole_px = 2 * SIZE / np.cos(0.3)
    assert 0.8 * whole_px < told_px < 1.2 * whole_px


def test_a_soft_edge_is_found_by_a_coarser_level(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("autoreg.segments.FEW", 0)
    picture, _ = dark_bar(0.4, 0.0, 60.0, dark=150.0, bright=180.0, blur=4.0, noise=3.0)
    fine_only = detect_segments(picture, options=SegmentOptions(levels=1))
    assert long_ones(detect_segments(picture)).length_px.sum() > 2 * fine_only.length_px.sum() + 400


def test_coarser_segments_are_there_before_those_of_all_levels():
    picture, _ = dark_bar(0.4, 0.0, 60.0)
    detection = begin_detection(picture)
    assert set(detection.coarse.level.tolist()) == {1}
    everything = detect_segments(picture)
    assert np.array_equal(detection.all.ends_px, everything.ends_px)
    assert 0 in everything.level


@pytest.mark.slow
def test_the_stated_noise_of_the_ends_is_that_of_the_edges():
    pulls = []
    for k in range(24):
        angle = 0.1 + np.pi * k / 24
        picture, normal = dark_bar(angle, 0.7 * k, 20.0, noise=6.0, seed=k)
        found = detect_segments(picture, options=SegmentOptions(min_length_px=20.0))
        along = np.array([-normal[1], normal[0]])
        step = found.ends_px[:, 1] - found.ends_px[:, 0]
        parallel = np.abs(step @ along) > 0.99 * found.length_px
        # Half the difference of the two ends across the edge: what vanishing directions depend on.
        pulls.append((0.5 * (step @ normal) / found.sigma_px)[parallel])
    spread = np.sqrt(np.mean(np.concatenate(pulls) ** 2))
    # Sharp and straight edges lie within the stated noise, which allows for real ones.
    assert 0.1 < spread < 1.0


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (300, 300)])
def test_a_blank_picture_has_no_segments(shape):
    found = detect_segments(np.full(shape, 128, np.uint8))
    assert len(found) == 0
    assert found.ends_px.shape == (0, 2, 2)


def test_segments_come_longest_first_and_in_the_number_asked_for():
    rng = np.random.default_rng(3)
    picture = np.kron(rng.integers(0, 255, (30, 30)), np.ones((20, 20))).astype(np.uint8)
    found = detect_segments(picture, options=SegmentOptions(max_segments=50))
    assert len(found) == 50
    assert (np.diff(found.length_px) <= 0).all()


def test_a_large_picture_gives_the_edges_of_its_small_copy():
    picture, _ = dark_bar(0.3, 0.0, 20.0, noise=0.0)
    large = cv2.resize(picture, None, fx=10, fy=10, interpolation=cv2.INTER_LINEAR)
    here, there = long_ones(detect_segments(picture)), long_ones(detect_segments(large), 800.0)
    assert len(there) == 2
    # Pixel edges scale, so half a pixel goes in before and out after.
    middle = np.sort(((there.ends_px.mean(1) + 0.5) / 10 - 0.5) @ [np.cos(0.3), np.sin(0.3)])
    expected = np.sort(here.ends_px.mean(1) @ [np.cos(0.3), np.sin(0.3)])
    assert np.allclose(middle, expected[[0, -1]], atol=0.1)


def test_a_selection_keeps_the_columns_together():
    ends = np.array([[[0.0, 0.0], [3.0, 4.0]], [[1.0, 1.0], [1.0, 2.0]]])
    some = Segments(ends, np.array([0.1, 0.2]), np.array([0, 1])).take(np.array([1]))
    assert some.length_px.tolist() == [1.0]
    assert some.sigma_px.tolist() == [0.2]
    assert some.level.tolist() == [1]


@pytest.mark.parametrize(
    ("picture", "got"),
    [
        (None, "got NoneType"),
        ("photo.jpg", "got str"),
        (np.zeros((80, 100, 3), np.uint8), "got 80 x 100 x 3 of uint8"),
        (np.zeros((80, 100)), "got 80 x 100 of float64"),
        (np.zeros((0, 100), np.uint8), "got 0 x 100 of uint8"),
    ],
)
def test_what_is_no_grey_picture_is_named(picture, got):
    with pytest.raises(ValueError, match=f"h x w of uint8, {got}; .*load_photo"):
        detect_segments(picture)


def in_chequers(side_px: int, corner_px: int) -> np.ndarray:
    """Squares of two tones that lie so far from the picture's corner."""
    u = (np.arange(SIZE) - corner_px) // side_px
    return np.where((u[:, None] + u) % 2, 120, 140).astype(np.uint8)


@pytest.mark.parametrize(("corner_px", "kept"), [(0, False), (5, True)])
def test_edges_of_the_blocks_in_which_colours_are_kept_are_left_out(corner_px, kept):
    picture = in_chequers(48, corner_px)
    options = SegmentOptions(blocks_px=16.0)
    every, without = detect_segments(picture), detect_segments(picture, options=options)
    assert len(every) > 100
    assert len(without) == (len(every) if kept else 0)


def test_joints_across_blocks_are_kept():
    picture, _ = dark_bar(0.05, 0.0, 18.0)
    found = detect_segments(picture, options=SegmentOptions(blocks_px=16.0))
    assert len(long_ones(found)) == 2


def test_a_tone_is_seen_without_the_edges_of_its_blocks():
    picture = in_chequers(48, 0)
    assert len(see(picture).segments) > 100
    assert len(see(picture, toned=True).segments) == 0
