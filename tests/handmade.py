"""Alignments made by hand, for what comes after the pipeline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autoreg.alignment import Alignment, CameraReport, JointFit, Pose, Residual
from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.lattice import Lattice
from autoreg.rendering.demo import demo_objects
from autoreg.rendering.engine import Plan
from autoreg.rendering.objects import CastShadow, Light, Scene
from autoreg.rendering.render import plan_render
from autoreg.rendering.staging import stage
from autoreg.rendering.sun import Sun
from autoreg.view import View

LENS = (-0.18, 0.05, 0.0006, -0.0009)


def looking(eye: list[float], target: list[float], roll_rad: float = 0.0) -> Rigid:
    """`cam_from_ground` of a camera at `eye` that looks at `target`."""
    forward = np.subtract(target, eye).astype(float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    R = np.stack([c * right + s * down, -s * right + c * down, forward])
    return Rigid(R, -R @ np.asarray(eye, float))


def extent(reach: float = 4.0) -> np.ndarray:
    """A square of ground around the origin."""
    return reach * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


STACK = Lattice("stack", 0.6, 0.4, 0.0, 0.008, extent())
RUNNING = Lattice("running", 0.6, 0.3, 0.5, 0.006, extent())
ROWS = Lattice("rows", None, 0.4, None, 0.008, extent())
CAMERA = Camera(640, 480, 610.0, 604.0, 331.0, 228.0)
POSE = looking([-0.6, -2.6, 1.6], [0.2, 0.3, 0.0], 0.05)


def alignment(
    lattice: Lattice = STACK, camera: Camera = CAMERA, pose: Rigid = POSE, *, consistent: bool | None = True
) -> Alignment:
    """An aligned photo whose fit is exact."""
    view = View(camera, pose)
    a = lattice.spacing_x or lattice.spacing_y
    ends_x = view.project(np.array([[-0.5, 0.0], [0.5, 0.0]]))
    joints = [JointFit("x", 0, ends_x, 0.2)]
    if lattice.spacing_x is not None:
        ends_y = view.project(np.array([[a, 0.0], [a, 0.9 * lattice.spacing_y]]))
        joints.append(JointFit("y", 1, ends_y, 0.3))
    return Alignment(
        camera.width,
        camera.height,
        CameraReport(camera, "file", consistent, 650.0, 12.0),
        Pose(pose, 1e-6 * np.eye(6)),
        "slab",
        lattice,
        Residual(0.21, 0.15, 0.4, len(joints), 321, 0.93),
        tuple(joints),
    )


def distorted(camera: Camera = CAMERA) -> Camera:
    """The same camera with a lens that bends."""
    return replace(camera, dist=LENS)


def photo_for(camera: Camera = CAMERA) -> np.ndarray:
    """A picture (BGR) in which no two neighbouring pixels are alike."""
    rng = np.random.default_rng(5)
    return rng.integers(40, 220, (camera.height, camera.width, 3)).astype(np.uint8)


def plan_for(
    scene: Scene | None = None, found: Alignment | None = None, photo: np.ndarray | None = None
) -> Plan:
    """What an engine draws: the demo objects if no scene is given."""
    found = found or alignment()
    view = View(found.camera.camera, found.pose.cam_from_ground)
    if scene is None:
        scene = Scene(demo_objects(view, found.lattice), Light(exposure=0.7))
    photo = photo_for(view.camera) if photo is None else photo
    return plan_render(found, stage(scene, view, found.lattice, photo), photo)


def shadow_of(
    foot: tuple[float, float],
    height: float,
    azimuth_deg: float,
    elevation_deg: float,
    view: View | None = None,
    lean: tuple[float, float] = (0.0, 0.0),
) -> CastShadow:
    """The pixels of a post and of its shadow."""
    view = view or View(CAMERA, POSE)
    top = np.array([*np.add(foot, lean), height])
    to_sun = Sun(azimuth_deg, elevation_deg, "given").direction
    tip = top - top[2] / to_sun[2] * to_sun
    px = view.camera.project(view.cam_from_ground.apply(np.array([[*foot, 0.0], top, tip])))
    return CastShadow(*map(tuple, px.tolist()))
