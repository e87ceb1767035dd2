"""Grey-level profiles across the joints, sampled from the picture at its own resolution."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.points import project_ground
from autoreg.ground.stations import Stations

STEP_PX = 0.5
ALONG_SAMPLES = 16
# So many places are sampled at a time: more do not fit into a processor's cache, and remap takes no more.
MOST_COLUMNS = 1 << 14


@dataclass(frozen=True)
class Profiles:
    """Grey levels across each station: `values[n, p]` at `at_px[p]` from `centre_px[n]` along `normal[n]`.

    `px_per_unit` is the scale across the joint there: how many pixels a unit of ground spans. What lies
    farther than `room_px` off the centre is not the station's own: wide joints need wider profiles.
    """

    values: Float32[np.ndarray, "n p"]
    at_px: Float[np.ndarray, " p"]
    centre_px: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]
    px_per_unit: Float[np.ndarray, " n"]
    room_px: Float[np.ndarray, " n"]

    def take(self, index: np.ndarray) -> Profiles:
        """The profiles of some stations."""
        return Profiles(
            self.values[index],
            self.at_px,
            self.centre_px[index],
            self.normal[index],
            self.px_per_unit[index],
            self.room_px[index],
        )


def sample_profiles(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    stations: Stations,
    half_px: float | Float[np.ndarray, " n"],
    *,
    along_samples: int = ALONG_SAMPLES,
) -> Profiles:
    """Mean profiles across the stations, each averaged along its stretch of joint.

    `half_px` is how far the profiles reach, or how far each of them needs to.
    """
    room = np.broadcast_to(np.asarray(half_px, float), len(stations)).copy()
    reach = stations.half_length[:, None] * stations.direction
    fraction = (np.arange(along_samples) + 0.5) / along_samples * 2 - 1
    along = stations.ground[:, None] + fraction[:, None] * reach[:, None]
    centre = project_ground(camera, cam_from_ground, stations.ground)
    line = project_ground(camera, cam_from_ground, along)
    tangent = line[:, -1] - line[:, 0]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # The normal points to growing ground coordinate, so that signs mean the same along a joint.
    small = 1e-4 * cam_from_ground.origin_in_a[2]
    across = stations.direction[:, ::-1]
    moved = project_ground(camera, cam_from_ground, stations.ground + small * across)
    per_unit = ((moved - centre) * normal).sum(1) / small
    normal *= np.sign(per_unit)[:, None]
    count = int(np.ceil(np.max(room, initial=0.0) / STEP_PX))
    at = np.arange(-count, count + 1) * STEP_PX
    n, m, p = len(stations), along_samples, len(at)
    place = np.ascontiguousarray(line.transpose(2, 1, 0), np.float32)[..., None]
    off = (normal.T[..., None] * at).astype(np.float32)
    values = np.empty((n, p), np.float32)
    # A row for each of the samples along the joints, so that rows are added up; remap takes at most so many.
    for start in range(0, n, most := MOST_COLUMNS // p):
        part = slice(start, start + most)
        u, v = ((place[k, :, part] + off[k, part]).reshape(m, -1) for k in (0, 1))
        grey = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values[part] = (grey.sum(0) / np.float32(m)).reshape(-1, p)
    return Profiles(values, at, centre, normal, np.abs(per_unit), room)
