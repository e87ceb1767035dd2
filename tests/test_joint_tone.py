from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from coloured import SAND, UNEVEN, in_colour, miss_deg
from paved import CAMERA, CHECKER, STACK, fit_of

from autoreg import laying, laying_in_tone
from autoreg.align import align
from autoreg.answer.full_resolution import Laid
from autoreg.answer.pattern_refusals import PatternRefusal
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.beds import BED_BELOW, on_slabs_level
from autoreg.fitting.fit import Fit
from autoreg.image import as_gray
from autoreg.joint_tone import LUMINANCE, Tone, clearest_tone
from autoreg.laying import lay
from autoreg.synthetic import SyntheticPhoto
from autoreg.task import Task

SIZE = (CAMERA.width, CAMERA.height)


@pytest.fixture(scope="module")
def sandy() -> SyntheticPhoto:
    return in_colour(UNEVEN, SAND)


@pytest.fixture(scope="module")
def sandy_fit(sandy: SyntheticPhoto) -> Fit:
    return fit_of(replace(sandy, pixels=np.ascontiguousarray(sandy.pixels[:, :, 0])))


def test_joints_that_differ_by_hue_are_dark_in_the_clearest_tone(sandy: SyntheticPhoto, sandy_fit: Fit):
    tone = clearest_tone(sandy.pixels, sandy_fit, SIZE)
    assert tone is not None
    # Blue against red: what slabs differ by in lightness is taken out.
    assert tone.weights[0] > 0 > tone.weights[2]
    assert abs(tone.weights.sum()) < 0.15 * np.abs(tone.weights).sum()
    slab, joint = (float(tone.weights @ np.array(bgr)) for bgr in ((150.0, 150.0, 150.0), SAND))
    assert joint < slab


def test_the_tone_is_found_though_the_lattice_lies_beside_the_joints(sandy: SyntheticPhoto, sandy_fit: Fit):
    ground = sandy_fit.stations.ground + 0.008
    beside = replace(sandy_fit, stations=replace(sandy_fit.stations, ground=ground))
    there, here = (clearest_tone(sandy.pixels, fit, SIZE) for fit in (beside, sandy_fit))
    assert there is not None
    assert here is not None
    cosine = there.weights @ here.weights
    assert cosine > 0.98 * np.linalg.norm(there.weights) * np.linalg.norm(here.weights)


@pytest.mark.parametrize("joint_bgr", [(60.0, 60.0, 60.0), (55.0, 60.0, 64.0)])
def test_where_luminance_is_as_good_it_stays(joint_bgr: tuple[float, float, float]):
    photo = in_colour(STACK, joint_bgr)
    assert clearest_tone(photo.pixels, fit_of(replace(photo, pixels=as_gray(photo.pixels))), SIZE) is None


def test_a_grey_picture_has_no_other_tone(stack_photo: SyntheticPhoto, stack_fit: Fit):
    grey = np.repeat(as_gray(stack_photo.pixels)[:, :, None], 3, axis=2)
    assert clearest_tone(grey, stack_fit, SIZE) is None


def test_tiles_without_joints_have_no_tone_that_shows_any():
    scene = replace(CHECKER, joint_width_m=1e-6)
    photo = in_colour(scene, (130.0, 130.0, 130.0))
    assert clearest_tone(photo.pixels, fit_of(replace(photo, pixels=as_gray(photo.pixels))), SIZE) is None


def test_luminance_is_what_opencv_takes_for_it(sandy: SyntheticPhoto):
    own = Tone(LUMINANCE, 0.0).of(sandy.pixels).astype(int)
    assert np.abs(own - as_gray(sandy.pixels)).max() <= 1


def test_a_colour_photo_of_joints_that_luminance_hardly_shows_is_aligned_by_their_hue(sandy: SyntheticPhoto):
    assert miss_deg(sandy, sandy.pixels) < 0.02
    assert miss_deg(sandy, sandy.pixels) < 0.5 * miss_deg(sandy, as_gray(sandy.pixels))


@pytest.mark.parametrize(("clearer_nats", "aligned"), [(10.0, True), (-10.0, False)])
def test_a_told_slab_that_luminance_does_not_show_is_looked_for_in_the_tone_of_the_joints(
    sandy: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch, clearer_nats: float, aligned: bool
):
    # As among the stripes of a railing's shadow, which look like slabs of other sides.
    unlike = Refusal("slab_mismatch", "the slabs in this photo have sides in another ratio")
    shown: list[float] = []

    def lay_where_slabs_are_unlike(task: Task, *, thorough: bool = True) -> Laid:
        if task.slab is not None and not task.sight.toned:
            raise unlike
        laid = lay(task, thorough=thorough)
        shown.append(laid.settled.margin_nats if not shown else shown[0] + clearer_nats)
        evidence = laid.settled.evidence_nats
        more = 0.5 * (shown[-1] - laid.settled.margin_nats)
        return replace(
            laid, settled=replace(laid.settled, evidence_nats=(evidence[0] + more, evidence[1] + more))
        )

    monkeypatch.setattr(laying_in_tone, "lay", lay_where_slabs_are_unlike)
    if aligned:
        assert miss_deg(sandy, sandy.pixels) < 0.02
    else:
        with pytest.raises(Refusal) as refused:
            align(sandy.pixels, sandy.camera, slab=(0.6, 0.4))
        assert refused.value is unlike
    with pytest.raises(Refusal) as refused:
        align(as_gray(sandy.pixels), sandy.camera, slab=(0.6, 0.4))
    assert refused.value is unlike


