from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paved import STACK

from autoreg.ground.rectify import Family, Rectified
from autoreg.paving.periods import (
    CAP,
    PHASES,
    best_combs,
    blurred,
    comb_scores,
    distinct,
    line_pieces,
    line_z,
    local_z,
    log_likelihood_ratio,
    predicted_lines,
)

LINES, COLUMNS = 400, 240


def family(spacing_rows: float | None, phase_rows: float = 0.0, *, missing: int = 0, seed: int = 0) -> Family:
    """Noise with a joint every so many rows, of which some are missing; one row is a hundredth of a unit."""
    rng = np.random.default_rng(seed)
    evidence = rng.uniform(-0.5, 0.5, (LINES, COLUMNS))
    if spacing_rows is not None:
        rows = np.round(np.arange(phase_rows, LINES, spacing_rows)).astype(int)
        rows = rng.permutation(rows[rows < LINES])[missing:]
        evidence[rows] = 0.35 + rng.uniform(-0.3, 0.3, (len(rows), COLUMNS))
    visible = np.ones((LINES, COLUMNS), bool)
    return Family(evidence.astype(np.float32), visible, 0.01 * np.arange(LINES), np.arange(float(COLUMNS)))


def wide_joints(spacing_rows: float, share: float) -> Family:
    """Noise with joints over so large a share of the ground, which are clearest at their middles."""
    rng = np.random.default_rng(0)
    evidence = rng.uniform(-0.5, 0.5, (2 * LINES, COLUMNS))
    row, half = np.arange(2.0 * LINES), 0.5 * share * spacing_rows
    off = np.abs((row - 7.0 + 0.5 * spacing_rows) % spacing_rows - 0.5 * spacing_rows)
    joint = off < half
    clear = 0.45 * (1.0 - 0.3 * (off[joint] / half) ** 2)
    evidence[joint] = clear[:, None] + rng.uniform(-0.3, 0.3, (joint.sum(), COLUMNS))
    visible = np.ones(evidence.shape, bool)
    return Family(evidence.astype(np.float32), visible, 0.01 * row, np.arange(float(COLUMNS)))


def scored(llr: np.ndarray, spacings: np.ndarray) -> np.ndarray:
    """Scores of combs on lines that are all seen, a unit apart."""
    lines = predicted_lines(np.arange(float(len(llr))), spacings)
    return comb_scores(lines, llr, np.ones(len(llr), bool))


@given(st.floats(12.0, 90.0), st.floats(0.0, 1.0))
@settings(deadline=None, derandomize=True, max_examples=25)
def test_the_spacing_and_phase_of_a_comb_are_found_and_neither_half_nor_twice(spacing: float, phase: float):
    best = best_combs(family(spacing, phase * spacing))[0]
    assert best.spacing == pytest.approx(0.01 * spacing, rel=0.03)
    # The lines of the comb lie within two rows of the joints over the whole ground.
    joints = 0.01 * np.arange(phase * spacing, LINES, spacing)
    off = np.mod(joints - best.phase + 0.5 * best.spacing, best.spacing) - 0.5 * best.spacing
    assert np.median(np.abs(off)) < 0.02


@pytest.mark.parametrize(("spacing", "share"), [(30.0, 0.42), (44.0, 0.3), (44.0, 0.42), (60.0, 0.36)])
def test_of_wide_joints_no_part_of_their_spacing_is_found(spacing: float, share: float):
    best = best_combs(wide_joints(spacing, share))[0]
    assert best.spacing == pytest.approx(0.01 * spacing, rel=0.025)


def test_a_comb_is_found_in_the_part_of_the_ground_where_it_is():
    whole, noise = family(24.0, 5.0), family(None, seed=3)
    evidence = noise.evidence.copy()
    evidence[60:220, :120] = whole.evidence[60:220, :120]
    part = replace(whole, evidence=evidence)
    best = best_combs(part, local=True)[0]
    assert best.spacing == pytest.approx(0.24, rel=0.03)
    assert best.lines == pytest.approx((0.77, 2.0), abs=0.25)
    assert best.along[1] < 130.0
    everywhere = best_combs(part)
    assert not everywhere or everywhere[0].score < 0.7 * best.score


@pytest.mark.parametrize("spacing", [20.0, 37.5])
def test_a_comb_survives_missing_joints(spacing: float):
    whole, worn = (best_combs(family(spacing, 5.0, missing=m))[0] for m in (0, 3))
    assert worn.spacing == pytest.approx(0.01 * spacing, rel=0.03)
    assert worn.score < whole.score


def test_chance_scores_far_below_joints():
    chance = [best_combs(family(None, seed=seed)) for seed in range(12)]
    highest = max((combs[0].score for combs in chance if combs), default=0.0)
    joints = best_combs(family(40.0, 3.0))[0].score
    assert highest < 0.5 * joints


