"""Slabs with grooves look like several small ones; their joints are heavier than the grooves are."""

import numpy as np
import pytest
from paved import CAMERA, STACK
from tiles import photo_of

from autoreg.align import align
from autoreg.errors import Refusal
from autoreg.fitting.heavier_lines import Heavier, heavier_lines, in_turn

PART_M, REACH = 0.2, 30


def grooved(parts: int, joint_m: float, groove_m: float, seed: int = 0) -> np.ndarray:
    """A photo of square slabs that grooves divide into so many squares either way."""
    i, j = (v.ravel() for v in np.meshgrid(*2 * [np.arange(-REACH, REACH)]))
    low, high = np.stack([i, j], 1) * PART_M, np.stack([i + 1, j + 1], 1) * PART_M
    half = [
        0.5 * np.where(np.stack(at, 1) % parts == 0, joint_m, groove_m) for at in ((i, j), (i + 1, j + 1))
    ]
    (x0, y0), (x1, y1) = (low + half[0]).T, (high - half[1]).T
    corners = np.stack([x0, y0, x1, y0, x1, y1, x0, y1], 1).reshape(-1, 4, 2)
    return photo_of(corners, CAMERA, STACK.cam_from_ground, np.random.default_rng(seed))


def test_joints_that_are_heavier_in_turn_are_told_of_with_what_would_help():
    photo = grooved(4, joint_m=0.014, groove_m=0.004)
    with pytest.raises(Refusal, match=r"one joint in 4 .* --camera-height") as refused:
        align(photo, CAMERA, slab=(0.8, 0.8))
    assert refused.value.code == "ambiguous"
    # By another scale the pose is the same, whichever of the two are joints.
    found = align(photo, CAMERA, camera_height=1.6)
    assert found.lattice.spacing_x == pytest.approx(PART_M, rel=0.01)
    assert any("4 times as large" in said for said in found.warnings)


def test_joints_of_one_kind_are_not_heavier_in_turn():
    photo = grooved(4, joint_m=0.008, groove_m=0.008)
    found = align(photo, CAMERA, slab=(PART_M, PART_M))
    assert found.pose.cam_from_ground.origin_in_a[2] == pytest.approx(1.6, rel=0.005)
    assert not any("grooves" in said for said in found.warnings)


@pytest.mark.parametrize("period", [2, 3, 6])
def test_the_interval_is_found_though_lines_differ(period: int):
    rng, line = np.random.default_rng(1), np.arange(-17, 18)
    weight = rng.uniform(1.0, 1.4, len(line)) * np.where(line % period == 1, 3.0, 1.0)
    assert in_turn([(line, weight)]).period == period


def test_lines_between_which_there_is_nothing_are_so_many_times_as_heavy_at_the_most():
    line = np.arange(32)
    assert in_turn([(line, np.where(line % 4 == 2, 3.0, 0.0))]) == pytest.approx((4, 100.0), rel=1e-6)


def test_few_lines_and_worn_ones_tell_nothing():
    rng = np.random.default_rng(2)
    assert in_turn([(np.arange(5), np.array([1.0, 9.0, 1.0, 9.0, 1.0]))]) == Heavier(1, 1.0)
    for _ in range(200):
        assert in_turn(2 * [(np.arange(30), rng.lognormal(0.0, 0.7, 30))]).period == 1


def test_a_running_bond_has_no_grooves_across_its_rows(half_fit):
    assert heavier_lines(half_fit) == Heavier(1, 1.0)
