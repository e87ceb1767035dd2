"""What shows of a sunk joint between its two slabs, seen aslant in the sun, in closed form.

A viewing ray that comes down between two slabs meets the near one's bevel, the bed, or the far one's wall or
bevel; sunlight comes down the same way, over the slab on the sun's side. For straight joints with upright
walls all borders are parallel to the joint. Lengths are metres across it, at the level of the slabs' tops.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from autoreg.synthetic.scene import SyntheticScene

# Grey levels follow the light by this power, as cameras' pictures do.
GAMMA = 1 / 2.2
# Share of the sky's light that stone gets which leans by 45 degrees.
SKY_OVER_BEVEL = 0.5 * (1.0 + np.sqrt(0.5))

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
    """Near bevel, shaded and lit bed, shaded and lit wall, far bevel: all between the slabs' tops as seen.

    Light of the sky reaches the bed as if it lay open (its tone is what it looks like in a joint), a wall as
    far as the opposite slab leaves the sky in sight, and a bevel as if nothing stood opposite. Light from
    wall to wall is left out, and so are shadows that reach as far as the opposite bevel.

    Args:
        scene: for the depth, the bevels, the bed's tone and the light.
        before: the slab on the side of smaller coordinates.
        beyond: the slab on the other side.
        slope: distance from the camera across the joint over its height; positive beyond the camera.
        axis: the ground axis across the joint.
    """
    depth, chamfer, sky = scene.joint_depth_m, scene.chamfer_m, scene.sky_light
    # Everything is counted away from the camera, on whichever side of it the joint lies.
    away, steep = np.where(slope < 0, -1.0, 1.0), np.abs(slope)
    near = np.where(away > 0, before.edge_m, -beyond.edge_m)
    far = np.where(away > 0, beyond.edge_m, -before.edge_m)
    near_height = np.where(away > 0, before.height_m, beyond.height_m)
    far_height = np.where(away > 0, beyond.height_m, before.height_m)
    stone = np.where(away > 0, beyond.tone, before.tone)
    near_stone = np.where(away > 0, before.tone, beyond.tone)
    toward_sun = (np.cos(scene.sun_azimuth_rad), np.sin(scene.sun_azimuth_rad))[axis]
    travel = -away * toward_sun / np.tan(scene.sun_elevation_rad)
    # What lies by h higher is seen farther away by h times the slope. A near bevel hides behind its upper
    # edge where the view is flatter than it is.
    top = near - chamfer + steep * near_height
    begin = np.maximum(top, near + steep * (near_height - chamfer))
    end = np.maximum(far + chamfer + steep * far_height, begin)
    rim = np.clip(far + steep * (far_height - chamfer), begin, end)
    foot = np.clip(far - steep * depth, begin, rim)
    # The sun from behind the camera throws the near slab's shadow, else the far one's: that of a bevel's
    # upper edge, or of its lower one, whichever reaches farther.
    behind = travel > 1e-9
    edges = ((0.0, chamfer), (chamfer, 0.0))
    by_near = [near - back + travel * (near_height - down + depth) for down, back in edges]
    by_far = [far + back + travel * (far_height - down + depth) for down, back in edges]
    shadow = np.where(behind, np.maximum(*by_near), np.minimum(*by_far))
    split = np.clip(shadow - steep * depth, begin, foot)
    across = np.where(behind, travel, 1.0)
    lit_down_to = np.maximum(*(near_height - down - (far - near + back) / across for down, back in edges))
    lit_from = np.where(behind, np.clip(far + steep * lit_down_to, foot, rim), rim)
    per_depth = np.maximum(steep, 1e-9)
    lit, whole = (chamfer + (rim - at) / per_depth for at in (lit_from, foot))
    shade, sunny = sky * _open(lit, whole, far - near), sky * _open(chamfer, lit, far - near)
    bed_shade, bed_sun = scene.joint_tone * sky**GAMMA, scene.joint_tone
    bands = [
        (begin, split, np.where(behind, bed_shade, bed_sun)),
        (split, foot, np.where(behind, bed_sun, bed_shade)),
        (foot, lit_from, stone * shade**GAMMA),
        (lit_from, rim, stone * (sunny + (1 - sky) * np.maximum(travel, 0.0)) ** GAMMA),
    ]
    if chamfer:
        bands.append((top, begin, near_stone * _bevel_light(sky, -travel) ** GAMMA))
        bands.append((rim, end, stone * _bevel_light(sky, travel) ** GAMMA))
    return tuple(Part(away * 0.5 * (low + high), high - low, tone) for low, high, tone in bands)


def _bevel_light(sky: float, travel: Samples) -> Samples:
    """Light on a bevel that faces where the sun's light comes from, as a share of that on level stone."""
    return sky * SKY_OVER_BEVEL + (1.0 - sky) * np.maximum(np.sqrt(0.5) * (1.0 + travel), 0.0)


def _open(top_m: Samples | float, bottom_m: Samples, width_m: Samples) -> Samples:
    """Mean share of the sky's light that a wall gets between two depths in a joint: a half at its top.

    A strip of wall at the depth d sees (1 - d / sqrt(d² + w²)) / 2 of it over an edge at the distance w.
    """
    return 0.5 * (1.0 - (top_m + bottom_m) / (np.hypot(top_m, width_m) + np.hypot(bottom_m, width_m)))
