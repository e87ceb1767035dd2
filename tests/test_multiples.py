from __future__ import annotations

from dataclasses import replace

import pytest
from paved import HALF_BOND, STACK, fit_of, gray_of, misses

from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.paving.lattice_evidence import Paving, presented
from autoreg.paving.lay import of_single_slabs
from autoreg.paving.multiples import MOST, divided, slabs_in_one, too_long
from autoreg.paving.side_support import presence_of
from autoreg.synthetic import SyntheticPhoto, render_paving

# Blocks of which many are in the picture.
SCENES = {
    "bricks": replace(HALF_BOND, spacing_m=(0.2, 0.15)),
    "tiles": replace(STACK, spacing_m=(0.2, 0.15)),
    "planks": replace(STACK, spacing_m=(0.8, 0.15)),
}


@pytest.fixture(scope="module")
def photos() -> dict[str, SyntheticPhoto]:
    return {name: render_paving(scene) for name, scene in SCENES.items()}


@pytest.fixture(scope="module")
def fits(photos: dict[str, SyntheticPhoto]) -> dict[str, Fit]:
    return {name: fit_of(photo) for name, photo in photos.items()}


def multiple(fit: Fit, columns: int, rows: int) -> Fit:
    """The fit with a lattice of which so many slabs make one."""
    grid = fit.grid
    assert grid.spacing_x is not None
    shift = (grid.shift * columns * rows) % 1.0
    return replace(fit, grid=Grid(columns * grid.spacing_x, rows * grid.spacing_y, shift))


def paving(photo: SyntheticPhoto, fit: Fit) -> Paving:
    made = presented(gray_of(photo), fit)
    assert made is not None
    return made


@pytest.mark.parametrize(
    ("name", "columns", "rows", "told"),
    [
        ("bricks", 3, 1, (ALONG_Y, 3)),
        ("bricks", 5, 1, (ALONG_Y, 5)),
        ("bricks", 7, 1, (ALONG_Y, 7)),
        ("bricks", 1, 3, (ALONG_X, 3)),
        ("tiles", 4, 1, (ALONG_Y, 4)),
        ("tiles", 6, 1, (ALONG_Y, 6)),
        ("tiles", 1, 5, (ALONG_X, 5)),
        ("bricks", 1, 1, (ALONG_Y, 1)),
        ("tiles", 1, 1, (ALONG_Y, 1)),
        ("planks", 1, 1, (ALONG_Y, 1)),
    ],
)
def test_the_slabs_in_a_cell_of_a_multiple_are_counted(photos, fits, name, columns, rows, told):
    picture, fit = gray_of(photos[name]), multiple(fits[name], columns, rows)
    assert slabs_in_one(picture, fit, presence_of(picture, fit)) == told


def test_of_a_multiple_the_lattice_of_single_slabs_is_found(photos, fits):
    photo, fit = photos["bricks"], fits["bricks"]
    found = of_single_slabs(gray_of(photo), paving(photo, multiple(fit, 5, 1)))
    assert found is not None
    assert (found.grid.spacing_x, found.grid.spacing_y) == pytest.approx((0.2, 0.15), rel=1e-4)
    assert found.grid.shift == pytest.approx(0.5)
    angle_deg, crossing_px = misses(found.fit.cam_from_ground, (0.2, 0.15), photo)
    assert angle_deg < 0.02
    assert crossing_px < 0.2


def test_a_lattice_of_single_slabs_is_left_as_it_is(photos, fits):
    whole = paving(photos["planks"], fits["planks"])
    assert of_single_slabs(gray_of(photos["planks"]), whole) is whole


def test_a_multiple_of_rows_whose_shift_is_not_known_is_no_lattice(photos, fits):
    every_third = multiple(fits["bricks"], 1, 3)
    assert divided(every_third, ALONG_X, 3) is None
    assert of_single_slabs(gray_of(photos["bricks"]), paving(photos["bricks"], every_third)) is None


def test_rows_have_no_cells_to_divide(photos, fits):
    fit = replace(fits["tiles"], grid=Grid(None, 0.15))
    assert slabs_in_one(gray_of(photos["tiles"]), fit, presence_of(gray_of(photos["tiles"]), fit))[1] == 1
    assert divided(fit, ALONG_Y, 3).grid == Grid(None, 0.15)  # pyright: ignore[reportOptionalMemberAccess]


def test_cells_longer_than_slabs_are_looked_for_in_them_are_none():
    assert not too_long(Grid(MOST * 0.1, 0.1))
    assert too_long(Grid((MOST + 1) * 0.1, 0.1))
    assert too_long(Grid(0.1, (MOST + 1) * 0.1, 0.25))
    assert not too_long(Grid(None, 0.1))


def test_a_lattice_of_every_so_manyth_joint_that_cannot_be_told_from_slabs_is_none(
    photos: dict[str, SyntheticPhoto], fits: dict[str, Fit]
):
    # Every 23rd cross joint: all that it predicts is there, and no number of parts that is tried fits.
    fit = multiple(fits["bricks"], 23, 1)
    whole = Paving(fit, presence_of(gray_of(photos["bricks"]), fit), (100.0, 100.0))
    assert of_single_slabs(gray_of(photos["bricks"]), whole) is None
