"""Synthetic photos of paving for the tests of the core, and how far a pose is from the truth of one."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine
from autoreg.geometry import Rigid, angle_between_rotations, rotation_from_vector
from autoreg.ground.sides import Grid
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticPhoto, SyntheticScene, look_at_ground

CAMERA = Camera(640, 480, 560.0, 562.0, 316.0, 242.0)
STACK = SyntheticScene(
    camera=CAMERA,
    cam_from_ground=look_at_ground(pitch_deg=38.0, height_m=1.6, heading_deg=20.0, foot_m=(0.13, 0.21)),
    spacing_m=(0.6, 0.4),
    seed=1,
)
HALF_BOND = replace(STACK, spacing_m=(0.6, 0.3), shift=0.5, seed=2)
THIRD_BOND = replace(STACK, spacing_m=(0.6, 0.3), shift=1 / 3, seed=3)
CHECKER = replace(
    STACK,
    spacing_m=(0.4, 0.4),
    slab_tone=190.0,
    second_tone=70.0,
    joint_width_m=0.001,
    joint_tone=130.0,
    seed=4,
)
GRAVEL = replace(STACK, kind="gravel", seed=6)
POSE_ALONE = Free()


def gray_of(photo: SyntheticPhoto) -> np.ndarray:
    """Grey levels of a photo as the core takes them."""
    pixels = photo.pixels if photo.pixels.ndim == 2 else photo.pixels.mean(-1)
    return np.ascontiguousarray(pixels, dtype=np.float32)


def nudged(pose: Rigid, turn_deg: float, move_m: float, seed: int = 0) -> Rigid:
    """The pose after a small motion of the camera in a random direction."""
    rng = np.random.default_rng(seed)
    axis, way = rng.standard_normal((2, 3))
    turn = rotation_from_vector(np.deg2rad(turn_deg) * axis / np.linalg.norm(axis))
    return Rigid(turn @ pose.R, turn @ pose.t + move_m * way / np.linalg.norm(way))


def true_grid(photo: SyntheticPhoto) -> Grid:
    """The lattice that a photo was drawn by."""
    lattice = photo.lattice
    assert lattice is not None
    assert lattice.spacing_x is not None
    assert lattice.shift is not None
    return Grid(lattice.spacing_x, lattice.spacing_y, lattice.shift)


def fit_of(photo: SyntheticPhoto, free: Free = POSE_ALONE) -> Fit:
    """The refined fit of a photo, started a little off its true pose."""
    start = nudged(photo.cam_from_ground, turn_deg=0.2, move_m=0.005)
    fit = refine(
        gray_of(photo), photo.camera, start, true_grid(photo), free=free, search=0.1, reaches=(3.0, 6.0, 9.0)
    )
    assert fit is not None
    return fit


def symmetric_poses(pose: Rigid, grid: Grid) -> list[Rigid]:
    """`cam_from_ground` for every frame, up to whole slabs, in which the lattice looks as it does here.

    A stack has all quarter turns about a crossing, the sides changing roles at odd ones; a running bond has
    half turns, about the T-joint of row -1, because row 0 lies on the other side afterwards.
    """
    a = grid.spacing_x or grid.spacing_y
    poses: list[Rigid] = []
    for q in range(4):
        if q % 2 and grid.shift:
            continue
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[q]
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], float)
        origin = np.array([-grid.shift * a if q == 2 else 0.0, 0.0, 0.0])
        poses.append(Rigid(pose.R @ turn, pose.t + pose.R @ origin))
    return poses


def nearest_pose(found: Rigid, photo: SyntheticPhoto) -> Rigid:
    """The true pose in the frame nearest to a found one, of those in which the lattice looks alike."""
    grid, poses = true_grid(photo), list[Rigid]()
    a, b = grid.spacing_x or grid.spacing_y, grid.spacing_y
    for pose in symmetric_poses(photo.cam_from_ground, grid):
        away = pose.R.T @ (found.t - pose.t)
        row = np.round(away[1] / b)
        column = np.round(away[0] / a - row * grid.shift) + row * grid.shift
        poses.append(Rigid(pose.R, pose.t + pose.R @ np.array([column * a, row * b, 0.0])))
    return min(poses, key=lambda pose: angle_between_rotations(found.R, pose.R))


def misses(found: Rigid, spacing: tuple[float, float], photo: SyntheticPhoto) -> tuple[float, float]:
    """Angle in degrees to the nearest equivalent of the true frame, and RMS pixels of the crossings.

    The crossings are those that the photo shows near the camera; each is compared with the crossing of the
    found lattice that lies nearest to where its pixel meets the found ground.
    """
    truth = true_grid(photo)
    equivalents = symmetric_poses(photo.cam_from_ground, truth)
    best = min(equivalents, key=lambda pose: angle_between_rotations(found.R, pose.R))
    angle = float(np.rad2deg(angle_between_rotations(found.R, best.R)))
    a, b = spacing
    _, pixels = photo.crossings(margin_px=20.0, reach_m=3.5 * photo.cam_from_ground.origin_in_a[2])
    rays = photo.camera.unproject(pixels) @ found.R
    eye = found.origin_in_a
    ground = eye[:2] - rays[:, :2] * (eye[2] / rays[:, 2:])
    row = np.round(ground[:, 1] / b)
    moved = row * truth.shift
    column = np.round(ground[:, 0] / a - moved) + moved
    crossings = np.column_stack([column * a, row * b, np.zeros(len(row))])
    off = photo.camera.project(found.apply(crossings)) - pixels
    return angle, float(np.sqrt(np.mean((off**2).sum(1))))


def board_in_a_room(
    photo: SyntheticPhoto, low_m: np.ndarray, high_m: np.ndarray, seed: int = 5
) -> np.ndarray:
    """Grey photo of which only a box of the ground is left; the rest is covered by boxes of all tones."""
    rng = np.random.default_rng(seed)
    height, width = photo.pixels.shape[:2]
    corners = np.array([low_m, [high_m[0], low_m[1]], high_m, [low_m[0], high_m[1]]])
    shown = np.zeros((height, width), np.uint8)
    cv2.fillPoly(shown, [np.int32(np.round(16 * photo.project(corners)))], 255, cv2.LINE_AA, 4)
    room = np.full((height, width), 110.0)
    for _ in range(60):
        box = (
            rng.uniform((0, 0), (width, height)).tolist(),
            rng.uniform(15, 120, 2).tolist(),
            rng.uniform(0, 180),
        )
        cv2.fillPoly(room, [np.int32(cv2.boxPoints(box))], rng.uniform(30, 220), cv2.LINE_AA)
    room = cv2.GaussianBlur(room, (0, 0), 1.0) + rng.normal(0, 2, (height, width))
    share = cv2.GaussianBlur(shown, (0, 0), 0.6) / 255.0
    return np.clip(np.rint(gray_of(photo) * share + room * (1 - share)), 0, 255).astype(np.uint8)
