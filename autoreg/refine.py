"""Refinement: projected joints are laid on the photographed ones and measured again, until all is still."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from autoreg import residuals as terms
from autoreg.camera import Camera
from autoreg.edges import Offsets, fit_offsets
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector
from autoreg.joint_looks import Strip, estimate_strip, first_look, joint_polarity, search_joints, width_px_of
from autoreg.profiles import Profiles, sample_profiles
from autoreg.residuals import PARAMETERS, JointData
from autoreg.solver import CAPACITY, CAUCHY_SIGMAS, Prior, Solution, solve_joints
from autoreg.stations import (
    ALONG_X,
    ALONG_Y,
    Grid,
    Stations,
    place_stations,
    project_ground,
    visible_sides,
)

# Solves per round, each with the scatter that the one before left.
SOLVES = 2
# A slab's side is at least this part of the camera's height, and at most as many times it.
MOST_SIDES = 200.0
# Where joints are neither dark nor light, those whose contrast, against the light around them, is below this
# part of what is usual are none.
FAINT = 0.1
# Grey levels that even the deepest shadow has.
DARK = 8.0
# An outermost line that lies off by so many times what the inner ones do is the rim of something else, if
# there are at least so many lines and it is off by more than this share of a side and so many pixels; they
# are looked for among this part of the lines at either end.
RIM_SIGMAS, RIM_LINES, RIM_SHARE, RIM_PX, RIM_PART = 6.0, 5, 0.015, 0.5, 4
# Joints that tell the scatter.
SCATTER_SAMPLE = 500


@dataclass(frozen=True)
class Free:
    """What the solve may change besides the pose, and how far a prior lets it go.

    `step_sigma` holds every single solve near its start: so many radians, and heights of the camera. Joints
    of one direction leave motions free that must not wander.
    """

    ratio: bool = False
    focal: bool = False
    centre: bool = False
    radial: bool = False
    nominal: Camera | None = None
    focal_sigma: float = np.inf
    centre_sigma_px: float = np.inf
    radial_sigma: float = np.inf
    step_sigma: float = np.inf

    @property
    def mask(self) -> Float[np.ndarray, " p"]:
        """Ones for the free parameters."""
        mask = np.zeros(PARAMETERS)
        mask[:6] = 1.0
        mask[terms.RATIO], mask[terms.FOCAL] = self.ratio, self.focal
        mask[terms.CENTRE], mask[terms.RADIAL] = self.centre, self.radial
        return mask

    def prior(self, camera: Camera) -> Prior:
        """What is known of a solve's parameters when it starts from `camera`: the nominal one is meant."""
        mean, sigma = np.zeros(PARAMETERS), np.full(PARAMETERS, np.inf)
        sigma[terms.FOCAL], sigma[terms.CENTRE] = self.focal_sigma, self.centre_sigma_px
        sigma[terms.RADIAL] = self.radial_sigma
        sigma[terms.ROTATION] = sigma[terms.TRANSLATION] = self.step_sigma
        if self.nominal is not None:
            mean[terms.FOCAL] = np.log(self.nominal.fx / camera.fx)
            mean[terms.CENTRE] = self.nominal.cx - camera.cx, self.nominal.cy - camera.cy
            mean[terms.RADIAL] = self.nominal.dist[0] - camera.dist[0]
        return Prior(mean, sigma)


@dataclass(frozen=True)
class Fit:
    """A refined pose with all that it was fitted to.

    `weight` is each station's robust weight (0 to 1), `sigma_px` its expected scatter: measurement and the
    slabs' own irregularity together.
    """

    camera: Camera
    cam_from_ground: Rigid
    grid: Grid
    strip: Strip
    stations: Stations
    profiles: Profiles
    offsets: Offsets
    distances_px: Float[np.ndarray, " n"]
    sigma_px: Float[np.ndarray, " n"]
    usable: Bool[np.ndarray, " n"]
    solution: Solution
    free: Free

    @property
    def weight(self) -> Float[np.ndarray, " n"]:
        """Cauchy weight of each station; zero for one whose joint could not be measured."""
        return self.usable / (1.0 + (self.distances_px / (CAUCHY_SIGMAS * self.sigma_px)) ** 2)


