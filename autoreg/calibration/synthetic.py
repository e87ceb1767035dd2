"""Photos of calibration boards with exact truth, to test with or to try calibration before printing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.interpolate import RectBivariateSpline

from autoreg.calibration.board import Board
from autoreg.camera import Camera
from autoreg.geometry import Rigid

# Tones of print, paper and what lies behind the sheet, in grey levels.
_BLACK, _WHITE, _BEHIND = 40.0, 215.0, 120.0
_MARGIN_SQUARES = 1.0
_MARKER_PX = 64
# Rays are worked out at every eighth pixel and interpolated by a bicubic spline, good to a millionth pixel.
_RAY_STEP_PX = 8


@dataclass(frozen=True)
class BoardScene:
    """A board before a camera.

    Attributes:
        bend: heights of the sheet's bow as parts of its half length: z = a u² + b u v + c v² over `centred`.
        blur_px: standard deviation of the lens's and the sensor's point spread.
        noise_grey: standard deviation of the sensor's noise in grey levels.
        samples: sub-pixels per pixel and direction.
    """

    camera: Camera
    board: Board
    cam_from_board: Rigid
    bend: tuple[float, float, float] = (0.0, 0.0, 0.0)
    blur_px: float = 0.7
    noise_grey: float = 2.0
    samples: int = 2
    seed: int = 0


def bent_points(board: Board, bend: tuple[float, float, float]) -> Float[np.ndarray, "n 3"]:
    """Places of the inner corners on a sheet bent by `bend`."""
    u, v = board.centred.T
    reach = (max(board.columns, board.rows) - 1) / 2 * board.square
    points = board.points.copy()
    points[:, 2] = reach * (bend[0] * u * u + bend[1] * u * v + bend[2] * v * v)
    return points


def true_corners(scene: BoardScene) -> Float[np.ndarray, "n 2"]:
    """Where the scene's inner corners are in its photo, exactly."""
    return scene.camera.project(scene.cam_from_board.apply(bent_points(scene.board, scene.bend)))


def render_board(scene: BoardScene) -> UInt8[np.ndarray, "h w"]:
    """The photo of a scene: every pixel is the mean of sub-pixels, each seen through the exact camera."""
    camera = scene.camera
    rng = np.random.default_rng(scene.seed)
    # Light that falls off to one side, so that no threshold suits the whole picture.
    U, V = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    picture = np.full(U.shape, _BEHIND)
    window = _window(scene)
    if window is not None:
        picture[window] = _seen(scene, U[window], V[window])
    angle = rng.uniform(0, 2 * np.pi)
    across = (np.cos(angle) * (U / camera.width - 0.5) + np.sin(angle) * (V / camera.height - 0.5)) * 0.25
    picture = picture * (1 - across)
    if scene.blur_px > 0:
        picture = cv2.GaussianBlur(picture, (0, 0), scene.blur_px)
    picture = picture + scene.noise_grey * rng.standard_normal(picture.shape, np.float32)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def random_pose(
    camera: Camera,
    board: Board,
    rng: np.random.Generator,
    *,
    most_tilt_deg: float = 40.0,
    fill: tuple[float, float] = (0.35, 0.8),
) -> Rigid:
    """A pose with every corner well inside the picture: tilted at random, anywhere, small or large.

    Args:
        camera: the camera that will look.
        board: what it will look at.
        rng: where chance comes from.
        most_tilt_deg: largest angle between the sheet's normal and the line of sight.
        fill: range of the board's size as a part of the picture's.

    Raises:
        ValueError: no such pose was found.
    """
    margin = 0.02 * min(camera.width, camera.height) + 3
    for _ in range(2000):
        pose = _tilted_pose(camera, board, rng, most_tilt_deg, rng.uniform(*fill))
        px = camera.project(pose.apply(board.points))
        inside = (px >= margin) & (px <= [camera.width - 1 - margin, camera.height - 1 - margin])
        if inside.all():
            return pose
    raise ValueError(f"no pose shows a {board.pattern} board within {camera.width} x {camera.height} pixels")


