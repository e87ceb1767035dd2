from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
from coloured import UNEVEN, in_colour, miss_deg
from jaxtyping import Float, UInt8

from autoreg import laying_in_tone
from autoreg.align import align
from autoreg.answer.full_resolution import Laid
from autoreg.answer.pattern_refusals import PatternRefusal
from autoreg.errors import Refusal
from autoreg.fine_hue import DARK, Hue, finest_hue
from autoreg.ground.sides import Grid
from autoreg.ground.sight import see
from autoreg.image import as_gray
from autoreg.synthetic import SyntheticPhoto
from autoreg.task import Task

# Joints a little warmer than the slabs' 150, and as light.
WARM = (105.0, 149.0, 162.0)


def dappled(shape: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """Light under a tree: patches of some pixels, a third as light as those between them."""
    rng = np.random.default_rng(1)
    height, width = shape
    leaves = sum(
        cv2.resize(
            rng.normal(size=(height // px, width // px)), (width, height), interpolation=cv2.INTER_CUBIC
        )
        for px in (6, 12, 25)
    )
    lit = np.where(cv2.GaussianBlur(np.asarray(leaves), (0, 0), 1.2) > 0.0, 1.0, 0.35)
    return np.asarray(cv2.GaussianBlur(lit, (0, 0), 1.0))


def under(light: Float[np.ndarray, "h w"], pixels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.round(pixels * light[:, :, None]).astype(np.uint8)


@pytest.fixture(scope="module")
def warm() -> SyntheticPhoto:
    return in_colour(UNEVEN, WARM)


def test_joints_that_drown_in_light_and_shade_are_found_by_their_hue(warm: SyntheticPhoto):
    shaded = under(dappled((480, 640)), warm.pixels)
    with pytest.raises(Refusal):
        align(as_gray(shaded), warm.camera, slab=(0.6, 0.4))
    assert miss_deg(warm, shaded) < 0.05


def test_what_is_refused_by_luminance_and_has_no_joints_by_hue_is_refused_for_the_same_reason():
    rng = np.random.default_rng(0)
    hue = cv2.GaussianBlur(rng.normal(size=(480, 640, 3)), (0, 0), 2.0)
    mottled = np.clip(128.0 + 300.0 * hue, 0, 255).astype(np.uint8)

    def reason(picture: np.ndarray) -> tuple[str, str]:
        with pytest.raises(Refusal) as refused:
            align(picture, None)
        return refused.value.code, str(refused.value)

    assert reason(mottled) == reason(as_gray(mottled))


def test_shade_hardly_changes_the_hue_and_joints_do(warm: SyntheticPhoto):
    hue = finest_hue(warm.pixels, (640, 480))
    assert hue is not None
    # Blue against red.
    assert hue.weights[0] * hue.weights[2] < 0
    assert abs(hue.weights.sum()) < 1e-9 * np.abs(hue.weights).sum()
    slab, joint = (_hue_of(hue, bgr) for bgr in ((150.0, 150.0, 150.0), WARM))
    shaded = _hue_of(hue, tuple(0.35 * (level + DARK) - DARK for level in (150.0, 150.0, 150.0)))
    assert abs(joint - slab) > 60.0
    assert abs(shaded - slab) < 1e-6


def _hue_of(hue: Hue, bgr: tuple[float, ...]) -> float:
    return float(np.log(np.array(bgr) + DARK) @ hue.weights + hue.offset)


def test_the_picture_in_a_hue_is_its_logarithms_weighed():
    hue = Hue(np.array([-300.0, 100.0, 200.0]), 120.0)
    flat = np.full((20, 30, 3), (150, 140, 160), np.uint8)
    assert (hue.of(flat) == round(_hue_of(hue, (150.0, 140.0, 160.0)))).all()


def test_a_photo_without_colours_has_no_hue(warm: SyntheticPhoto):
    grey = np.repeat(as_gray(warm.pixels)[:, :, None], 3, axis=2)
    assert finest_hue(grey, (640, 480)) is None


def test_a_photo_of_one_colour_has_no_hue_and_is_refused():
    orange = np.full((96, 128, 3), (40, 90, 200), np.uint8)
    assert finest_hue(orange, (128, 96)) is None
    with pytest.raises(Refusal):
        align(orange, None)


def test_rows_by_hue_are_none_where_luminance_shows_a_pattern(
    monkeypatch: pytest.MonkeyPatch, warm: SyntheticPhoto
):
    rows = cast(Laid, SimpleNamespace(fit=SimpleNamespace(grid=Grid(None, 0.1))))

    def refused(refusal: Refusal) -> bool:
        def lay(_: Task) -> Laid:
            raise refusal

        monkeypatch.setattr(laying_in_tone, "lay", lay)
        monkeypatch.setattr(laying_in_tone, "_laid_by_hue", lambda task: (task, rows))
        monkeypatch.setattr(laying_in_tone, "_in_joint_tone", lambda task, laid: (task, laid))
        task = Task(see(as_gray(warm.pixels)), None, "photo")
        try:
            return laying_in_tone.lay_in_clearest_tone(task)[1] is not rows
        except Refusal as told:
            return told is refusal

    assert refused(PatternRefusal("no_lattice", "stones of several sizes"))
    assert not refused(Refusal("no_lattice", "nothing repeats"))