def refine(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    *,
    free: Free,
    search: float,
    reaches: tuple[float, ...],
    strip: Strip | None = None,
    field: Float[np.ndarray, "k 2"] | None = None,
    limit: int = CAPACITY,
) -> Fit | None:
    """The pose at which the projected joints lie on the photographed ones; None if nothing can be measured.

    Args:
        picture: grey levels that `camera` belongs to.
        camera: its camera.
        cam_from_ground: start; the lattice's unit is that of its translation.
        grid: start of the lattice.
        free: what else is solved for.
        search: half width of the first search, in slab sides; 0 starts from the predicted places.
        reaches: how far to look in each round, in camera heights.
        strip: looks of the joints, if known.
        field: where on the ground the paving is, a convex polygon; everywhere if None.
        limit: the most stations that are measured.
    """
    fit: Fit | None = None
    for reach in reaches:
        now = _round(picture, camera, cam_from_ground, grid, strip, free, search, reach, field, limit)
        if now is None:
            return fit
        fit = now
        camera, cam_from_ground, grid, strip = fit.camera, fit.cam_from_ground, fit.grid, fit.strip
        search = 0.5 * search if search >= 0.06 else 0.0
    return fit


def refine_until_still(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    *,
    free: Free,
    search: float,
    reach: float,
    strip: Strip | None = None,
    field: Float[np.ndarray, "k 2"] | None = None,
    still_px: float = 0.003,
    most_rounds: int = 6,
) -> Fit | None:
    """Like `refine` at one reach, measured again until no joint moves by more than `still_px` (RMS)."""
    fit: Fit | None = None
    for _ in range(most_rounds):
        before = (camera, cam_from_ground, grid)
        fit = refine(picture, *before, free=free, search=search, reaches=(reach,), strip=strip, field=field)
        if fit is None:
            return None
        settled = strip is not None and fit.strip.like(strip)
        camera, cam_from_ground, grid, strip = fit.camera, fit.cam_from_ground, fit.grid, fit.strip
        if not search and settled and _motion_px(fit, *before) < still_px:
            break
        search = 0.0
    return fit


def _motion_px(fit: Fit, camera: Camera, pose: Rigid, grid: Grid) -> float:
    """RMS motion, across the joints, of the fit's stations from an earlier state."""
    a = (fit.grid.spacing_x or 1.0) / (grid.spacing_x or 1.0)
    stretched_ground = fit.stations.ground * [a, fit.grid.spacing_y / grid.spacing_y]
    now = project_ground(fit.camera, fit.cam_from_ground, stretched_ground)
    was = project_ground(camera, pose, fit.stations.ground)
    across = ((now - was) * fit.profiles.normal).sum(1)
    return float(np.sqrt(np.mean(across**2)))


def _round(
    picture: np.ndarray,
    camera: Camera,
    pose: Rigid,
    grid: Grid,
    strip: Strip | None,
    free: Free,
    search: float,
    reach: float,
    field: np.ndarray | None,
    limit: int,
) -> Fit | None:
    sides = visible_sides(camera, pose, grid, reach=reach, field=field)
    if len(sides) < 6:
        return None
    stations = place_stations(sides, camera, pose, limit=limit)
    side = np.array([grid.spacing_x or grid.spacing_y, grid.spacing_y])
    across = np.where(stations.family == ALONG_X, side[1], side[0])
    half = 10.0 if search else 7.0
    profiles = sample_profiles(picture, camera, pose, stations, half + 3.0)
    pitch_px = across * profiles.px_per_unit
    reach_px = np.clip(search * pitch_px, 1.5, half) if search else np.full(len(stations), 1.5)
    known = strip is not None
    if strip is None:
        strip = Strip((0.02 * side[1], 0.02 * side[0]), 0.9)
        start, strip = first_look(profiles, stations, strip, side, reach_px)
    elif search:
        start = search_joints(profiles, stations, strip, reach_px)
    else:
        start = np.zeros(len(stations))
    widest_px = 2 * half - 6
    measured: tuple[Offsets, np.ndarray, Strip] | None = None
    for last in (False, True):
        # Looks that are known change little: they are measured where the joints are found to be.
        looks = "known" if known and not last else "near" if known else "unknown"
        measured = _measured(profiles, stations, start, strip, widest_px, reach_px, side, looks)
        if measured is None:
            return None
        start, strip = measured[0].offset_px, measured[2]
    assert measured is not None
    offsets, usable, strip = measured
    offsets = replace(
        offsets, offset_px=offsets.offset_px - middle_px(camera, pose, stations, profiles.normal, strip)
    )
    sigma = np.hypot(offsets.sigma_px, 0.3)
    fit: Fit | None = None
    # While joints are searched the next round solves again.
    for _ in range(1 if search else SOLVES):
        data = joint_data(camera, pose, stations, profiles, offsets, sigma, usable)
        solution = solve_joints(data, free.mask, free.prior(camera))
        moved, new_grid = moved_pose(pose, solution), stretched(grid, solution)
        if solution.outcome == "diverged" or not _plausible(moved, new_grid):
            return fit
        distances = solution.distances_px
        if not search:
            usable = usable & ~beside_rim(distances, profiles.px_per_unit * across, stations, usable)
        sigma = scatter_model(distances, offsets.sigma_px, profiles.px_per_unit, stations.side, usable)
        fit = Fit(
            camera=moved_camera(camera, solution),
            cam_from_ground=moved,
            grid=new_grid,
            strip=strip,
            stations=stations,
            profiles=profiles,
            offsets=offsets,
            distances_px=distances,
            sigma_px=sigma,
            usable=usable,
            solution=solution,
            free=free,
        )
    return fit


