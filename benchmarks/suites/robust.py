"""Where it breaks: success, refusal and wrong answers of the whole `align`, one difficulty at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from autoreg.align import align
from autoreg.alignment import Alignment
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.geometry import Rigid, angle_between_rotations
from autoreg.ground.ground_frame import turned
from autoreg.ground.points import on_ground, project_ground
from autoreg.image import as_gray
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving
from benchmarks.last_stage import crossings_of
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.parallel import measured
from benchmarks.result import Plot, Result, Series, Table

Became = Literal["success", "refused", "wrong", "told"]

# A success is within so many degrees, and such shares of the short side and of the camera's height.
TURN_DEG, ON_GROUND, HEIGHT = 0.5, 0.02, 0.02
HALF_BREAKS = 0.5


@dataclass(frozen=True)
class Photo:
    """What is given to `align`, and what is so: `told` is the camera that it is told."""

    gray: np.ndarray
    scene: SyntheticScene
    told: Camera


Change = Callable[[SyntheticScene, float], SyntheticScene]
Spoil = Callable[[Photo, float, np.random.Generator], Photo]


@dataclass(frozen=True)
class Axis:
    """One kind of difficulty: how the scene changes with it, and how the finished photo is spoilt."""

    name: str
    unit: str
    values: tuple[float, ...]
    change: Change = lambda scene, value: scene
    spoil: Spoil = lambda photo, value, rng: photo
    times_as_large: int = 1


def _tilted(scene: SyntheticScene, tilt_deg: float) -> SyntheticScene:
    pose = look_at_ground(
        pitch_deg=tilt_deg, height_m=1.6, heading_deg=scene.seed * 37.0 % 90, roll_deg=1.0, foot_m=(0.1, 0.2)
    )
    return replace(scene, cam_from_ground=pose)


def _from_high(scene: SyntheticScene, side_px: float) -> SyntheticScene:
    """Bricks, from as high up as makes their short sides so many pixels long amid the picture."""
    low, bricks = scene.cam_from_ground, replace(scene, spacing_m=(0.2, 0.1), shift=0.5, joint_width_m=0.006)
    seen_px = scene.camera.fx * min(bricks.spacing_m) * -low.R[2, 2] / low.origin_in_a[2]
    return replace(bricks, cam_from_ground=replace(low, t=low.t * seen_px / side_px))


def _bent(scene: SyntheticScene, k1: float) -> SyntheticScene:
    """With a second coefficient as real lenses have it: k1 alone would fold the picture's corners."""
    return replace(scene, camera=replace(scene.camera, dist=(k1, k1 * k1, *scene.camera.dist[2:])))


def _bond(scene: SyntheticScene, shift: float) -> SyntheticScene:
    return replace(scene, spacing_m=(0.6, 0.3), shift=shift)


def _false_lines(photo: Photo, share: float, rng: np.random.Generator) -> Photo:
    """Dark lines of a joint's look, anywhere: so many for a true one that they are this share of all."""
    gray, (height, width) = photo.gray.copy(), photo.gray.shape
    true_lines = 20
    for _ in range(round(true_lines * share / (1 - share))):
        a = rng.uniform([0, 0], [width, height])
        way = rng.uniform(0, np.pi)
        b = a + 0.4 * width * np.array([np.cos(way), np.sin(way)])
        ends = [tuple(int(v) for v in np.round(16 * p)) for p in (a, b)]
        tone = float(photo.scene.joint_tone)
        cv2.line(gray, ends[0], ends[1], tone, int(rng.integers(1, 4)), cv2.LINE_AA, 4)
    return replace(photo, gray=gray)


def _covered(photo: Photo, share: float, rng: np.random.Generator) -> Photo:
    """Discs of any tone until this share of the picture is hidden."""
    gray, (height, width) = photo.gray.copy(), photo.gray.shape
    hidden = np.zeros(gray.shape, np.uint8)
    while hidden.mean() < share:
        centre = tuple(int(v) for v in rng.uniform([0, 0], [width, height]))
        radius = int(rng.uniform(0.04, 0.12) * width)
        cv2.circle(gray, centre, radius, float(rng.uniform(30, 220)), -1, cv2.LINE_AA)
        cv2.circle(hidden, centre, radius, 1, -1)
    return replace(photo, gray=gray)


def _terrace(photo: Photo, share: float, rng: np.random.Generator) -> Photo:
    """The paving is a square that fills this share of the picture; around it lies gravel."""
    camera, pose = photo.scene.camera, photo.scene.cam_from_ground
    middle_px = rng.uniform([0.3, 0.4], [0.7, 0.8]) * [camera.width, camera.height]
    paved = square_seen(camera, pose, on_ground(middle_px, camera, pose), share)
    gravel = as_gray(render_paving(replace(photo.scene, kind="gravel")).pixels)
    return replace(photo, gray=np.where(paved, photo.gray, gravel))


