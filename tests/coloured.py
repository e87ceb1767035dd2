"""Synthetic photos of paving whose joints differ from the slabs by hue."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from paved import STACK

from autoreg.align import align
from autoreg.geometry import angle_between_rotations
from autoreg.synthetic import SyntheticPhoto, SyntheticScene, render_paving


def in_colour(scene: SyntheticScene, joint_bgr: tuple[float, float, float]) -> SyntheticPhoto:
    """A photo of grey slabs of uneven tone with joints of another hue; each channel has its own noise."""
    drawn = [
        render_paving(replace(scene, colour=False, noise_grey=0.0, joint_tone=tone)).pixels
        for tone in joint_bgr
    ]
    noise = np.random.default_rng(0).normal(0.0, 1.5, (*drawn[0].shape, 3))
    pixels = np.clip(np.round(np.stack(drawn, 2) + noise), 0, 255).astype(np.uint8)
    return replace(render_paving(replace(scene, colour=False)), pixels=pixels)


# Sand-coloured: blue is darker than the slabs' 150, red lighter, and luminance hardly differs from theirs.
SAND = (95.0, 148.0, 166.0)
UNEVEN = replace(STACK, tone_spread=0.12, texture=0.05)


def miss_deg(photo: SyntheticPhoto, picture: np.ndarray) -> float:
    """How far the rotation is off that a picture of a photo's paving is aligned with, but for half turns."""
    found = align(picture, photo.camera, slab=(0.6, 0.4)).pose.cam_from_ground
    turns = [np.diag([s, s, 1.0]) for s in (1.0, -1.0)]
    return np.rad2deg(min(angle_between_rotations(found.R @ turn, photo.cam_from_ground.R) for turn in turns))
