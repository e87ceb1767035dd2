"""What others would do in the last stage: LSD segments matched with the joints' edges, and a line solver.

Every peer gets the same segments and the same rounds of matching, from the same start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.optimize import least_squares

from autoreg.camera import Camera
from autoreg.geometry import Rigid, rotation_from_vector
from autoreg.ground.points import project_ground
from autoreg.solve.joint_data import JointData, parameter_scale
from autoreg.solve.solver import CAUCHY_SIGMAS
from autoreg.synthetic import SyntheticScene

# How far an edge is looked for in each round of matching, in pixels; and the scale of the Cauchy loss. LSD
# puts each edge of a narrow joint up to 0.3 px outwards. A loss of 0.5 px may then hold on to one edge of the
# joints and let the other go: PoseLib's pose was 0.19 px off on a picture where it is 0.013 px off with 1 px.
GATES_PX = (20.0, 8.0, 4.0, 2.0, 2.0)
LOSS_PX = 1.0
# An edge may only be taken where its nearest rival is this many gates away.
CLEAR = 2.5
SHORTEST_PX = 12.0


@dataclass(frozen=True)
class Edges:
    """Segments with the joint edges on the ground that they are taken for: two points of each."""

    ends_px: Float[np.ndarray, "n 2 2"]
    ground: Float[np.ndarray, "n 2 2"]

    def __len__(self) -> int:
        return len(self.ends_px)


def lsd_segments(
    gray: UInt8[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "n 2 2"], Float[np.ndarray, " n"]]:
    """OpenCV's LSD segments at scale 1.0, and on which side each is dark: +1 if left of its way."""
    found = cv2.createLineSegmentDetector(scale=1.0).detect(gray)[0]
    ends = np.asarray(found, float).reshape(-1, 2, 2)
    way = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(way, axis=1)
    ends, way = ends[length > SHORTEST_PX], way[length > SHORTEST_PX]
    normal = np.stack([way[:, 1], -way[:, 0]], 1) / np.linalg.norm(way, axis=1, keepdims=True)
    fraction = np.linspace(0.15, 0.85, 15)
    along = ends[:, :1] + fraction[:, None] * way[:, None]
    tone = [_sampled(gray, along + side * 1.5 * normal[:, None]).mean(1) for side in (1.0, -1.0)]
    return ends, np.sign(tone[1] - tone[0])


def _sampled(gray: np.ndarray, px: np.ndarray) -> np.ndarray:
    at = np.ascontiguousarray(px, np.float32)
    picture = gray.astype(np.float32)
    return cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def match_edges(
    ends_px: Float[np.ndarray, "n 2 2"],
    dark: Float[np.ndarray, " n"],
    scene: SyntheticScene,
    pose: Rigid,
    gate_px: float,
) -> Edges:
    """The segments along an edge of a dark joint of a stack bond, within `gate_px` of its projection."""
    camera, half = scene.camera, 0.5 * scene.joint_width_m
    ground = _ground_under(camera, pose, ends_px)
    eye = pose.origin_in_a
    way, middle = ground[:, 1] - ground[:, 0], ground.mean(1)
    family = (np.abs(way[:, 1]) > np.abs(way[:, 0])).astype(int)  # 0 along X, 1 along Y
    rows, across = np.arange(len(ends_px)), 1 - family
    pitch = np.array([scene.spacing_m[1], scene.spacing_m[0]])[family]
    line = np.round(middle[rows, across] / pitch)
    # On which side of the segment, on the ground, it is dark: an edge with the dark side at growing
    # coordinates begins a joint. The picture shows the ground mirrored or not, which the pose knows.
    left_px = np.stack([ends_px[..., 1], -ends_px[..., 0]], -1)
    left_px = left_px[:, 1] - left_px[:, 0]
    left_px /= np.linalg.norm(left_px, axis=1, keepdims=True)
    beside = _ground_under(camera, pose, ends_px.mean(1) + left_px)
    dark_grows = np.sign((beside - middle)[rows, across]) * dark
    place = line * pitch - dark_grows * half
    points = np.repeat(middle[:, None], 2, 1)
    points[rows, 0, family], points[rows, 1, family] = ground[rows, 0, family], ground[rows, 1, family]
    points[rows[:, None], np.arange(2), across[:, None]] = place[:, None]
    off = np.abs(_distances(camera, pose, ends_px, points)).max(1)
    beyond = points.copy()
    beyond[rows[:, None], np.arange(2), across[:, None]] += pitch[:, None]
    room = np.abs(_distances(camera, pose, ends_px, beyond)).min(1)
    near = np.linalg.norm(middle - eye[:2], axis=1) < 12 * eye[2]
    with np.errstate(invalid="ignore"):
        kept = np.flatnonzero(near & (off < gate_px) & (room > CLEAR * gate_px) & (dark != 0))
    return Edges(ends_px[kept], points[kept])


