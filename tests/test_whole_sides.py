"""Joints are there along whole sides of their slabs; edges of hexagons along a part of each."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Float
from paved import gray_of
from tiles import hexagons, photo_of

from autoreg.align import align
from autoreg.answer.pattern_refusals import in_part
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, Grid, slab_sides
from autoreg.paving.whole_sides import FEWEST, PARTS, apart, in_parts, part_that_is_there
from autoreg.synthetic import SyntheticPhoto, look_at_ground


def test_sides_are_divided_into_parts_that_follow_each_other():
    sides = slab_sides(Grid(1.0, 0.5, 0.5), np.zeros(2), np.full(2, 3.0))
    parts = in_parts(sides)
    assert len(parts) == PARTS * len(sides)
    ends = parts.ends.reshape(len(sides), PARTS, 2, 2)
    assert ends[:, 0, 0] == pytest.approx(sides.ends[:, 0])
    assert ends[:, -1, 1] == pytest.approx(sides.ends[:, 1])
    assert ends[:, 1:, 0] == pytest.approx(ends[:, :-1, 1])
    # Counted along a line, where the sides follow each other.
    x = parts.family == ALONG_X
    own = x & (parts.line == parts.line[x][0])
    order = np.argsort(parts.cell[own])
    assert np.all(np.diff(parts.middle[own][order, 0]) > 0)


def drawn(there: Float[np.ndarray, " n"], seed: int = 0) -> np.ndarray:
    """P-values of parts, each of which is there with its own chance."""
    rng = np.random.default_rng(seed)
    seen = rng.uniform(size=len(there)) < there
    return np.where(seen, rng.beta(0.2, 2.0, len(there)), rng.uniform(size=len(there)))


@pytest.mark.parametrize("kinds", [3, 6])
def test_a_part_that_is_there_stands_out_from_those_that_are_not(kinds: int):
    kind = np.arange(60 * kinds) % kinds
    found = apart(drawn(np.where(kind == 1, 1.0, 0.0)), kind)
    assert found is not None
    assert found[0] < 0.15 < 0.35 < found[1]
    few = np.arange((FEWEST - 1) * kinds) % kinds
    assert apart(drawn(np.where(few == 1, 1.0, 0.0)), few) is None


@pytest.mark.parametrize("there", [1.0, 0.6, 0.3])
def test_parts_of_worn_joints_are_there_alike(there: float):
    kind = np.arange(120) % 6
    assert not any(apart(drawn(np.full(120, there), seed), kind) for seed in range(200))


def test_joints_of_slabs_are_there_along_their_whole_sides(stack_fit: Fit, stack_photo: SyntheticPhoto):
    field = np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])
    assert part_that_is_there(gray_of(stack_photo), stack_fit, field) is None
    assert in_part(None) is None


@pytest.mark.parametrize(
    ("across_m", "pitch_deg", "heading_deg", "told"),
    [
        (0.14, 45.0, 0.0, True),
        pytest.param(0.2, 35.0, 75.0, True, marks=pytest.mark.slow),
        pytest.param(0.3, 60.0, 20.0, False, marks=pytest.mark.slow),
        pytest.param(0.1, 40.0, 10.0, False, marks=pytest.mark.slow),
    ],
)
def test_hexagons_are_no_slabs(across_m: float, pitch_deg: float, heading_deg: float, told: bool):
    camera = Camera.from_focal(1000, 750, 800.0)
    pose = look_at_ground(pitch_deg=pitch_deg, height_m=1.8, heading_deg=heading_deg, foot_m=(0.1, 0.2))
    photo = photo_of(hexagons(across_m, 8.0), camera, pose, np.random.default_rng(0))
    with pytest.raises(Refusal) as refused:
        align(photo, camera if told else None)
    assert refused.value.code in {"no_lattice", "one_direction", "ambiguous"}