def square_seen(
    camera: Camera, pose: Rigid, middle: Float[np.ndarray, "2"], share: float
) -> Bool[np.ndarray, "h w"]:
    """Pixels of the square about a ground point, along the axes, that fills this share of the picture."""
    u, v = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
    ground = on_ground(np.stack([u, v], -1).reshape(-1, 2), camera, pose)
    off = np.nan_to_num(np.abs(ground - middle).max(1), nan=np.inf).reshape(u.shape)
    return off < np.quantile(off, share)


def soft_light(gray: UInt8[np.ndarray, "h w"], depth: float, rng: np.random.Generator) -> np.ndarray:
    """A picture under light that varies by so many grey levels over a thirtieth of its width."""
    light = cv2.GaussianBlur(rng.standard_normal(gray.shape), (0, 0), gray.shape[1] / 30.0)
    return np.clip(gray + depth * light / light.std(), 0, 255).astype(np.uint8)


def _smeared(photo: Photo, length_px: float, rng: np.random.Generator) -> Photo:
    """The camera moves by so many pixels, in any direction, while the shutter is open."""
    size = 2 * int(np.ceil(0.5 * length_px)) + 3
    way = rng.uniform(0, np.pi)
    along = np.linspace(-0.5, 0.5, 400) * length_px
    path = 0.5 * (size - 1) + along[:, None] * np.array([np.cos(way), np.sin(way)])
    corner = np.floor(path).astype(int)
    part = path - corner
    kernel = np.zeros((size, size))
    for du in (0, 1):
        for dv in (0, 1):
            share = np.abs(1 - du - part[:, 0]) * np.abs(1 - dv - part[:, 1])
            np.add.at(kernel, (corner[:, 1] + dv, corner[:, 0] + du), share)
    return replace(photo, gray=cv2.filter2D(photo.gray, -1, kernel / kernel.sum()))


def _wrong_camera(photo: Photo, percent: float, rng: np.random.Generator) -> Photo:
    factor = 1 + 0.01 * percent * rng.choice([-1.0, 1.0])
    told = replace(photo.told, fx=photo.told.fx * factor, fy=photo.told.fy * factor)
    return replace(photo, told=told)


AXES = (
    Axis("noise", "grey levels", (2, 8, 16, 24, 32, 48), lambda s, v: replace(s, noise_grey=v)),
    Axis("blur", "px", (0.5, 1.5, 2.5, 4.0, 6.0), lambda s, v: replace(s, blur_px=v)),
    Axis("contrast", "grey levels", (90, 40, 20, 10, 5), lambda s, v: replace(s, joint_tone=s.slab_tone - v)),
    Axis("tilt", "degrees below the horizon", (75, 45, 30, 20, 14, 11, 8), _tilted),
    Axis("false lines", "share of all lines", (0.0, 0.2, 0.4, 0.6, 0.75), spoil=_false_lines),
    Axis("occlusion", "share of the picture", (0.0, 0.2, 0.4, 0.6, 0.75), spoil=_covered),
    Axis("terrace", "share of the picture", (0.4, 0.2, 0.1, 0.06, 0.03), spoil=_terrace),
    Axis("shadows", "number", (0, 2, 4, 8), lambda s, v: replace(s, shadows=int(v))),
    Axis(
        "soft light", "grey levels", (0.0, 15.0, 30.0, 45.0, 60.0),
        spoil=lambda photo, depth, rng: replace(photo, gray=soft_light(photo.gray, depth, rng)),
    ),
    Axis(
        "noise on faint joints", "grey levels; joints 25 darker", (15, 30, 45, 60, 75),
        lambda s, v: replace(s, noise_grey=v, joint_tone=s.slab_tone - 25.0),
    ),
    Axis("distortion", "k1 (k2 its square)", (0.0, -0.1, -0.2, -0.3), _bent),
    Axis("bond", "shift", (0.0, 0.25, 1 / 3, 0.5), _bond),
    Axis("odd bond", "shift", (0.05, 0.1, 0.16, 0.31, 0.45, 0.52), _bond),
    Axis("joint width", "mm", (2, 4, 8, 20, 40, 70), lambda s, v: replace(s, joint_width_m=1e-3 * v)),
    Axis("smear", "px", (0.0, 2.0, 4.0, 8.0, 12.0), spoil=_smeared),
    Axis(
        "small slabs", "px, in photos three times as large", (40.0, 28.0, 20.0, 14.0, 10.0),
        _from_high, times_as_large=3,
    ),
    Axis("wrong focal length", "%", (0, 1, 3, 10, 20, 30), spoil=_wrong_camera),
)  # fmt: skip


@dataclass(frozen=True)
class Point:
    """What became of the photos at one value of a difficulty."""

    axis: Axis
    value: float
    became: tuple[Became, ...]

    def share(self, *kinds: Became) -> float:
        """Share of the photos that became one of these."""
        return sum(b in kinds for b in self.became) / len(self.became)


def take(axis: Axis, value: float, seed: int, size: tuple[int, int]) -> Photo:
    """One photo."""
    width, height = (axis.times_as_large * side for side in size)
    plain = SyntheticScene(camera=Camera.from_focal(width, height, 0.875 * width), colour=False, seed=seed)
    scene = axis.change(_tilted(plain, 38.0), value)
    photo = Photo(as_gray(render_paving(scene).pixels), scene, scene.camera)
    return axis.spoil(photo, value, np.random.default_rng([31, seed]))


