"""What shows of a sunk joint between its two slabs, seen aslant in the sun, in closed form.

A viewing ray that comes down between two slabs meets the far slab's wall or the bed; sunlight comes down the
same way, over the slab on the sun's side. For straight joints with upright walls all borders are parallel to
the joint. Lengths are metres across the joint, at the level of the slabs' tops.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from autoreg.synthetic.scene import SyntheticScene

# Grey levels follow the light by this power, as cameras' pictures do.
GAMMA = 1 / 2.2

Samples = Float[np.ndarray, "*n"]


class Side(NamedTuple):
    """A slab beside a joint: where its upper edge lies, how high, and its tone."""

    edge_m: Samples
    height_m: Samples
    tone: Samples


class Part(NamedTuple):
    """A band of a joint that shows one tone: its middle and width as they are seen at the slabs' level."""

    middle_m: Samples
    width_m: Samples
    tone: Samples


def seen_parts(
    scene: SyntheticScene, before: Side, beyond: Side, slope: Samples, axis: int
) -> tuple[Part, ...]:
    """Shaded and lit bed, shaded and lit wall: together all between the two slabs' upper edges as seen.

    Light of the sky reaches the bed as if it lay open (its tone is what it looks like in a joint), and a wall
    as far as the opposite slab leaves the sky in sight. Light from wall to wall is left out.

    Args:
        scene: for the depth, the bed's tone and the light.
        before: the slab on the side of smaller coordinates.
        beyond: the slab on the other side.
        slope: distance from the camera across the joint over its height; positive beyond the camera.
        axis: the ground axis across the joint.
    """
    depth, sky = scene.joint_depth_m, scene.sky_light
    # Everything is counted away from the camera, on whichever side of it the joint lies.
    away, steep = np.where(slope < 0, -1.0, 1.0), np.abs(slope)
    near = np.where(away > 0, before.edge_m, -beyond.edge_m)
    far = np.where(away > 0, beyond.edge_m, -before.edge_m)
    near_height = np.where(away > 0, before.height_m, beyond.height_m)
    far_height = np.where(away > 0, beyond.height_m, before.height_m)
    stone = np.where(away > 0, beyond.tone, before.tone)
    toward_sun = (np.cos(scene.sun_azimuth_rad), np.sin(scene.sun_azimuth_rad))[axis]
    travel = -away * toward_sun / np.tan(scene.sun_elevation_rad)
    # What lies by h higher is seen farther away by h times the slope.
    begin = near + steep * near_height
    end = np.maximum(far + steep * far_height, begin)
    foot = np.clip(far - steep * depth, begin, end)
    # The sun from behind the camera throws the near slab's shadow, else the far one's.
    behind = travel > 1e-9
    shadow = np.where(behind, near + travel * (near_height + depth), far + travel * (far_height + depth))
    split = np.clip(shadow - steep * depth, begin, foot)
    lit_down_to = near_height - (far - near) / np.where(behind, travel, 1.0)
    lit_from = np.where(behind, np.clip(far + steep * lit_down_to, foot, end), end)
    down = np.maximum(steep, 1e-9)
    top, bottom = (end - lit_from) / down, (end - foot) / down
    shade, sunny = sky * _open(top, bottom, far - near), sky * _open(0.0, top, far - near)
    bed_shade, bed_sun = scene.joint_tone * sky**GAMMA, scene.joint_tone
    bands = (
        (begin, split, np.where(behind, bed_shade, bed_sun)),
        (split, foot, np.where(behind, bed_sun, bed_shade)),
        (foot, lit_from, stone * shade**GAMMA),
        (lit_from, end, stone * (sunny + (1 - sky) * np.maximum(travel, 0.0)) ** GAMMA),
    )
    return tuple(Part(away * 0.5 * (low + high), high - low, tone) for low, high, tone in bands)


def _open(top_m: Samples | float, bottom_m: Samples, width_m: Samples) -> Samples:
    """Mean share of the sky's light that a wall gets between two depths in a joint: a half at its top.

    A strip of wall at the depth d sees (1 - d / sqrt(d² + w²)) / 2 of it over an edge at the distance w.
    """
    return 0.5 * (1.0 - (top_m + bottom_m) / (np.hypot(top_m, width_m) + np.hypot(bottom_m, width_m)))
