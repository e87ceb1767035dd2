import numpy as np
import pytest
from handmade import ROWS, RUNNING, STACK, extent
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.lattice import Lattice
from autoreg.layout import crossings, lay_joints, slab_at, slab_centre, slab_sides, was_seen

SETTINGS = settings(deadline=None, derandomize=True, max_examples=40)
lattices = st.builds(
    lambda a, b, shift, reach: Lattice("running" if shift else "stack", a, b, shift, 0.01, extent(reach)),
    st.floats(0.1, 1.0),
    st.floats(0.1, 1.0),
    st.sampled_from([0.0, 1 / 3, 0.5]),
    st.floats(0.3, 3.0),
)


def on_cross_joint(lattice, points, j):
    """Distance along X to the nearest cross joint of row j."""
    place = points[:, 0] / lattice.spacing_x - j * lattice.shift
    return np.abs(place - np.round(place)) * lattice.spacing_x


@SETTINGS
@given(lattices)
def test_every_crossing_lies_on_a_row_line_and_on_a_cross_joint_of_a_row_beside_it(lattice):
    points = crossings(lattice)
    j = np.round(points[:, 1] / lattice.spacing_y)
    assert np.abs(points[:, 1] - j * lattice.spacing_y).max() < 1e-9
    assert np.minimum(on_cross_joint(lattice, points, j), on_cross_joint(lattice, points, j - 1)).max() < 1e-9


@SETTINGS
@given(lattices)
def test_every_slab_side_has_a_slab_sides_length_or_is_cut_at_the_edge(lattice):
    sides = slab_sides(lattice)
    length = np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1)
    whole = np.abs(sides).max((1, 2)) < lattice.extent.max() - 1e-6
    a, b = lattice.spacing_x, lattice.spacing_y
    parts = [b, a] if not lattice.shift else [b, a * lattice.shift, a * (1 - lattice.shift)]
    assert np.min([np.abs(length - part) for part in parts], axis=0)[whole].max(initial=0) < 1e-6


def test_the_origin_is_a_crossing_and_a_corner_of_slab_0_0():
    for lattice in (STACK, RUNNING):
        assert np.linalg.norm(crossings(lattice), axis=1).min() < 1e-12
        half = [lattice.spacing_x / 2, lattice.spacing_y / 2]
        assert slab_centre(lattice, 0, 0) == pytest.approx(half)


def test_a_running_bond_has_cross_joints_only_between_its_rows():
    along_y = lay_joints(RUNNING).along_y
    whole = np.abs(along_y).max((1, 2)) < 3.9
    for x, low, high in zip(along_y[whole, 0, 0], along_y[whole, 0, 1], along_y[whole, 1, 1], strict=True):
        j = round(low / 0.3)
        assert (low, high) == (pytest.approx(j * 0.3), pytest.approx((j + 1) * 0.3))
        assert (x / 0.6 - 0.5 * j) == pytest.approx(round(x / 0.6 - 0.5 * j))


def test_slab_centres_follow_the_shift_of_their_row():
    assert slab_centre(RUNNING, 2, 3) == pytest.approx([(2 + 1.5 + 0.5) * 0.6, 3.5 * 0.3])


def test_rows_have_unbroken_joints_only():
    joints = lay_joints(ROWS)
    assert len(joints.along_y) == 0
    assert len(crossings(ROWS)) == 0
    assert joints.along_x[:, 0, 1] == pytest.approx(joints.row * 0.4)
    assert len(slab_sides(ROWS)) > 100


def test_joints_are_cut_to_a_polygon_that_is_not_convex():
    # An L: the joint y = 0.8 sees only its upright.
    ell = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 0.1], [0.0, 0.1], [0.0, 1.0], [-1.0, 1.0]])
    joints = lay_joints(STACK, ell)
    by_row = dict(zip(joints.row.tolist(), joints.along_x.tolist(), strict=True))
    assert np.allclose(by_row[2], [[-1.0, 0.8], [0.0, 0.8]])
    assert np.allclose(by_row[0], [[-1.0, 0.0], [1.0, 0.0]])


def test_all_stack_joints_of_a_square_are_there():
    joints = lay_joints(STACK, extent(1.25))
    assert joints.row.tolist() == [-3, -2, -1, 0, 1, 2, 3]
    assert joints.along_y[:, 0, 0] == pytest.approx(np.arange(-2, 3) * 0.6)


@SETTINGS
@given(lattices, st.integers(-9, 9), st.integers(-9, 9))
def test_a_slabs_centre_lies_on_that_slab(lattice, i, j):
    assert slab_at(lattice, slab_centre(lattice, i, j)) == (i, j)


@pytest.mark.parametrize(("point", "seen"), [([0.5, 0.5], True), ([0.5, 1.5], False), ([-1.5, 0.5], False)])
def test_what_was_seen_is_the_extent(point, seen):
    assert was_seen(Lattice("stack", 0.6, 0.4, 0.0, 0.01, extent(1.0)), np.array(point)) is seen
