"""Where the joints of drawn and ray-traced pavings are seen, by the centroids of their profiles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.synthetic import SyntheticPhoto, SyntheticScene
from benchmarks.raytrace.picture import take
from benchmarks.raytrace.scene import Paving, Scene

PLAIN = SyntheticScene(
    camera=Camera(480, 360, 430.0, 433.0, 236.0, 184.0),
    texture=0.0,
    tone_spread=0.0,
    noise_grey=0.0,
    colour=False,
)


# Slabs of one tone that lie where they ought to.
EVEN = Paving(place_jitter_m=0.0, height_jitter_m=0.0, turn_jitter_deg=0.0, veins=0.0, tone_spread=0.0)


def traced(camera: Camera, pose: Rigid, paving: Paving, **light: float) -> np.ndarray:
    """Grey levels of a paving that POV-Ray draws without noise or blur."""
    scene = Scene(
        name="traced",
        kind="printed",
        seed=5,
        camera=camera,
        told=camera,
        cam_from_ground=pose,
        paving=paving,
        noise_grey=0.0,
        blur_px=0.0,
        area_sampled=True,
        **light,  # type: ignore[arg-type]
    )
    return take(scene)[..., 1]


def joint_offsets_px(photo: SyntheticPhoto, middles_m: Float[np.ndarray, "n 2"], along_x: bool):
    """Signed distances from the projected joints to the centroids that the picture shows."""
    unit = np.array([1.0, 0.0] if along_x else [0.0, 1.0])
    # Many profiles along each joint, because a single one sees the pixels' own grid.
    stretch = np.linspace(-0.06, 0.06, 41)[:, None] * unit
    at = photo.project((middles_m[:, None] + stretch).reshape(-1, 2)).reshape(-1, 41, 2)
    direction = (at[:, -1] - at[:, 0]) / np.linalg.norm(at[:, -1] - at[:, 0], axis=1, keepdims=True)
    across = np.column_stack([-direction[:, 1], direction[:, 0]])
    reach = np.arange(-6, 6.01, 0.05)
    points = at[:, :, None] + reach[:, None] * across[:, None, None]
    tones = map_coordinates(photo.pixels.astype(float), np.moveaxis(points[..., ::-1], -1, 0), order=1)
    profile = tones.mean(1)
    depth = profile[:, :20].mean(1, keepdims=True) - profile
    return (depth * reach).sum(1) / depth.sum(1)


def joint_middles(photo: SyntheticPhoto, along_x: bool) -> Float[np.ndarray, "n 2"]:
    assert photo.lattice is not None
    a, b = photo.lattice.spacing_x, photo.lattice.spacing_y
    assert a is not None
    ground, _ = photo.crossings(margin_px=15.0, reach_m=3.0)
    # Between a crossing and the next T-junction of a half bond there is a quarter of a slab on each side.
    middles = ground + ([0.25 * a, 0.0] if along_x else [0.0, 0.5 * b])
    px = photo.project(middles)
    size = [photo.camera.width, photo.camera.height]
    return middles[np.all((px > 30) & (px < np.array(size) - 31), axis=1)]