def test_the_joints_of_a_photo_have_its_spacings(stack_rectified: Rectified):
    height = STACK.cam_from_ground.origin_in_a[2]
    # The joints along X are spaced by the slabs' side along Y.
    assert best_combs(stack_rectified.x)[0].spacing == pytest.approx(STACK.spacing_m[1] / height, rel=0.02)
    assert best_combs(stack_rectified.y)[0].spacing == pytest.approx(STACK.spacing_m[0] / height, rel=0.02)


def test_a_family_of_which_nothing_is_seen_has_no_comb():
    unseen = Family(
        np.zeros((60, 50), np.float32), np.zeros((60, 50), bool), np.arange(60.0), np.arange(50.0)
    )
    assert best_combs(unseen) == ()


@given(st.floats(-20.0, 60.0), st.floats(0.0, 20.0))
@settings(deadline=None, derandomize=True, max_examples=50)
def test_more_support_never_speaks_against_a_joint_and_none_is_decisive(z: float, more: float):
    low, high = log_likelihood_ratio(np.array([z, z + more]))
    assert low <= high <= CAP


def test_lines_without_a_joint_are_no_evidence_for_one_on_average():
    # The background is a density on the positive half line: the ratio's mean there is one, less the cap.
    z = np.linspace(0.0, 12.0, 20_001)
    background = 0.75 / (1 + z**2 / 5) ** 3
    mean = np.trapezoid(background * np.exp(log_likelihood_ratio(z)), z)
    assert 0.5 < mean < 1.02


@given(st.floats(0.5, 50.0), st.floats(-100.0, 100.0))
@settings(deadline=None, derandomize=True, max_examples=25)
def test_the_z_score_does_not_depend_on_the_scale_of_the_support(gain: float, offset: float):
    profile = np.random.default_rng(1).gamma(4.0, 1.0, 200)
    valid = np.ones(200, bool)
    z = local_z(gain * profile + offset, valid, 60)
    assert z == pytest.approx(local_z(profile, valid, 60), abs=1e-6)


def test_the_z_score_of_normal_noise_is_normal_and_of_the_unknown_zero():
    rng = np.random.default_rng(2)
    valid = np.arange(3000) % 3 > 0
    z = local_z(rng.normal(7.0, 0.3, 3000), valid, 400)
    assert not z[~valid].any()
    assert np.median(z[valid]) == pytest.approx(0.0, abs=0.1)
    assert np.std(z[valid]) == pytest.approx(1.0, abs=0.12)


def test_a_line_has_a_z_score_only_where_enough_of_it_is_seen():
    seen = family(40.0)
    hidden = seen.visible.copy()
    hidden[:100, 60:] = False
    z, valid = line_z(*line_pieces(Family(seen.evidence, hidden, seen.offset, seen.along)))
    assert not valid[:100].any()
    assert valid[100:].all()
    assert z[120] > 5.0


def test_blurring_spreads_a_joint_over_its_neighbours_and_keeps_the_sum_of_ratios():
    llr = np.zeros(30)
    llr[11] = 3.0
    soft = blurred(llr)
    assert np.flatnonzero(soft > 0.1).tolist() == [10, 11, 12]
    assert np.exp(soft).sum() == pytest.approx(np.exp(llr).sum())


def test_scores_are_sums_over_the_lines_of_a_comb():
    llr = np.zeros(200)
    llr[30::40] = 2.0
    scores = scored(llr, np.array([20.0, 40.0, 80.0]))
    assert scores.shape == (3, PHASES)
    assert scores[1, round(30 / 40 * PHASES)] == pytest.approx(2.0 * 5)
    # What is not there adds nothing here; it is the negative ratios of slabs that punish too fine a comb.
    assert scores.max(1) == pytest.approx([10.0, 10.0, 6.0])


def test_a_comb_needs_two_lines():
    scores = scored(np.ones(50), np.array([120.0]))
    assert np.isneginf(scores).all()


def test_combs_that_are_too_alike_count_once():
    spacings = np.array([1.0, 1.01, 1.5, 2.0])
    scores = np.tile([[5.0], [6.0], [4.0], [-1.0]], (1, PHASES))
    chosen = distinct(spacings, scores, 4)
    assert [c.spacing for c in chosen] == [1.01, 1.5]
    assert [c.score for c in chosen] == [6.0, 4.0]


def test_joints_are_told_from_a_grain_by_their_strength_alone():
    rng = np.random.default_rng(11)
    # Some streaks agree with themselves as well as joints do.
    strength = rng.uniform(0.0, 0.5, (LINES, 1))
    strength[np.arange(7, LINES, 25)] = 0.8
    sign = rng.choice([-1.0, 1.0], (LINES, 1))
    evidence = sign * strength + 0.1 * rng.standard_normal((LINES, COLUMNS))
    visible = np.ones((LINES, COLUMNS), bool)
    agreeing = Family(
        evidence.astype(np.float32), visible, 0.01 * np.arange(LINES), np.arange(float(COLUMNS))
    )
    by_agreement, by_strength = (best_combs(replace(agreeing, strong=s)) for s in (False, True))
    assert by_strength[0].spacing == pytest.approx(0.25, rel=0.02)
    assert not by_agreement or by_strength[0].score > by_agreement[0].score + 15.0
