from __future__ import annotations

import numpy as np
import pytest
from paved import CAMERA
from test_rows import ashlar, seen_from_the_camera

from autoreg.align import align
from autoreg.errors import Refusal
from autoreg.rows.slab_lengths import longer_than_wide


@pytest.mark.slow
@pytest.mark.parametrize("lengths", [(1.2, 2.4), (0.45, 0.85)])
def test_the_lengths_of_its_slabs_tell_which_side_of_a_slab_is_the_width_of_a_row(
    lengths: tuple[float, float],
):
    photo = seen_from_the_camera(ashlar(0.3, lengths))
    other = 0.3 * float(np.mean(lengths))
    alignment = align(photo, CAMERA, slab=(other, 0.3))
    assert alignment.lattice.kind == "rows"
    assert alignment.lattice.spacing_y == pytest.approx(0.3)
    assert float(alignment.pose.cam_from_ground.origin_in_a[2]) == pytest.approx(1.6, rel=0.01)


@pytest.mark.slow
def test_slabs_of_which_half_are_longer_than_wide_tell_nothing():
    photo = seen_from_the_camera(ashlar(0.3, (0.5, 1.5)))
    with pytest.raises(Refusal, match="width of a row") as refused:
        align(photo, CAMERA, slab=(0.6, 0.3))
    assert refused.value.code == "ambiguous"


def test_joints_that_are_not_seen_never_make_short_slabs_long():
    # Half of the cross joints are found, by chance: neighbours are then one, two, three slabs apart.
    rng = np.random.default_rng(0)
    said = []
    for _ in range(400):
        slabs = rng.uniform(0.35, 0.75, 400)
        seen = np.cumsum(slabs)[rng.random(400) < 0.5]
        said.append(longer_than_wide(np.diff(seen)))
    assert True not in said
    assert False in said


def test_few_slabs_tell_nothing():
    assert longer_than_wide(np.zeros(0)) is None
    assert longer_than_wide(np.full(9, 2.0)) is None
    assert longer_than_wide(np.full(12, 2.0)) is True
    assert longer_than_wide(np.full(12, 0.5)) is False