def _tilted_pose(
    camera: Camera, board: Board, rng: np.random.Generator, most_tilt_deg: float, size: float
) -> Rigid:
    tilt = np.deg2rad(most_tilt_deg) * np.sqrt(rng.uniform())
    about = rng.uniform(0, 2 * np.pi)
    lean = cv2.Rodrigues(tilt * np.array([np.cos(about), np.sin(about), 0.0]))[0]
    roll = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-0.4, 0.4) + rng.integers(0, 4) * np.pi / 2]))[0]
    distance = board.diagonal * camera.fx / (size * np.hypot(camera.width, camera.height))
    px = rng.uniform(0.1, 0.9, 2) * [camera.width, camera.height]
    middle_cam = distance * np.array([(px[0] - camera.cx) / camera.fx, (px[1] - camera.cy) / camera.fy, 1.0])
    R = np.asarray(lean @ roll)
    return Rigid(R, middle_cam - R @ board.points.mean(0))


def _window(scene: BoardScene) -> tuple[slice, slice] | None:
    """The part of the picture that may show the sheet."""
    b, m = scene.board, _MARGIN_SQUARES + 1.5
    side = np.linspace(-m, b.columns - 1 + m, 40), np.linspace(-m, b.rows - 1 + m, 40)
    sheet = np.stack(np.meshgrid(*side), -1).reshape(-1, 2) * b.square
    px = scene.camera.project(scene.cam_from_board.apply(np.column_stack([sheet, 0 * sheet[:, 0]])))
    if not np.isfinite(px).all():
        return slice(None), slice(None)
    low = np.maximum(np.floor(px.min(0)).astype(int) - 4, 0)
    high = np.minimum(np.ceil(px.max(0)).astype(int) + 5, [scene.camera.width, scene.camera.height])
    if (low >= high).any():
        return None
    return slice(low[1], high[1]), slice(low[0], high[0])


def _seen(scene: BoardScene, U: np.ndarray, V: np.ndarray) -> np.ndarray:
    """Tones of the pixels (U, V) before blur and noise."""
    total = np.zeros(U.shape)
    ray_x, ray_y = _ray_splines(scene.camera)
    offsets = (np.arange(scene.samples) + 0.5) / scene.samples - 0.5
    markers = _marker_texture(scene.board)
    for du in offsets:
        for dv in offsets:
            u, v = U[0] + du, V[:, 0] + dv
            x, y = _sheet_coordinates(scene, np.stack([ray_x(v, u), ray_y(v, u)], -1))
            total += _tone(scene, x, y, markers)
    return total / scene.samples**2


@lru_cache(maxsize=4)
def _ray_splines(camera: Camera) -> tuple[RectBivariateSpline, RectBivariateSpline]:
    """Ideal normalised x and y as functions of (row, column)."""
    u = np.arange(-_RAY_STEP_PX, camera.width + 2 * _RAY_STEP_PX, _RAY_STEP_PX, dtype=float)
    v = np.arange(-_RAY_STEP_PX, camera.height + 2 * _RAY_STEP_PX, _RAY_STEP_PX, dtype=float)
    xy = camera.normalise(np.stack(np.meshgrid(u, v), -1))
    if np.isnan(xy).any():
        raise ValueError(f"the distortion {camera.dist} cannot be inverted over the whole picture")
    return RectBivariateSpline(v, u, xy[..., 0]), RectBivariateSpline(v, u, xy[..., 1])


