from dataclasses import replace

import numpy as np
import pytest
from handmade import CAMERA, POSE, ROWS, RUNNING, STACK, alignment, distorted

from autoreg.jobs.overlay import overlay_picture
from autoreg.view import View

LATTICES = pytest.mark.parametrize("lattice", [STACK, RUNNING, ROWS], ids=["stack", "running", "rows"])


def grey(camera):
    return np.full((camera.height, camera.width, 3), 128, np.uint8)


def nearest_ink(drawn, px, reach=2):
    """Largest change of colour within a few pixels of each place."""
    change = np.abs(drawn.astype(int) - 128).max(-1)
    u, v = np.round(px).astype(int).T
    return np.array(
        [
            change[b - reach : b + reach + 1, a - reach : a + reach + 1].max()
            for a, b in zip(u, v, strict=True)
        ]
    )


@LATTICES
@pytest.mark.parametrize("camera", [CAMERA, distorted()], ids=["pinhole", "lens"])
def test_ink_lies_on_the_joints_and_not_inside_the_slabs(lattice, camera):
    found = alignment(lattice, camera)
    drawn = overlay_picture(found, grey(camera))
    view = View(camera, POSE)
    b, a = lattice.spacing_y, lattice.spacing_x or 0.6
    on_joints = np.array([[0.37 * a, j * b] for j in range(-1, 4)])
    if lattice.spacing_x is not None:
        on_joints = np.concatenate([on_joints, [[(2 + lattice.shift) * a, 1.5 * b], [2 * a, 0.5 * b]]])
    assert nearest_ink(drawn, view.project(on_joints)).min() > 60
    # Away from the axes, which stand on the origin.
    insides = np.array([[(1 + (lattice.shift or 0) * j + 0.5) * a, (j + 0.5) * b] for j in (1, 2)])
    assert nearest_ink(drawn, view.project(insides)).max() == 0


def test_a_running_bonds_cross_joints_do_not_pass_through_the_next_row():
    drawn = overlay_picture(alignment(RUNNING), grey(CAMERA))
    middle_of_row_1 = np.array([[2 * 0.6, 1.5 * 0.3]])
    assert nearest_ink(drawn, View(CAMERA, POSE).project(middle_of_row_1)).max() == 0


def test_joints_that_carried_the_fit_have_another_colour_than_predicted_ones():
    drawn = overlay_picture(alignment(STACK), grey(CAMERA)).astype(int)
    view = View(CAMERA, POSE)
    # Row 0 was used from -0.5 to 0.5; X's axis covers its right half.
    (u, v), (u2, v2) = np.round(view.project(np.array([[-0.3, 0.0], [-0.3, 0.4]]))).astype(int)
    used, other = (drawn[b - 1 : b + 2, a].sum(0) - 3 * 128 for a, b in ((u, v), (u2, v2)))
    # Cyan takes red from the grey and magenta takes green.
    assert used[2] < -60 < 60 < used[0]
    assert other[1] < -60 < 60 < other[0]


def test_the_axes_are_red_green_and_blue():
    drawn = overlay_picture(alignment(STACK), grey(CAMERA)).astype(int)
    tips = 0.2 * np.eye(3)
    for point, channel in zip(tips, (2, 1, 0), strict=True):
        u, v = np.round(View(CAMERA, POSE).project(point)).astype(int)
        assert drawn[v, u, channel] == drawn[v, u].max() > 150
        assert np.sort(drawn[v, u])[1] < 140


@pytest.mark.parametrize("size", [(320, 240), (480, 640), (4000, 3000)])
def test_lines_keep_their_share_of_any_picture(size):
    camera = replace(CAMERA.scaled(640, 480) if size[0] > size[1] else CAMERA)
    camera = replace(camera, width=size[0], height=size[1])
    k = size[0] / 640
    camera = replace(camera, fx=camera.fx * k, fy=camera.fy * k, cx=size[0] / 2, cy=size[1] / 2)
    drawn = overlay_picture(alignment(STACK, camera), grey(camera))
    assert drawn.shape == (size[1], size[0], 3)
    inked = np.mean(np.abs(drawn.astype(int) - 128).max(-1) > 20)
    assert 0.01 < inked < 0.2


def test_the_photo_is_not_changed():
    photo = grey(CAMERA)
    overlay_picture(alignment(STACK), photo)
    assert (photo == 128).all()


def test_a_fit_without_used_joints_is_drawn_too():
    bare = replace(alignment(STACK), joints=())
    assert overlay_picture(bare, grey(CAMERA)).shape == (480, 640, 3)
