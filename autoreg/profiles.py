"""Grey-level profiles across the joints, sampled from the picture at its own resolution."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.stations import Stations, project_ground

STEP_PX = 0.5
ALONG_SAMPLES = 16
# So many stations are sampled at a time, which bounds memory.
REMAP_ROWS = 8192


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
    u = np.empty((n, m, p), np.float32)
    v = np.empty((n, m, p), np.float32)
    np.add(line[:, :, :1], at * normal[:, None, :1], out=u, casting="same_kind")
    np.add(line[:, :, 1:], at * normal[:, None, 1:], out=v, casting="same_kind")
    values = np.empty((n, p), np.float32)
    # remap takes at most 32,767 rows and columns.
    for start in range(0, n, REMAP_ROWS):
        part = slice(start, start + REMAP_ROWS)
        shape = -1, m * p
        grey = cv2.remap(
            picture, u[part].reshape(shape), v[part].reshape(shape), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        grey.reshape(-1, m, p).mean(1, out=values[part])
    return Profiles(values, at, centre, normal, np.abs(per_unit), room)
