"""Sub-pixel places of the joints: each station's own grey-level profile across the joint.

A joint is a strip between two slabs: left tone, joint tone, right tone, with two edges of opposite sign
(or one edge where tiles of two tones meet without a joint). Its *centre* is what is measured, by a least
squares fit of that blurred strip; matching one edge would leave half a joint width of bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtr

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.stations import Stations, project_ground

STEP_PX = 0.5
ALONG_SAMPLES = 16
# Neighbouring pixels of texture and of the lens's blur are not independent: the number of free values in a
# profile is about this share of its samples.
INDEPENDENT = 0.5 * STEP_PX
# Variance of grey levels that every mean profile has, whatever it looks like.
NOISE_FLOOR = 0.02


@dataclass(frozen=True)
class Profiles:
    """Grey levels across each station: `values[n, p]` at `at_px[p]` from `centre_px[n]` along `normal[n]`.

    `px_per_unit` is the scale across the joint there: how many pixels a unit of ground spans.
    """

    values: Float[np.ndarray, "n p"]
    at_px: Float[np.ndarray, " p"]
    centre_px: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]
    px_per_unit: Float[np.ndarray, " n"]

    def take(self, index: np.ndarray) -> Profiles:
        """The profiles of some stations."""
        return Profiles(
            self.values[index], self.at_px, self.centre_px[index], self.normal[index], self.px_per_unit[index]
        )


@dataclass(frozen=True)
class Offsets:
    """Where the joint lies off the station's projected centre, along its normal.

    `depth` is the joint's tone against the mean of its slabs', `step` the tone of the far slab against the
    near one's, `strength` the share of the profile's variance that the fit explains.
    """

    offset_px: Float[np.ndarray, " n"]
    sigma_px: Float[np.ndarray, " n"]
    depth: Float[np.ndarray, " n"]
    step: Float[np.ndarray, " n"]
    strength: Float[np.ndarray, " n"]
    residual: Float[np.ndarray, " n"]


def sample_profiles(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    stations: Stations,
    half_px: float,
) -> Profiles:
    """Mean profiles across the stations, each averaged along its stretch of joint."""
    reach = stations.half_length[:, None] * stations.direction
    fraction = (np.arange(ALONG_SAMPLES) + 0.5) / ALONG_SAMPLES * 2 - 1
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
    count = int(np.ceil(half_px / STEP_PX))
    at = np.arange(-count, count + 1) * STEP_PX
    uv = line[:, :, None] + at[:, None] * normal[:, None, None]
    n, m, p = len(stations), ALONG_SAMPLES, len(at)
    uv = uv.reshape(n, m * p, 2).astype(np.float32)
    grey = np.empty((n, m * p), np.float32)
    # remap takes at most 32,767 rows and columns.
    for start in range(0, n, 16_384):
        part = slice(start, start + 16_384)
        u, v = uv[part, :, 0], uv[part, :, 1]
        grey[part] = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    values = grey.reshape(n, m, p).mean(1).astype(np.float64)
    return Profiles(values, at, centre, normal, np.abs(per_unit))


def _basis(
    at: Float[np.ndarray, " p"], centre: Float[np.ndarray, "*n"], width: Float[np.ndarray, "*n"], blur: float
) -> Float[np.ndarray, "*n p 3"]:
    """Constant, near edge and far edge of a strip."""
    s = at - centre[..., None]
    half = 0.5 * width[..., None]
    return np.stack([np.ones_like(s), ndtr((s + half) / blur), ndtr((s - half) / blur)], -1)


def search_offsets(
    profiles: Profiles, width_px: Float[np.ndarray, " n"], reach_px: float, prior_px: float, blur: float = 0.9
) -> Float[np.ndarray, " n"]:
    """Offset of the strip that explains each profile best, to half a pixel, within `reach_px`.

    A Gaussian prior of `prior_px` settles ties in favour of the predicted place.
    """
    at = profiles.at_px
    candidates = np.arange(-np.floor(reach_px), np.floor(reach_px) + 0.25, 0.5)
    bucket = np.clip(np.round(2 * np.log2(np.maximum(width_px, 1.0))), 0, 9).astype(int)
    best = np.zeros(len(profiles.values))
    centred = profiles.values - profiles.values.mean(1, keepdims=True)
    total = (centred**2).sum(1) + 1e-6
    for level in np.unique(bucket):
        rows = np.flatnonzero(bucket == level)
        B = _basis(at, candidates, np.full(len(candidates), 2.0 ** (level / 2)), blur)
        edges = B[..., 1:] - B[..., 1:].mean(1, keepdims=True)
        # Orthonormal columns make the explained variance a sum of squares; the ridge keeps a thin strip's
        # two nearly equal edges apart from noise.
        both = np.stack([edges[..., 0] + edges[..., 1], edges[..., 0] - edges[..., 1]], -1)
        Q = np.linalg.qr(both)[0]
        energy = (np.einsum("np,cpk->nck", centred[rows], Q) ** 2).sum(-1)
        left = np.maximum(total[rows, None] - energy, 1e-3 * total[rows, None] + 1e-6)
        likelihood = -0.5 * INDEPENDENT * len(at) * np.log(left) - 0.5 * (candidates / prior_px) ** 2
        best[rows] = candidates[likelihood.argmax(1)]
    return best


def fit_offsets(
    profiles: Profiles,
    start_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    blur: float,
    *,
    window_px: Float[np.ndarray, " n"] | None = None,
    iterations: int = 6,
) -> Offsets:
    """Least-squares offset of each strip (variable projection: tones are linear, the offset is not)."""
    at, values = profiles.at_px, profiles.values
    reach = window_px if window_px is not None else 0.5 * width_px + 3.0 * blur + 1.5
    centre = start_px.copy()
    weight = _window(at, start_px, reach)
    information = np.zeros(len(values))
    for _ in range(iterations):
        basis = _basis(at, centre, width_px, blur)
        tones, fit = _tones(basis, values, weight)
        s = at - centre[:, None]
        half = 0.5 * width_px[:, None]
        pdf = (np.exp(-0.5 * ((s + half) / blur) ** 2), np.exp(-0.5 * ((s - half) / blur) ** 2))
        slope = -(tones[:, 1:2] * pdf[0] + tones[:, 2:3] * pdf[1]) / (blur * np.sqrt(2 * np.pi))
        # The part of the slope that the tones cannot imitate.
        free = slope - _tones(basis, slope, weight)[1]
        information = (weight * free * free).sum(1)
        step = (weight * free * (values - fit)).sum(1) / np.maximum(information, 1e-9)
        centre = np.clip(centre + np.clip(step, -0.7, 0.7), start_px - 2.5, start_px + 2.5)
    tones, fit = _tones(_basis(at, centre, width_px, blur), values, weight)
    count = weight.sum(1)
    sse = (weight * (values - fit) ** 2).sum(1)
    mean = (weight * values).sum(1) / count
    total = (weight * (values - mean[:, None]) ** 2).sum(1)
    variance = sse / np.maximum(count * INDEPENDENT - 4.0, 1.0) + 0.02
    sigma = np.sqrt(variance / np.maximum(information, 1e-9))
    return Offsets(
        offset_px=centre,
        sigma_px=sigma,
        depth=0.5 * (tones[:, 1] - tones[:, 2]),
        step=tones[:, 1] + tones[:, 2],
        # A flat profile, overexposed say, shows no joint.
        strength=1.0 - (sse + NOISE_FLOOR * count) / (total + NOISE_FLOOR * count),
        residual=sse / np.maximum(count, 1e-9),
    )


def _window(at: np.ndarray, centre: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Weights that leave out what lies beyond the joint and its shoulders."""
    return np.clip(reach[:, None] + 0.5 - np.abs(at - centre[:, None]), 0.0, 1.0)


