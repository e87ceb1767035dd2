"""What a synthetic photo shows, and what comes out of drawing it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.lattice import Lattice
from autoreg.synthetic.poses import look_at_ground

GroundKind = Literal["lattice", "rows", "planks", "crazy", "gravel"]


def _default_camera() -> Camera:
    return Camera(1024, 768, 900.0, 900.0, 511.5, 383.5)


def _default_pose() -> Rigid:
    return look_at_ground(pitch_deg=38.0, height_m=1.6, heading_deg=20.0, foot_m=(0.13, 0.21))


@dataclass(frozen=True)
class SyntheticScene:
    """A paved ground seen by a camera.

    Attributes:
        camera: the camera that takes the photo, distortion included.
        cam_from_ground: its pose; the ground frame is the lattice frame.
        kind: how the ground is laid; "rows" has unbroken joints along X only and cross joints at random,
            "planks" no cross joints at all, "crazy" and "gravel" no lattice.
        spacing_m: spacing of the joint centre lines along X and Y; the size of the stones of "crazy".
        shift: part of a slab by which each row moves along +X; 0 is a stack bond.
        joint_width_m: width of the joints.
        joint_tone: grey level of the joints.
        slab_tone: mean grey level of the slabs.
        second_tone: grey level of every other slab of a chessboard, or None.
        sky_tone: grey level above the horizon.
        tone_spread: standard deviation of the slabs' tone, relative.
        texture: standard deviation of the stone's texture, relative.
        jitter_m: standard deviation of each slab's place along X and along Y; it must stay under a fifth of
            the joint's width, so that slabs do not touch.
        course_jitter_m: standard deviation of the place of each whole line of slabs, besides; together they
            must stay under that fifth.
        course_drift_m: standard deviation by which each course along X goes away from nine tenths of where
            the one before has drifted to ("lattice" and "planks"); at most that fifth.
        joint_depth_m: how deep the bed of the joints of "lattice" lies under the slabs' tops; 0 paints flat
            joints, whatever the sun.
        chamfer_m: how far the rims beside sunk joints are bevelled, at 45 degrees, at most 0.9 of the depth.
        lift_m: standard deviation of each slab's height (at most 2.5 times that), at most 0.4 of the joints'
            depth, so that no slab sinks under the bed.
        slab_turn_rad: standard deviation of each slab's turn about its middle ("lattice").
        sun_azimuth_rad: direction on the ground towards the sun, counter-clockwise from +X.
        sun_elevation_rad: how high the sun stands, up to pi/2.
        sky_light: share of the light on level ground that comes from the sky, not from the sun; 1 is flat
            light.
        turn_rad: standard deviation of the direction of each cross joint of "rows".
        lean_rad: what all cross joints of "rows" are off square by, towards +X.
        shadows: number of cast shadows (hard edges, three sides).
        shade: tone in the shadow, relative.
        clutter: number of flat discs and boxes that lie on the ground.
        blur_px: standard deviation of the lens's point spread.
        noise_grey: standard deviation of the sensor's noise, grey levels.
        colour: BGR picture instead of a grey one.
        samples: samples along each side of a pixel.
        seed: everything random comes from it.
    """

    camera: Camera = field(default_factory=_default_camera)
    cam_from_ground: Rigid = field(default_factory=_default_pose)
    kind: GroundKind = "lattice"
    spacing_m: tuple[float, float] = (0.4, 0.4)
    shift: float = 0.0
    joint_width_m: float = 0.01
    joint_tone: float = 60.0
    slab_tone: float = 150.0
    second_tone: float | None = None
    sky_tone: float = 205.0
    tone_spread: float = 0.04
    texture: float = 0.03
    jitter_m: float = 0.0
    course_jitter_m: float = 0.0
    course_drift_m: float = 0.0
    turn_rad: float = 0.0
    lean_rad: float = 0.0
    joint_depth_m: float = 0.0
    chamfer_m: float = 0.0
    lift_m: float = 0.0
    slab_turn_rad: float = 0.0
    sun_azimuth_rad: float = 0.0
    sun_elevation_rad: float = 0.8
    sky_light: float = 0.4
    shadows: int = 0
    shade: float = 0.45
    clutter: int = 0
    blur_px: float = 0.5
    noise_grey: float = 1.5
    colour: bool = True
    samples: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.spacing_m) <= self.joint_width_m:
            raise ValueError(
                f"joint_width_m must be under the spacing {self.spacing_m} m, got {self.joint_width_m} m"
            )
        if math.hypot(self.jitter_m, self.course_jitter_m) > 0.2 * self.joint_width_m:
            raise ValueError(
                "jitter_m and course_jitter_m together must be at most a fifth of joint_width_m = "
                f"{self.joint_width_m} m, got {self.jitter_m} m and {self.course_jitter_m} m"
            )
        if not 0 <= self.course_drift_m <= 0.2 * self.joint_width_m:
            raise ValueError(
                f"course_drift_m must be within 0 and a fifth of joint_width_m = {self.joint_width_m} m, got "
                f"{self.course_drift_m} m"
            )
        if self.course_drift_m and self.kind not in ("lattice", "planks"):
            raise ValueError(f"course_drift_m is drawn for 'lattice' and 'planks' only, got {self.kind!r}")
        if self.samples < 1:
            raise ValueError(f"samples must be at least 1, got {self.samples}")
        self._check_relief()

    def _check_relief(self) -> None:
        if self.joint_depth_m < 0:
            raise ValueError(f"joint_depth_m must not be negative, got {self.joint_depth_m} m")
        if not 0 <= self.chamfer_m <= 0.9 * self.joint_depth_m:
            raise ValueError(
                f"chamfer_m must be within 0 and 0.9 of joint_depth_m = {self.joint_depth_m} m, "
                f"got {self.chamfer_m} m"
            )
        if not 0 <= self.lift_m <= 0.4 * self.joint_depth_m:
            raise ValueError(
                f"lift_m must be within 0 and 0.4 of joint_depth_m = {self.joint_depth_m} m, "
                f"got {self.lift_m} m"
            )
        if self.has_relief and self.kind != "lattice":
            raise ValueError(
                f"joint_depth_m and slab_turn_rad are drawn for kind 'lattice' only, got {self.kind!r}"
            )
        if not 0 < self.sun_elevation_rad <= np.pi / 2:
            raise ValueError(
                f"sun_elevation_rad must be above 0 and at most pi/2, got {self.sun_elevation_rad}"
            )
        if not 0 <= self.sky_light <= 1:
            raise ValueError(f"sky_light must be within 0 and 1, got {self.sky_light}")

    @property
    def has_relief(self) -> bool:
        """Whether joints have a depth, or slabs are turned: both need the sides of single slabs."""
        return self.joint_depth_m > 0 or self.slab_turn_rad > 0


@dataclass(frozen=True)
class SyntheticPhoto:
    """A photo with its truth; `lattice` is None where the ground has none."""

    pixels: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"]
    camera: Camera
    cam_from_ground: Rigid
    lattice: Lattice | None

    def project(self, ground_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Pixels of ground points; NaN for points that are not in front of the camera."""
        points = np.column_stack([ground_m, np.zeros(len(ground_m))])
        return self.camera.project(self.cam_from_ground.apply(points))

    def crossings(
        self, *, margin_px: float = 0.0, reach_m: float = np.inf
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """Ground points and pixels of the joint crossings (i + j shift, j) that the photo shows.

        Args:
            margin_px: crossings nearer to the picture's edge are left out.
            reach_m: crossings farther from the camera are left out.
        """
        if self.lattice is None or self.lattice.spacing_x is None or self.lattice.shift is None:
            raise ValueError("crossings are defined for a lattice with a period along X and Y only")
        a, b = self.lattice.spacing_x, self.lattice.spacing_y
        eye = self.cam_from_ground.origin_in_a
        n = int(np.ceil(min(reach_m, 12 * eye[2] + 40 * max(a, b)) / min(a, b)))
        steps = np.arange(-n, n + 1)
        i, j = (g.ravel() for g in np.meshgrid(steps, steps + round(eye[1] / b)))
        moved = j * self.lattice.shift
        ground = np.column_stack([(i + np.round(eye[0] / a - moved) + moved) * a, j * b])
        pixels = self.project(ground)
        size = np.array([self.camera.width, self.camera.height])
        near = np.hypot(np.linalg.norm(ground - eye[:2], axis=1), eye[2]) <= reach_m
        with np.errstate(invalid="ignore"):
            shown = np.all((pixels >= margin_px) & (pixels <= size - 1 - margin_px), axis=1) & near
        return ground[shown], pixels[shown]
