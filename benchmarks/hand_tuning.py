"""Lines on the joints of ray-traced photos: autoreg's against the best that hand tuning can reach.

Three photos of 4896 x 2752 pixels, one of them cropped to 2752 x 2752, and one handed over in another
size than its camera was calibrated in. Nothing is set by hand between them. Beside it stands what lines
placed by hand can reach: a camera guessed as one does in POV-Ray (a taped height, a look_at point, the angle
of view; so the principal point in the middle, square pixels, no roll, no distortion), and for the lines a
turn about the vertical axis and a shift sideways, of which the best are found by search.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import minimize, minimize_scalar

from autoreg.alignment import Alignment
from autoreg.camera import Camera
from autoreg.jobs.job import Job, Listener, run_job
from autoreg.jobs.render_job import Wish, make_plan, read_wish
from autoreg.lattice import Lattice
from autoreg.layout import lay_joints
from autoreg.rendering.check import check_render
from autoreg.rendering.render import choose_engine
from autoreg.synthetic import look_at_ground
from autoreg.view import View
from benchmarks.raytrace.files import camera_file
from benchmarks.raytrace.picture import take
from benchmarks.raytrace.scene import Paving, Scene

WIDTH, HEIGHT = 4896, 2752
CAMERA = Camera(WIDTH, HEIGHT, 3720.0, 3726.0, 2472.0, 1359.0, (-0.06, 0.03, 2e-4, -3e-4))
CROP = (1310, 0, 2752, 2752)
REDECLARED = (2448, 1376)
# Sides of a slab, pitch, height, heading, roll, and the foot of the camera.
PHOTOS = {
    "square": ((0.5, 0.5), 31.0, 1.62, 18.0, 0.7, (0.21, -0.13)),
    "oblong": ((0.6, 0.4), 26.0, 1.74, -33.0, -1.1, (-0.32, 0.4)),
    "large": ((0.75, 0.75), 38.0, 2.1, 41.0, 0.4, (0.4, 0.05)),
}


@dataclass(frozen=True)
class Validation:
    """One of the five: a photo, and how it is handed over."""

    name: str
    photo: str
    crop: tuple[int, int, int, int] | None = None
    size: tuple[int, int] | None = None

    def true_camera(self) -> Camera:
        """The camera of the picture as handed over."""
        camera = CAMERA if self.crop is None else CAMERA.cropped(*self.crop)
        return camera if self.size is None else camera.scaled(*self.size)


VALIDATIONS = (
    *(Validation(name, name) for name in PHOTOS),
    Validation("cropped", "oblong", crop=CROP),
    Validation("re-declared", "large", size=REDECLARED),
)


def scene_of(name: str) -> Scene:
    """The scene of one photo."""
    slab, pitch, height, heading, roll, foot = PHOTOS[name]
    pose = look_at_ground(pitch_deg=pitch, height_m=height, heading_deg=heading, roll_deg=roll, foot_m=foot)
    paving = Paving(slab_m=slab, joint_m=0.008, depth_m=0.006, place_jitter_m=0.0008, half_size_m=9.0)
    return Scene(name, "thesis", 40 + list(PHOTOS).index(name), CAMERA, CAMERA, pose, paving, blur_px=0.6)


def write_photo(validation: Validation, folder: Path) -> Path:
    """The picture of a validation, as a file; with the camera as calibrated beside it."""
    source = folder / f"{validation.photo}.png"
    if not source.exists():
        begun = time.monotonic()
        cv2.imwrite(str(source), take(scene_of(validation.photo)), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        print(f"traced {source.name} in {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    (folder / "camera.json").write_text(json.dumps(camera_file(scene_of(validation.photo))))
    picture = cv2.imread(str(source), cv2.IMREAD_COLOR)
    assert picture is not None
    if validation.crop is not None:
        x, y, w, h = validation.crop
        picture = picture[y : y + h, x : x + w]
    if validation.size is not None:
        picture = cv2.resize(picture, validation.size, interpolation=cv2.INTER_AREA)
    path = folder / f"{validation.name}.jpg"
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 93])
    return path


def visible_lines(view: View, lattice: Lattice) -> list[np.ndarray]:
    """Pixels along every joint in the lattice's field that the picture shows: one array for each."""
    joints = lay_joints(lattice)
    px, _ = view.polylines(np.concatenate([joints.along_x, joints.along_y]), 40)
    size = [view.camera.width, view.camera.height]
    inside = np.asarray(((px >= 0) & (px <= np.array(size) - 1)).all(-1))
    return [line[shown] for line, shown in zip(px, inside, strict=True) if shown.sum() > 4]


def distance_to_true_joints_px(px: np.ndarray, truth: View, slab: tuple[float, float]) -> np.ndarray:
    """Distance of each pixel, in the picture, to the nearest true joint."""
    ground = truth.ground_under(px)
    best = np.full(len(px), np.inf)
    for axis in (0, 1):
        off = ground[:, axis] - np.round(ground[:, axis] / slab[axis]) * slab[axis]
        # The joint's own line there: two of its points, in the picture.
        on = ground.copy()
        on[:, axis] -= off
        along = np.zeros(2)
        along[1 - axis] = 1e-3
        a, b = truth.project(on - along), truth.project(on + along)
        way = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
        best = np.fmin(best, np.abs(way[:, 0] * (px - a)[:, 1] - way[:, 1] * (px - a)[:, 0]))
    return best


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def guessed_camera(truth: View) -> View:
    """The camera that one guesses: taped height, paced look_at point, angle of view from the focal length."""
    c = truth.camera
    middle = np.array([(c.width - 1) / 2, (c.height - 1) / 2])
    camera = Camera(c.width, c.height, c.fx, c.fx, *middle)
    ahead = truth.ground_under(middle) - truth.eye[:2]
    distance, height = round(float(np.hypot(*ahead)), 1), round(float(truth.eye[2]) / 0.05) * 0.05
    pose = look_at_ground(
        pitch_deg=float(np.rad2deg(np.arctan2(height, distance))),
        height_m=height,
        heading_deg=0.0,
        foot_m=(0.0, 0.0),
    )
    return View(camera, pose)