def _ground_under(camera: Camera, pose: Rigid, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    rays = camera.unproject(px.reshape(-1, 2)) @ pose.R
    eye = pose.origin_in_a
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(rays[:, 2] < 0, -eye[2] / rays[:, 2], np.nan)
    return (eye[:2] + rays[:, :2] * reach[:, None]).reshape(px.shape)


def _distances(
    camera: Camera, pose: Rigid, ends_px: np.ndarray, ground: np.ndarray
) -> Float[np.ndarray, "n 2"]:
    """Signed distance of both ends from the projected line through two ground points."""
    a, b = project_ground(camera, pose, ground[:, 0]), project_ground(camera, pose, ground[:, 1])
    way = b - a
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.stack([-way[:, 1], way[:, 0]], 1) / np.linalg.norm(way, axis=1, keepdims=True)
    return ((ends_px - a[:, None]) * normal[:, None]).sum(-1)


Solve = Callable[[Edges, Camera, Rigid], Rigid]


def refine_with(
    solve: Solve, segments: tuple[np.ndarray, np.ndarray], scene: SyntheticScene, start: Rigid
) -> Rigid | None:
    """The pose by a peer's refinement: match, solve, match more narrowly; None if too little matches."""
    pose = start
    for gate in GATES_PX:
        edges = match_edges(*segments, scene, pose, gate)
        if len(edges) < 6:
            return None
        pose = solve(edges, scene.camera, pose)
    return pose


def solve_poselib(edges: Edges, camera: Camera, start: Rigid) -> Rigid:
    """PoseLib's bundle refinement of a pose from lines: its loss takes both ends of a segment together."""
    import poselib  # an optional peer

    known = {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }
    first = poselib.CameraPose()
    first.R, first.t = start.R, start.t
    ground = np.concatenate([edges.ground, np.zeros((len(edges), 2, 1))], -1)
    none2, none3 = np.zeros((0, 2)), np.zeros((0, 3))
    options = {"loss_type": "CAUCHY", "loss_scale": LOSS_PX, "max_iterations": 100}
    found, _ = poselib.refine_absolute_pose_pnpl(
        none2, none3, edges.ends_px[:, 0], edges.ends_px[:, 1], ground[:, 0], ground[:, 1], first, known,
        options, options,
    )  # fmt: skip
    return Rigid(np.asarray(found.R, float), np.asarray(found.t, float))


def solve_scipy(edges: Edges, camera: Camera, start: Rigid) -> Rigid:
    """SciPy's robust least squares on the same distances, each end with a loss of its own."""

    def pose_at(x: np.ndarray) -> Rigid:
        turn = rotation_from_vector(x[:3])
        return Rigid(turn @ start.R, turn @ start.t + x[3:])

    def residual(x: np.ndarray) -> np.ndarray:
        return np.nan_to_num(_distances(camera, pose_at(x), edges.ends_px, edges.ground), nan=1e3).ravel()

    done = least_squares(residual, np.zeros(6), loss="cauchy", f_scale=LOSS_PX, x_scale="jac")
    return pose_at(cast(np.ndarray, done.x))


def as_joint_data(edges: Edges, camera: Camera, start: Rigid) -> JointData:
    """The same segments as a problem of autoreg's own solver: both ends of each, against its line."""
    a, b = (
        project_ground(camera, start, edges.ground[:, 0]),
        project_ground(camera, start, edges.ground[:, 1]),
    )
    way = b - a
    normal = np.stack([-way[:, 1], way[:, 0]], 1) / np.linalg.norm(way, axis=1, keepdims=True)
    height = float(start.origin_in_a[2])
    return JointData(
        ground=edges.ground.reshape(-1, 2),
        measured_px=edges.ends_px.reshape(-1, 2),
        normal=np.repeat(normal, 2, axis=0),
        weight=np.full(2 * len(edges), 1.0 / (CAUCHY_SIGMAS * LOSS_PX)),
        R=start.R,
        t=start.t,
        intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist]),
        scale=parameter_scale(height, camera.fx),
    )