@pytest.mark.parametrize("pattern", [False, True])
def test_what_is_a_pattern_of_stones_is_called_so_whatever_slab_is_told(
    sandy: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch, pattern: bool
):
    # As of herringbone, parts of whose pattern lie as long slabs would.
    unlike = Refusal("slab_mismatch", "the slabs in this photo have sides in another ratio")
    kind = PatternRefusal if pattern else Refusal
    own = kind("no_lattice", "what repeats here as slabs would is full of joints itself")

    def refuse(task: Task, *, thorough: bool = True) -> Laid:
        raise own if task.slab is None else unlike

    monkeypatch.setattr(laying_in_tone, "lay", refuse)
    monkeypatch.setattr(laying_in_tone, "camera_to_blame", lambda *_, **__: None)
    with pytest.raises(Refusal) as refused:
        align(sandy.pixels, sandy.camera, slab=(0.6, 0.4))
    assert refused.value is (own if pattern else unlike)


@pytest.mark.parametrize(("focal_off", "code"), [(0.75, "camera_contradicted"), (1.0, "slab_mismatch")])
def test_a_camera_that_the_joints_contradict_is_named_where_the_slabs_are_unlike(
    stack_photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch, focal_off: float, code: str
):
    # As where the first glance shows nothing by the joints' own camera, and the slabs lie along the view.
    for stage in (laying, laying_in_tone):
        monkeypatch.setattr(stage, "camera_to_blame", lambda *_, **__: None)
    monkeypatch.setattr(laying, "leaning", lambda *_: None)
    right = STACK.camera
    camera = replace(right, fx=focal_off * right.fx, fy=focal_off * right.fy)
    a, b = STACK.spacing_m
    with pytest.raises(Refusal) as refused:
        align(as_gray(stack_photo.pixels), camera, slab=(a, b) if focal_off != 1.0 else (a, 1.4 * b))
    refusal = refused.value
    assert refusal.code == code
    if code == "camera_contradicted":
        assert refusal.measured == pytest.approx(right.fx, rel=0.02)
        assert "--slab" in refusal.message


@pytest.mark.parametrize(
    ("luminance", "tone", "rougher", "taken"),
    [
        ((-1, -1), (-1, -1), 1.5, True),
        ((-1, -1), (-1, -1), 1.7, False),
        # A rim in the light, measured in place of its joint, lies as even as that.
        ((1, -1), (-1, -1), 3.0, True),
        ((1, -1), (-1, 1), 3.0, False),
        ((0, -1), (-1, -1), 3.0, False),
    ],
)
def test_a_tone_that_shows_joints_rougher_is_taken_where_luminance_takes_a_lit_rim_for_some(
    monkeypatch: pytest.MonkeyPatch,
    luminance: tuple[int, int],
    tone: tuple[int, int],
    rougher: float,
    taken: bool,
):
    before, clearer = (
        SimpleNamespace(
            fit=SimpleNamespace(strip=SimpleNamespace(polarity=polarity), roughness_px=roughness_px),
            settled=SimpleNamespace(margin_nats=50.0),
        )
        for polarity, roughness_px in ((luminance, 0.2), (tone, 0.2 * rougher))
    )
    task: Any = SimpleNamespace(colour=lambda: None, sight=SimpleNamespace(looks=SimpleNamespace(size=SIZE)))
    for name, stand_in in (
        ("clearest_tone", lambda *_: None),
        ("_seen_in", lambda *_: "toned"),
        ("_laid_anew", lambda *_: clearer),
        ("alike", lambda *_: True),
    ):
        monkeypatch.setattr(laying_in_tone, name, stand_in)
    answer = laying_in_tone._in_joint_tone(task, before)
    assert answer == (("toned", clearer) if taken else (task, before))


def test_beds_are_measured_where_they_would_be_at_the_slabs_level(stack_fit: Fit):
    raised = on_slabs_level(stack_fit)
    px = raised.offsets.offset_px - stack_fit.offsets.offset_px
    # What lies lower is seen nearer to the camera: it is moved away from it.
    away = px * np.sign(across_slope(stack_fit))
    assert (away[stack_fit.usable] >= 0).all()
    assert (px[~stack_fit.usable] == 0).all()
    metres = px / stack_fit.profiles.px_per_unit
    wide = np.array(stack_fit.strip.width)[stack_fit.stations.family]
    rows = np.flatnonzero(stack_fit.usable)
    np.testing.assert_allclose(metres[rows], (BED_BELOW * wide * across_slope(stack_fit))[rows], atol=1e-12)


def test_the_camera_of_a_colour_photo_must_suit_it(sandy: SyntheticPhoto):
    with pytest.raises(ValueError, match="the photo has 640x480"):
        align(sandy.pixels, Camera.from_focal(480, 640, 500.0))
