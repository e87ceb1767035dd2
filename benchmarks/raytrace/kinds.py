"""Random scenes of each kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from autoreg.camera import Camera
from autoreg.synthetic import look_at_ground

from .scene import Paving, Scene

STONES = (
    (0.5, 0.48, 0.44),
    (0.42, 0.42, 0.43),
    (0.55, 0.5, 0.45),
    (0.36, 0.34, 0.32),
    (0.4, 0.42, 0.38),
    (0.5, 0.4, 0.33),
)
SQUARES = (0.3, 0.4, 0.5, 0.6, 0.75)
RECTS = ((0.6, 0.4), (0.4, 0.6), (0.8, 0.5), (0.5, 0.8), (0.9, 0.6), (0.6, 0.3), (0.45, 0.3))
BONDS = ((0.6, 0.3), (0.7, 0.35), (0.4, 0.2), (0.8, 0.4), (0.6, 0.4), (0.2, 0.1))


def _pose(rng: np.random.Generator, low: float, high: float, turn: float = 4.0, heading: float | None = None):
    return look_at_ground(
        pitch_deg=rng.uniform(low, high),
        height_m=rng.uniform(1.3, 4.0),
        roll_deg=rng.uniform(-turn, turn),
        heading_deg=rng.uniform(0, 360) if heading is None else heading,
        foot_m=tuple(rng.uniform(-3, 3, 2)),
    )


def _camera(rng: np.random.Generator, width: int = 1600, height: int = 1200) -> Camera:
    long = max(width, height)
    f = rng.uniform(0.68, 1.1) * long
    shift = rng.normal(0, 0.009, 2) * long
    return Camera(
        width,
        height,
        f,
        f * rng.uniform(0.995, 1.005),
        (width - 1) / 2 + float(shift[0]),
        (height - 1) / 2 + float(shift[1]),
    )


def _base(name: str, kind: str, seed: int, rng: np.random.Generator) -> Scene:
    """A square stack bond in plain daylight, from which every kind is made."""
    side = float(rng.choice(SQUARES))
    camera = _camera(rng)
    grey = rng.uniform(0.06, 0.16)
    paving = Paving(
        slab_m=(side, side),
        joint_m=rng.uniform(0.005, 0.012),
        depth_m=rng.uniform(0.003, 0.01),
        place_jitter_m=rng.uniform(0.0006, 0.0018),
        albedo=STONES[rng.integers(len(STONES))],
        tone_spread=rng.uniform(0.02, 0.09),
        veins=rng.uniform(0.05, 0.2),
        pattern=str(rng.choice(["granite", "wrinkles", "bozo", "agate"])),
        grain_m=rng.uniform(0.05, 0.3),
        bed_albedo=(grey, 0.96 * grey, 0.88 * grey),
        half_size_m=rng.uniform(7, 13),
    )
    return Scene(
        name,
        kind,
        seed,
        camera,
        camera,
        _pose(rng, 24, 60),
        paving,
        sun_elevation_deg=rng.uniform(28, 65),
        sun_azimuth_deg=rng.uniform(0, 360),
        surround=tuple(rng.uniform(0.06, 0.25) * np.array([1.0, 0.97, 0.92])),
        noise_grey=rng.uniform(1, 2.5),
        blur_px=rng.uniform(0.2, 0.6),
        jpeg_quality=int(rng.integers(90, 96)),
        area_sampled=bool(rng.uniform() < 0.3),
    )


def _pave(scene: Scene, **change: object) -> Scene:
    return replace(scene, paving=replace(scene.paving, **change))  # type: ignore[arg-type]


def _resize(scene: Scene, rng: np.random.Generator, width: int, height: int) -> Scene:
    camera = _camera(rng, width, height)
    return replace(scene, camera=camera, told=camera)


def _bond(s: Scene, r: np.random.Generator, shift: float) -> Scene:
    slab = BONDS[r.integers(len(BONDS))]
    s = _pave(s, slab_m=slab, shift=shift)
    # Small bricks from far away melt into one tone, in photos too.
    return (
        s
        if slab[1] > 0.15
        else _pave(replace(s, cam_from_ground=_pose(r, 35, 65)), half_size_m=6.0, joint_m=0.006)
    )


def _lens(s: Scene, r: np.random.Generator) -> Scene:
    k1 = r.uniform(-0.22, 0.06)
    dist = (k1, -0.4 * k1 * r.uniform(0, 1), *r.normal(0, 4e-4, 2), 0.0, 0.0, 0.0, 0.0)
    camera = replace(s.camera, dist=tuple(float(d) for d in dist))
    return replace(s, camera=camera, told=camera)


def _wrong_camera(s: Scene, r: np.random.Generator) -> Scene:
    c = s.camera
    # A heading between the joints lets the photo contradict the camera.
    s = replace(s, cam_from_ground=_pose(r, 28, 52, 3, 90 * r.integers(4) + r.uniform(22, 68)))
    if r.uniform() < 0.6:
        factor = r.choice([r.uniform(0.6, 0.88), r.uniform(1.14, 1.4)])
        return replace(s, told=replace(c, fx=c.fx * factor, fy=c.fy * factor), wrong_camera=True)
    other = r.choice([0.55, 0.7, 1.4])
    return replace(s, told=replace(c, cx=c.cx * other, cy=c.cy * other), wrong_camera=True)


def _nadir(s: Scene, r: np.random.Generator) -> Scene:
    return replace(s, cam_from_ground=_pose(r, 75, 90, 180))


def _wall(s: Scene, r: np.random.Generator) -> Scene:
    pose = look_at_ground(
        pitch_deg=r.uniform(-18, -3),
        height_m=1.6,
        heading_deg=r.uniform(-45, 45),
        roll_deg=r.uniform(-2, 2),
        foot_m=(0.0, -r.uniform(2.5, 6)),
    )
    return _pave(replace(s, cam_from_ground=pose, sun_azimuth_deg=r.uniform(220, 320)), layout="wall")


def _clutter(s: Scene, r: np.random.Generator) -> Scene:
    return replace(s, clutter=int(r.integers(3, 10)), leaves=int(r.integers(20, 150)))


def _shadow(s: Scene, r: np.random.Generator) -> Scene:
    things = tuple(
        str(t) for t in r.choice(["tree", "pole", "box", "box", "fence", "tree"], r.integers(1, 5))
    )
    return replace(s, shadows=things, sun_elevation_deg=r.uniform(25, 50))


def _low_contrast(s: Scene, r: np.random.Generator) -> Scene:
    bed = tuple(c * r.uniform(0.6, 0.75) for c in s.paving.albedo)
    s = _pave(s, bed_albedo=bed, depth_m=0.003, tone_spread=0.02)
    return replace(s, noise_grey=r.uniform(6, 11), jpeg_quality=75, blur_px=r.uniform(0.5, 1.0))


def _compound(s: Scene, r: np.random.Generator) -> Scene:
    """Several things at once, as photos have them: a bond, two conditions of the ground, and a view."""
    one = r.choice(["easy", "rect", "bond-half", "bond-third"])
    two = r.choice(["clutter", "shadow", "wet", "moss", "noisy", "lens", "mixed"], 2, replace=False)
    three = r.choice(["easy", "roll", "house", "small", "grazing", "nadir", "portrait"])
    # A picture's size comes with another camera, through which a lens must see it.
    for kind in (one, three, *two):
        s = KINDS[str(kind)](s, r)
    return s


def _chamfered(s: Scene, r: np.random.Generator) -> Scene:
    """Cast slabs and pavers, whose rims are bevelled: in the sun one rim is dark, the other one light."""
    if r.uniform() < 0.5:
        s = _bond(s, r, 0.5)
    return _pave(s, chamfer_m=r.uniform(0.0015, 0.004), joint_m=r.uniform(0.003, 0.008))


def _patternless(layout: str) -> Callable[[Scene, np.random.Generator], Scene]:
    def make(s: Scene, r: np.random.Generator) -> Scene:
        return replace(
            _pave(s, layout=layout, slab_m=(r.uniform(0.15, 0.4),) * 2), leaves=int(r.integers(0, 60))
        )

    return make


def _curved(layout: str) -> Callable[[Scene, np.random.Generator], Scene]:
    def make(s: Scene, r: np.random.Generator) -> Scene:
        sett = r.uniform(0.08, 0.25)
        return _pave(
            s, layout=layout, slab_m=(sett, sett), joint_m=0.1 * sett, half_size_m=5.0, place_jitter_m=0.003
        )

    return make


KINDS: dict[str, Callable[[Scene, np.random.Generator], Scene]] = {
    "easy": lambda s, r: s,
    "rect": lambda s, r: _pave(s, slab_m=RECTS[r.integers(len(RECTS))]),
    "printed": lambda s, r: _pave(
        s,
        slab_m=(*RECTS, (0.4, 0.4), (0.5, 0.5))[r.integers(len(RECTS) + 2)],
        place_jitter_m=0.0,
        height_jitter_m=0.0,
        turn_jitter_deg=0.0,
        depth_m=0.0001,
    ),
    "bond-half": lambda s, r: _bond(s, r, 0.5),
    "bond-third": lambda s, r: _bond(s, r, float(r.choice([1 / 3, 0.25]))),
    "lens": _lens,
    "clutter": _clutter,
    "shadow": _shadow,
    "grazing": lambda s, r: replace(s, cam_from_ground=_pose(r, 10, 15)),
    "nadir": _nadir,
    "roll": lambda s, r: replace(s, cam_from_ground=_pose(r, 25, 55, 20)),
    "portrait": lambda s, r: _resize(s, r, 1200, 1600),
    "nocamera": lambda s, r: replace(
        s, tell_camera=False, cam_from_ground=_pose(r, 25, 55, 4, 90 * r.integers(4) + r.uniform(15, 75))
    ),
    "noslab": lambda s, r: replace(s, tell_slab=False),
    "wrongk": _wrong_camera,
    "checker": lambda s, r: _pave(
        s, checker=True, joint_m=0.0005, place_jitter_m=0.0, depth_m=0.0005, veins=0.08
    ),
    "lightgrout": lambda s, r: _pave(s, albedo=(0.1, 0.1, 0.11), bed_albedo=(0.5, 0.49, 0.46), depth_m=0.001),
    "wet": lambda s, r: _pave(s, wet=r.uniform(0.3, 0.7)),
    "moss": lambda s, r: _pave(
        s, moss=r.uniform(0.3, 0.7), missing=r.uniform(0.05, 0.2), place_jitter_m=0.002
    ),
    "noisy": _low_contrast,
    "small": lambda s, r: _resize(s, r, 640, 480),
    "large": lambda s, r: replace(_resize(s, r, 4000, 3000), area_sampled=False),
    "house": lambda s, r: replace(s, house=True, cam_from_ground=_pose(r, 14, 28)),
    "mixed": lambda s, r: replace(s, border=("slabs", "lawn")[r.integers(2)]),  # type: ignore[arg-type]
    "rows": lambda s, r: _pave(s, layout="rows", slab_m=(r.uniform(0.45, 0.7), r.uniform(0.2, 0.4))),
    "refuse-crazy": _patternless("crazy"),
    "refuse-gravel": _patternless("gravel"),
    "refuse-asphalt": _patternless("asphalt"),
    "refuse-grass": _patternless("grass"),
    "refuse-fan": lambda s, r: _pave(s, layout="fan", joint_m=0.012, half_size_m=5.0, place_jitter_m=0.003),
    "refuse-planks": lambda s, r: _pave(
        s, layout="planks", slab_m=(1.0, r.uniform(0.12, 0.2)), albedo=(0.4, 0.28, 0.17)
    ),
    "refuse-herringbone": lambda s, r: _pave(
        s, layout="herringbone", slab_m=(0.2, 0.1), half_size_m=5.0, joint_m=0.005
    ),
    "refuse-wall": _wall,
    "compound": _compound,
    # A scene's seed counts the kinds before its own, so that new ones come last.
    "refuse-rings": _curved("rings"),
    "refuse-waves": _curved("waves"),
    "chamfer": _chamfered,
}


def draw(kind: str, number: int, seed: int) -> Scene:
    """The `number`-th random scene of a kind; the same seed gives the same scene."""
    own = seed * 100_000 + list(KINDS).index(kind) * 1000 + number
    rng = np.random.default_rng(own)
    return KINDS[kind](_base(f"{kind}-{number}", kind, own, rng), rng)