def _sheet_coordinates(
    scene: BoardScene, xy: Float[np.ndarray, "h w 2"]
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Where rays meet the sheet, in squares from the first inner corner; NaN behind the camera."""
    b, pose, shape = scene.board, scene.cam_from_board, xy.shape[:2]
    rays = np.concatenate([xy, np.ones((*shape, 1))], -1).reshape(-1, 3) @ pose.R
    eye = pose.origin_in_a
    reach = (max(b.columns, b.rows) - 1) / 2 * b.square
    middle = np.array([b.columns - 1, b.rows - 1]) / 2 * b.square
    height = np.zeros(len(rays))
    along, xy_sheet = height, np.zeros((len(rays), 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        # A gentle bow: the height where the ray met the last height's plane converges in a few steps.
        for _ in range(1 if not any(scene.bend) else 12):
            along = (height - eye[2]) / rays[:, 2]
            xy_sheet = eye[:2] + along[:, None] * rays[:, :2]
            p, q = (np.clip((xy_sheet - middle) / reach, -2, 2)).T
            height = reach * (scene.bend[0] * p * p + scene.bend[1] * p * q + scene.bend[2] * q * q)
    squares = np.where((along > 0)[:, None], xy_sheet, np.nan) / b.square
    return squares[:, 0].reshape(shape), squares[:, 1].reshape(shape)


def _tone(scene: BoardScene, x: np.ndarray, y: np.ndarray, markers: np.ndarray | None) -> np.ndarray:
    b = scene.board
    sx, sy = _wave(x, _step(x, 1) / scene.samples), _wave(y, _step(y, 0) / scene.samples)
    tone = (_WHITE + _BLACK) / 2 - (_WHITE - _BLACK) / 2 * sx * sy
    if markers is not None:
        tone = np.where(_marker_black(b, x, y, markers), _BLACK, tone)
    printed = (x > -1) & (x < b.columns) & (y > -1) & (y < b.rows)
    m = 1 + _MARGIN_SQUARES
    paper = (x > -m) & (x < b.columns - 1 + m) & (y > -m) & (y < b.rows - 1 + m)
    return np.where(printed, tone, np.where(paper, _WHITE, _BEHIND))


def _step(x: np.ndarray, axis: int) -> np.ndarray:
    """Width of a pixel's footprint along one coordinate of the sheet."""
    per_row, per_column = np.gradient(x)
    return np.maximum(np.hypot(per_row, per_column), 1e-9)


def _wave(x: np.ndarray, width: np.ndarray) -> np.ndarray:
    """+1 on (-1, 0), -1 on (0, 1) and so on by turns, averaged over `width`: the edges along one axis."""

    def triangle(t: np.ndarray) -> np.ndarray:
        # An antiderivative of the wave.
        return np.abs((t + 1) % 2 - 1) * -1.0

    return (triangle(x + width / 2) - triangle(x - width / 2)) / width


def _marker_texture(board: Board) -> np.ndarray | None:
    if board.kind != "charuco":
        return None
    size = ((board.columns + 1) * _MARKER_PX, (board.rows + 1) * _MARKER_PX)
    return np.asarray(board.charuco().generateImage(size, marginSize=0, borderBits=1))


def _marker_black(board: Board, x: np.ndarray, y: np.ndarray, texture: np.ndarray) -> np.ndarray:
    """Where a marker is black; the squares themselves are drawn by `_wave`."""
    column = np.nan_to_num(np.floor((x + 1) * _MARKER_PX), nan=-1).astype(int)
    row = np.nan_to_num(np.floor((y + 1) * _MARKER_PX), nan=-1).astype(int)
    inside = (column >= 0) & (column < texture.shape[1]) & (row >= 0) & (row < texture.shape[0])
    black = np.zeros(x.shape, bool)
    black[inside] = texture[row[inside], column[inside]] < 128
    # Only what is well inside a white square is a marker.
    fx, fy = np.abs((x % 1) - 0.5), np.abs((y % 1) - 0.5)
    white = (np.floor(x) + np.floor(y)) % 2 != 0
    return black & white & (np.maximum(fx, fy) < board.marker / 2 + 0.01)