def by_hand_px(truth: View, lattice: Lattice) -> tuple[float, float]:
    """The best rms in pixels that the two knobs reach: one turn for all lines of a family, or one for each.

    A line lies on the ground at a turn and a shift; its place is looked for that brings it nearest to a true
    joint's pixels.
    """
    guess = guessed_camera(truth)
    joints = lay_joints(lattice)
    together: list[np.ndarray] = []
    single: list[np.ndarray] = []
    for segments in (joints.along_x, joints.along_y):
        px, _ = truth.polylines(segments, 40)
        size = np.array([truth.camera.width, truth.camera.height]) - 1
        lines = [line[((line >= 0) & (line <= size)).all(-1)] for line in px]
        # Pixels that the guessed camera takes for sky can carry no line on its ground.
        lines = [line[np.isfinite(guess.ground_under(line)).all(-1)] for line in lines]
        lines = [line for line in lines if len(line) > 4]
        if not lines:
            continue
        grounds = [guess.ground_under(line) for line in lines]
        starts = [np.arctan2(*(g[-1] - g[0])[::-1]) for g in grounds]

        def all_with(turn: float, lines: list[np.ndarray] = lines) -> np.ndarray:
            return np.concatenate([best_shift(guess, line, turn)[1] for line in lines])

        middle = float(np.median(np.unwrap(2 * np.array(starts)) / 2))
        found: Any = minimize_scalar(
            lambda t: rms(all_with(t)), bounds=(middle - 0.3, middle + 0.3), method="bounded"
        )
        together.append(all_with(float(found.x)))
        for line, start in zip(lines, starts, strict=True):
            answer = minimize(
                lambda x, line=line: rms(best_shift(guess, line, float(x[0]))[1]),
                [start],
                method="Nelder-Mead",
            )
            single.append(best_shift(guess, line, float(answer.x[0]))[1])
    return rms(np.concatenate(together)), rms(np.concatenate(single))


def best_shift(guess: View, line: np.ndarray, turn: float) -> tuple[float, np.ndarray]:
    """The shift of a ground line at a turn that brings it nearest to pixels, and its distances from them."""
    ground = guess.ground_under(line)
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    shifts = ground @ across

    def distances(shift: float) -> np.ndarray:
        on = (ground @ along)[:, None] * along + shift * across
        a, b = guess.project(on - 1e-3 * along), guess.project(on + 1e-3 * along)
        c = guess.camera
        if not np.isfinite(a).all() or not np.isfinite(b).all():
            return np.full(len(line), float(c.width))
        way = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
        return way[:, 0] * (line - a)[:, 1] - way[:, 1] * (line - a)[:, 0]

    spread = max(float(np.ptp(shifts)), 1e-6)
    found: Any = minimize_scalar(
        lambda s: float(np.sum(distances(s) ** 2)),
        bounds=(float(shifts.min()) - spread, float(shifts.max()) + spread),
        method="bounded",
        options={"xatol": 1e-7},
    )
    return float(found.x), distances(float(found.x))


@dataclass(frozen=True)
class Compared:
    """One photo: distances of rendered lines from the true joints in pixels, and the best by hand."""

    name: str
    size: tuple[int, int]
    rms_px: float
    worst_px: float
    check_px: float | None
    lines: int
    one_turn_px: float
    each_free_px: float
    seconds: float


def compare(validation: Validation, folder: Path) -> Compared | str:
    """The lines of autoreg and the best by hand on one photo; else the refusal's words."""
    path = write_photo(validation, folder)
    scene = scene_of(validation.photo)
    job = Job(
        path, folder / f"{validation.name}.out", folder / "camera.json", validation.crop, scene.paving.slab_m
    )
    begun = time.monotonic()
    outcome = run_job(job, Listener(note=lambda text: None, doing=lambda text: None))
    took = time.monotonic() - begun
    if outcome.alignment is None:
        return f"{validation.name} was refused: {outcome.refusal}"
    found: Alignment = outcome.alignment
    truth = View(validation.true_camera(), scene.cam_from_ground)
    ours = View(found.camera.camera, found.pose.cam_from_ground)
    away = [
        distance_to_true_joints_px(line, truth, scene.paving.slab_m)
        for line in visible_lines(ours, found.lattice)
    ]
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert picture is not None
    plan = make_plan(Wish(lines=True), read_wish(Wish()), found, picture, path)
    check = check_render(choose_engine("auto", folder), plan)
    field = true_field(ours, found.lattice, truth)
    lattice = Lattice("stack", *scene.paving.slab_m, 0.0, scene.paving.joint_m, field)
    one_turn, each_free = by_hand_px(truth, lattice)
    return Compared(
        validation.name,
        (truth.camera.width, truth.camera.height),
        rms(np.concatenate(away)),
        float(max(a.max() for a in away)),
        None if check is None else check.rms_px,
        len(away),
        one_turn,
        each_free,
        took,
    )


def true_field(ours: View, lattice: Lattice, truth: View) -> np.ndarray:
    """The field of the found lattice, in the true ground frame."""
    px, _ = ours.polylines(np.stack([lattice.extent, np.roll(lattice.extent, -1, axis=0)], 1), 8)
    ground = truth.ground_under(px.reshape(-1, 2))
    ground = ground[np.isfinite(ground).all(1)]
    low, high = ground.min(0), ground.max(0)
    return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