def beside_rim(
    off_px: Float[np.ndarray, " n"],
    side_px: Float[np.ndarray, " n"],
    stations: Stations,
    usable: Bool[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Stations of outermost lines that lie off as none of the others: a kerb, or the rim of a board.

    Args:
        off_px: distances from the projected joints.
        side_px: length of a slab side across the joint, as seen there.
        stations: where they were measured.
        usable: those that count.
    """
    off, beside = off_px / side_px, np.zeros(len(off_px), dtype=bool)
    for family in (ALONG_X, ALONG_Y):
        members = np.flatnonzero(usable & (stations.family == family))
        members = members[np.lexsort((off[members], stations.line[members]))]
        lines, start, count = np.unique(stations.line[members], return_index=True, return_counts=True)
        if len(lines) < RIM_LINES:
            continue
        median = members[start + (count - 1) // 2]
        place = off[median]
        most = len(lines) // RIM_PART
        inner = place[most : len(lines) - most]
        away = np.abs(place - np.median(inner))
        limit = RIM_SIGMAS * 1.48 * float(np.median(np.abs(inner - np.median(inner))))
        gross = np.flatnonzero((away > max(limit, RIM_SHARE)) & (np.abs(off_px[median]) > RIM_PX))
        # What lies beyond such a line is no paving of this lattice either.
        first, last = gross[gross < most], gross[gross >= len(lines) - most]
        low = first.max() + 1 if len(first) else 0
        high = last.min() if len(last) else len(lines)
        line = stations.line[members]
        beside[members] = (line < lines[low]) | (line > lines[high - 1])
    return beside


def _plausible(pose: Rigid, grid: Grid) -> bool:
    """Whether a lattice may be one of slabs: a solve with nothing to hold it can run away."""
    height = float(pose.origin_in_a[2])
    sides = np.array([grid.spacing_x or grid.spacing_y, grid.spacing_y]) / height
    return bool(height > 0 and (sides > 1.0 / MOST_SIDES).all() and (sides < MOST_SIDES).all())


def _measured(
    profiles: Profiles,
    stations: Stations,
    start: np.ndarray,
    strip: Strip,
    widest_px: float,
    reach_px: np.ndarray,
    side: np.ndarray,
    looks: Literal["known", "near", "unknown"],
) -> tuple[Offsets, np.ndarray, Strip] | None:
    """Offsets from a start, which of them can be used, and the joints' looks by those; None if too few."""
    width_px = width_px_of(strip, stations, profiles)
    offsets = fit_offsets(profiles, start, np.minimum(width_px, widest_px), strip.blur_px)
    usable = (offsets.strength > 0.25) & np.isfinite(offsets.offset_px)
    usable &= np.abs(offsets.offset_px) < reach_px + 1.5
    polarity = strip.polarity
    if not strip.polarity_known:
        polarity = joint_polarity(profiles, stations, offsets.offset_px, strip, side)
    sign = np.array(polarity)[stations.family]
    usable &= (sign == 0) | (offsets.depth * sign > 0)
    contrast = (np.abs(offsets.depth) + 0.5 * np.abs(offsets.step)) / (profiles.values.mean(1) + DARK)
    if usable.any():
        usable &= (sign != 0) | (contrast > FAINT * np.median(contrast[usable]))
    if usable.sum() < 12:
        return None
    strip = replace(strip, polarity=polarity)
    if looks != "known":
        thorough = looks == "unknown"
        strip = estimate_strip(profiles, offsets, stations, strip, usable, side, thorough=thorough)
    return offsets, usable, strip


def middle_px(
    camera: Camera, pose: Rigid, stations: Stations, normal: Float[np.ndarray, "n 2"], strip: Strip
) -> Float[np.ndarray, " n"]:
    """How far the middle of a joint's two edges lies off its centre line in the picture, along the normal.

    The nearer half of a joint looks wider than the farther one.
    """
    half = 0.5 * np.where(stations.family == ALONG_X, strip.width[0], strip.width[1])
    across = half[:, None] * stations.direction[:, ::-1]
    places = stations.ground, stations.ground + across, stations.ground - across
    centre, far, near = (project_ground(camera, pose, place) for place in places)
    return ((0.5 * (far + near) - centre) * normal).sum(1)


def joint_data(
    camera: Camera,
    pose: Rigid,
    stations: Stations,
    profiles: Profiles,
    offsets: Offsets,
    sigma_px: Float[np.ndarray, " n"],
    usable: Bool[np.ndarray, " n"],
) -> JointData:
    """The measured joints in the solver's form."""
    height = float(pose.origin_in_a[2])
    return JointData(
        ground=stations.ground,
        measured_px=profiles.centre_px + offsets.offset_px[:, None] * profiles.normal,
        normal=profiles.normal,
        weight=usable / (CAUCHY_SIGMAS * sigma_px),
        R=pose.R,
        t=pose.t,
        intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist]),
        scale=np.array([1.0] * 3 + [height] * 3 + [1.0, 1.0, camera.fx, camera.fx, 1.0]),
    )