def judge(photo: Photo) -> Became:
    """What `align` makes of it; "told" where a wrong answer comes with the word that the camera is wrong."""
    try:
        found = align(photo.gray, photo.told, slab=photo.scene.spacing_m)
    except Refusal:
        return "refused"
    if within(found, photo.scene):
        return "success"
    return "told" if found.camera.consistent is False else "wrong"


def _became(asked: tuple[str, float, int, tuple[int, int]]) -> Became:
    # The axes' functions have no names to send them by.
    name, value, seed, size = asked
    axis = next(axis for axis in AXES if axis.name == name)
    return judge(take(axis, value, seed, size))


def within(found: Alignment, scene: SyntheticScene) -> bool:
    """Whether an alignment is the true one up to the lattice's symmetry."""
    pose, true = found.pose.cam_from_ground, scene.cam_from_ground
    a, b = found.lattice.spacing_x, found.lattice.spacing_y
    if a is None or angle_up_to_quarter_turns(pose, true) > TURN_DEG:
        return False
    if abs(pose.origin_in_a[2] / true.origin_in_a[2] - 1) > HEIGHT:
        return False
    # The pixels in which the true crossings are seen, on the found ground as the told camera has it, and the
    # found crossings nearest to them.
    points = crossings_of(scene, heights=4.0)
    ground = on_ground(project_ground(scene.camera, true, points), found.camera.camera, pose)
    row = np.round(ground[:, 1] / b)
    moved = row * (found.lattice.shift or 0.0)
    near = np.stack([(np.round(ground[:, 0] / a - moved) + moved) * a, row * b], 1)
    off = np.sqrt(np.mean(((near - ground) ** 2).sum(1)))
    return bool(off < ON_GROUND * min(scene.spacing_m))


def angle_up_to_quarter_turns(found: Rigid, true: Rigid) -> float:
    """Least angle in degrees between rotations, over quarter turns of the ground."""
    return float(np.rad2deg(min(angle_between_rotations(turned(found, q).R, true.R) for q in range(4))))


def run(options: Options) -> Result:
    """The whole grid, or the easy and one hard point of some axes."""
    seeds = options.count(1, 5)
    size = (640, 480) if options.quick else (1024, 768)
    axes = [replace(axis, values=axis.values[1:4:2]) for axis in AXES[1:5]] if options.quick else AXES
    asked = [(axis, value) for axis in axes for value in axis.values]
    photos = [(axis.name, value, seed, size) for axis, value in asked for seed in range(1, seeds + 1)]
    every = measured(_became, photos, options.jobs)
    points = [
        Point(axis, value, tuple(every[k * seeds : (k + 1) * seeds])) for k, (axis, value) in enumerate(asked)
    ]
    table = Table(
        "What became of the photos, per cent",
        ("difficulty", "value", "success", "told that the camera is wrong", "refused", "wrong"),
        tuple(
            (
                point.axis.name,
                f"{point.value:.3g}",
                *(f"{100 * point.share(kind):.0f}" for kind in ("success", "told", "refused", "wrong")),
            )
            for point in points
        ),
    )
    return Result(
        "robust",
        about=(
            f"The whole `align` with camera and slab, {seeds} photos of {size[0]} x {size[1]} for "
            f"each value. A success "
            f"is within {TURN_DEG}°, {100 * ON_GROUND:g} % of a side at the crossings, and "
            f"{100 * HEIGHT:g} % of the "
            "camera's height; wrong is aligned beyond that without the word that the camera is wrong."
        ),
        figures=(
            Figure("robust.wrong", 100.0 * every.count("wrong") / len(every)),
            Figure("robust.success", 100.0 * every.count("success") / len(every)),
            Figure("robust.refused", 100.0 * every.count("refused") / len(every)),
        ),
        tables=(table,),
        plots=tuple(_curve(axis, points) for axis in axes if len(axis.values) > 2),
        notes=_breaks(points),
    )


def _curve(axis: Axis, points: list[Point]) -> Plot:
    mine = sorted((p for p in points if p.axis.name == axis.name), key=lambda p: p.value)
    x = tuple(float(p.value) for p in mine)
    series = (
        Series("success", x, tuple(p.share("success") for p in mine)),
        Series("refused or told", x, tuple(p.share("refused", "told") for p in mine)),
        Series("wrong", x, tuple(p.share("wrong") for p in mine)),
    )
    title = f"What becomes of a photo, by {axis.name}"
    return Plot(axis.name.replace(" ", "-"), title, f"{axis.name}, {axis.unit}", "share", series)


def _breaks(points: list[Point]) -> tuple[str, ...]:
    """Where half of the photos are lost, on each axis."""
    said: list[str] = []
    for name in dict.fromkeys(p.axis.name for p in points):
        lost = [p for p in points if p.axis.name == name and p.share("success") <= HALF_BREAKS]
        if lost:
            said.append(f"{name} from {lost[0].value:.3g} {lost[0].axis.unit}")
    return (f"Half of the photos or more are lost at: {'; '.join(said)}.",) if said else ()