def _tones(B: np.ndarray, values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear tones of each profile, and the fit."""
    near, far = B[..., 1], B[..., 2]
    columns = (weight, weight * near, weight * far)
    normal = np.empty((len(values), 3, 3))
    right = np.empty((len(values), 3, 1))
    for i, column in enumerate(columns):
        normal[:, i, 0] = normal[:, 0, i] = column.sum(1)
        right[:, i, 0] = (column * values).sum(1)
    normal[:, 1, 1] = (columns[1] * near).sum(1)
    normal[:, 1, 2] = normal[:, 2, 1] = (columns[1] * far).sum(1)
    normal[:, 2, 2] = (columns[2] * far).sum(1)
    # A thin strip's two edges are nearly the same column: a ridge of a thousandth keeps their sum.
    ridge = 1e-3 * np.trace(normal, axis1=1, axis2=2)[:, None, None] / 3 * np.diag([0.0, 1.0, 1.0])
    tones = np.linalg.solve(normal + ridge, right)[..., 0]
    return tones, tones[:, :1] + tones[:, 1:2] * near + tones[:, 2:] * far


def strip_support(
    profiles: Profiles,
    width_px: Float[np.ndarray, " n"],
    blur: float,
    tolerance_px: float,
    room_px: Float[np.ndarray, " n"],
    polarity: Int[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Share of each profile's variance that a strip within `tolerance_px` of the predicted place explains.

    Only what lies within `room_px` of the place is looked at, so that a neighbouring joint has no say. Where
    the joints are known to be dark or light, a step of tone alone is no joint, nor is a strip of the other
    kind.
    """
    at = profiles.at_px
    candidates = np.arange(-tolerance_px, tolerance_px + 0.25, 0.5)
    level = np.round(2 * np.log2(np.maximum(width_px, 1.0))).astype(int)
    rooms = np.round(room_px).astype(int)
    support = np.zeros(len(profiles.values))
    for key in np.unique(np.stack([level, rooms], 1), axis=0):
        rows = np.flatnonzero((level == key[0]) & (rooms == key[1]))
        inside = np.abs(at) <= key[1]
        values = profiles.values[rows][:, inside]
        centred = values - values.mean(1, keepdims=True)
        # A grey level of noise keeps flat profiles from scoring by chance.
        total = ((centred**2).sum(1) + 0.5 * inside.sum())[:, None]
        B = _basis(at[inside], candidates, np.full(len(candidates), 2.0 ** (key[0] / 2)), blur)[..., 1:]
        edges = B - B.mean(1, keepdims=True)
        both = np.stack([edges[..., 0] + edges[..., 1], edges[..., 0] - edges[..., 1]], -1)
        orthonormal, upper = np.linalg.qr(both)
        signed = orthonormal * np.sign(np.diagonal(upper, axis1=1, axis2=2))[:, None, :]
        step, strip = np.moveaxis(np.einsum("np,cpk->nck", centred, signed), -1, 0)
        sign = polarity[rows, None]
        lined = np.where(strip * sign > 0, strip**2 / (total - step**2), 0.0)
        support[rows] = np.where(sign == 0, (step**2 + strip**2) / total, lined).max(1)
    return support


def strip_misfit(
    profiles: Profiles, rows: np.ndarray, offset_px: np.ndarray, width_px: np.ndarray, blur: float
) -> float:
    """Mean logarithm of the unexplained variance of some stations' profiles, for a joint width and a blur."""
    values = profiles.values[rows]
    B = _basis(profiles.at_px, offset_px[rows], width_px[rows], blur)
    _, fit = _tones(B, values, np.ones_like(values))
    total = ((values - values.mean(1, keepdims=True)) ** 2).sum(1)
    return float(np.mean(np.log(((values - fit) ** 2).sum(1) / np.maximum(total, 1e-9) + 1e-3)))