def scatter_model(
    distances: np.ndarray,
    sigma_fit: np.ndarray,
    px_per_unit: np.ndarray,
    side: np.ndarray,
    usable: np.ndarray,
) -> Float[np.ndarray, " n"]:
    """Expected scatter of each station: its own measurement, and the slabs' irregularity on the ground.

    The two shares are found by maximum likelihood (Cauchy) over a grid. Stations of one side share their
    slab's displacement, so the irregular part counts once per side.
    """
    rows = np.flatnonzero(usable)
    rows = rows[:: max(1, len(rows) // SCATTER_SAMPLE)]
    r, s, u = np.abs(distances[rows]), sigma_fit[rows], px_per_unit[rows]
    s = np.maximum(s, 0.3 * np.median(s))
    base = float(np.median(r)) * 1.48 + 1e-6
    shares = np.r_[0.0, np.geomspace(0.05, 2.0, 10)] * base
    share_s, share_u = (
        np.stack(np.meshgrid(shares / np.median(s), shares / np.median(u)), -1).reshape(-1, 2).T
    )
    # Half the spread is a Cauchy's scale for normal residuals.
    gamma2 = 0.45 * (share_s[:, None] ** 2 * s**2 + share_u[:, None] ** 2 * u**2 + 1e-6)
    best = int((0.5 * np.log(gamma2) + np.log1p(r * r / gamma2)).sum(1).argmin())
    share_s, share_u = share_s[best], share_u[best]
    per_side = np.bincount(side[usable], minlength=side.max() + 1)[side]
    smooth = np.maximum(sigma_fit, 0.3 * np.median(s))
    return np.sqrt((share_s * smooth) ** 2 + np.maximum(per_side, 1) * (share_u * px_per_unit) ** 2 + 1e-6)


def moved_pose(pose: Rigid, solution: Solution) -> Rigid:
    """The pose after a solve's small motion."""
    p = solution.parameters
    turn = rotation_from_vector(p[terms.ROTATION])
    return Rigid(nearest_rotation(turn @ pose.R), turn @ pose.t + p[terms.TRANSLATION])


def moved_camera(camera: Camera, solution: Solution) -> Camera:
    """The camera after a solve."""
    p = solution.parameters
    if not p[terms.FOCAL :].any():
        return camera
    focal = float(np.exp(p[terms.FOCAL]))
    dx, dy = (float(v) for v in p[terms.CENTRE])
    dist = (camera.dist[0] + float(p[terms.RADIAL]), *camera.dist[1:])
    return replace(
        camera, fx=camera.fx * focal, fy=camera.fy * focal, cx=camera.cx + dx, cy=camera.cy + dy, dist=dist
    )


def stretched(grid: Grid, solution: Solution) -> Grid:
    """The lattice after a solve."""
    half = 0.5 * float(solution.parameters[terms.RATIO])
    a = None if grid.spacing_x is None else grid.spacing_x * float(np.exp(half))
    return replace(grid, spacing_x=a, spacing_y=grid.spacing_y * float(np.exp(-half)))
