"""Refinement: projected joints are laid on the photographed ones and measured again, until all is still."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from autoreg import residuals as terms
from autoreg.camera import Camera
from autoreg.edges import Offsets, Profiles, fit_offsets, sample_profiles, search_offsets, strip_misfit
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector
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

WIDTHS = np.geomspace(0.004, 0.16, 14)
# Changes of the bond's shift below this share of a slab are left alone.
SHIFT_STEP = 0.0003
# Joint width, in slab sides, where tiles meet without a joint.
NO_JOINT = 0.001
# A strip has one tone more than a step to fit noise with: what that buys, in mean log variance.
NO_JOINT_BONUS = 0.05
BLURS = (0.5, 0.65, 0.8, 1.0, 1.3, 1.7, 2.2)


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
class Strip:
    """What a joint looks like: its width on the ground for either family, and the picture's blur.

    `polarity` is -1 where a family's joints are darker than their slabs, +1 where they are lighter, and 0
    where they are neither (tiles of two tones that meet without a joint); once known, it is not asked again.
    """

    width: tuple[float, float]
    blur_px: float
    polarity: tuple[int, int] = (0, 0)
    polarity_known: bool = False


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
    """
    fit: Fit | None = None
    for reach in reaches:
        now = _round(picture, camera, cam_from_ground, grid, strip, free, search, reach, field)
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
        camera, cam_from_ground, grid, strip = fit.camera, fit.cam_from_ground, fit.grid, fit.strip
        moved = _motion_px(fit, *before)
        if not search and moved < still_px:
            break
        search = 0.0
    return fit


def with_measured_shift(fit: Fit) -> Fit | None:
    """The fit with the bond's shift as the cross joints show it; None if it is the one it has.

    A wrong shift shears the cross joints, which the pose partly hides by a turn; a linear step of the pose
    and the shift together tells them apart. The customary shifts are kept unless the joints contradict them.
    """
    grid = fit.grid
    if not grid.shift or grid.spacing_x is None:
        return None
    rows = np.flatnonzero(fit.usable)
    stations = fit.stations.take(rows)
    crossing = stations.family == ALONG_Y
    if len(np.unique(stations.cell[crossing])) < 3:
        return None
    by_shift = np.where(crossing, stations.cell * grid.spacing_x * fit.profiles.px_per_unit[rows], 0.0)
    J = np.column_stack([fit.solution.jacobian[rows][:, fit.free.mask > 0], by_shift])
    weight = np.sqrt(fit.weight[rows]) / fit.sigma_px[rows]
    A, b = J * weight[:, None], -fit.distances_px[rows] * weight
    unit = np.linalg.norm(A, axis=0)
    step = np.linalg.lstsq(A / unit, b, rcond=None)[0] / unit
    scatter = float(np.mean((A @ step - b) ** 2)) * len(rows) / len(np.unique(stations.side))
    sigma = float(np.sqrt(scatter * np.linalg.pinv((A / unit).T @ (A / unit))[-1, -1]) / unit[-1])
    change = float(step[-1])
    if abs(change) < max(5.0 * sigma, SHIFT_STEP):
        return None
    return replace(fit, grid=replace(grid, shift=(grid.shift + change) % 1.0))


def recentred(fit: Fit) -> Fit:
    """The fit moved without a turn to where its joints lie best: robustly weighted least squares."""
    J = fit.solution.jacobian[:, terms.TRANSLATION]
    weight = np.sqrt(fit.weight) / fit.sigma_px
    step = np.linalg.lstsq(J * weight[:, None], -fit.distances_px * weight, rcond=1e-9)[0]
    pose = Rigid(fit.cam_from_ground.R, fit.cam_from_ground.t + step)
    return replace(fit, cam_from_ground=pose, distances_px=fit.distances_px + J @ step)


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
) -> Fit | None:
    sides = visible_sides(camera, pose, grid, reach=reach, field=field)
    if len(sides) < 6:
        return None
    stations = place_stations(sides, camera, pose, limit=CAPACITY)
    side = np.array([grid.spacing_x or grid.spacing_y, grid.spacing_y])
    across = np.where(stations.family == ALONG_X, side[1], side[0])
    half = 10.0 if search else 7.0
    profiles = sample_profiles(picture, camera, pose, stations, half + 3.0)
    pitch_px = across * profiles.px_per_unit
    reach_px = np.clip(search * pitch_px, 1.5, half) if search else np.full(len(stations), 1.5)
    if strip is None:
        strip = Strip((0.02 * side[1], 0.02 * side[0]), 0.9)
        start, strip = _first_look(profiles, stations, strip, side, reach_px)
    elif search:
        start = _search(profiles, stations, strip, reach_px)
    else:
        start = np.zeros(len(stations))
    widest_px = 2 * half - 6
    first = _measured(profiles, stations, start, strip, widest_px, reach_px, side)
    if first is None:
        return None
    second = _measured(profiles, stations, first[0].offset_px, first[2], widest_px, reach_px, side)
    if second is None:
        return None
    offsets, usable, strip = second
    sigma = np.hypot(offsets.sigma_px, 0.3)
    fit: Fit | None = None
    for _ in range(3):
        data = joint_data(camera, pose, stations, profiles, offsets, sigma, usable)
        solution = solve_joints(data, free.mask, free.prior(camera))
        if solution.outcome == "diverged":
            return fit
        distances = solution.distances_px
        sigma = scatter_model(distances, offsets.sigma_px, profiles.px_per_unit, stations.side, usable)
        fit = Fit(
            camera=moved_camera(camera, solution),
            cam_from_ground=moved_pose(pose, solution),
            grid=stretched(grid, solution),
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


def _measured(
    profiles: Profiles,
    stations: Stations,
    start: np.ndarray,
    strip: Strip,
    widest_px: float,
    reach_px: np.ndarray,
    side: np.ndarray,
) -> tuple[Offsets, np.ndarray, Strip] | None:
    """Offsets from a start, which of them can be used, and the joints' looks by those; None if too few."""
    width_px = _width_px(strip, stations, profiles)
    offsets = fit_offsets(profiles, start, np.minimum(width_px, widest_px), strip.blur_px)
    usable = (offsets.strength > 0.25) & np.isfinite(offsets.offset_px)
    usable &= np.abs(offsets.offset_px) < reach_px + 1.5
    polarity = strip.polarity
    if not strip.polarity_known:
        polarity = _polarity(profiles, stations, offsets.offset_px, strip, side)
    sign = np.array(polarity)[stations.family]
    usable &= (sign == 0) | (offsets.depth * sign > 0)
    if usable.sum() < 12:
        return None
    strip = _estimate_strip(profiles, offsets, stations, replace(strip, polarity=polarity), usable, side)
    return offsets, usable, strip


def _width_px(strip: Strip, stations: Stations, profiles: Profiles) -> np.ndarray:
    return np.where(stations.family == ALONG_X, strip.width[0], strip.width[1]) * profiles.px_per_unit


def _search(profiles: Profiles, stations: Stations, strip: Strip, reach_px: np.ndarray) -> np.ndarray:
    width = _width_px(strip, stations, profiles)
    reach = float(reach_px.max())
    start = search_offsets(profiles, width, reach, reach / 2.0, strip.blur_px)
    return np.clip(start, -reach_px, reach_px)


def _first_look(
    profiles: Profiles, stations: Stations, strip: Strip, side: np.ndarray, reach_px: np.ndarray
) -> tuple[np.ndarray, Strip]:
    """Joint width that explains the profiles best, from a few guesses, and the offsets found with it."""
    best: tuple[float, np.ndarray, Strip] | None = None
    for share in (0.006, 0.015, 0.035, 0.08):
        guess = Strip((share * side[1], share * side[0]), strip.blur_px)
        start = _search(profiles, stations, guess, reach_px)
        fit = fit_offsets(profiles, start, _width_px(guess, stations, profiles), guess.blur_px, iterations=2)
        score = float(np.mean(np.log(np.maximum(1.0 - fit.strength, 1e-3))))
        if best is None or score < best[0]:
            best = (score, fit.offset_px, guess)
    assert best is not None
    return best[1], best[2]


def _polarity(
    profiles: Profiles, stations: Stations, start: np.ndarray, strip: Strip, side: np.ndarray
) -> tuple[int, int]:
    """Whether most joints of either family are dark (-1) or light (+1), or neither (0).

    Judged on a sample, with joints of a usual width at least: a strip without width has no tone of its own.
    """
    signs: list[int] = []
    for family in (ALONG_X, ALONG_Y):
        rows = np.flatnonzero(stations.family == family)
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), 300)).astype(int)] if len(rows) else rows
        across = side[1] if family == ALONG_X else side[0]
        width_px = np.maximum(max(strip.width[family], 0.015 * across) * profiles.px_per_unit[rows], 1.0)
        looks = fit_offsets(profiles.take(rows), start[rows], width_px, strip.blur_px, iterations=3)
        strong = looks.strength > 0.4
        lined = strong & (np.abs(looks.depth) > 0.5 * np.abs(looks.step))
        # In a floor of two tones the steps outweigh whatever lies between the tiles.
        if lined.sum() < max(6, 0.4 * strong.sum()):
            signs.append(0)
            continue
        dark = float(np.mean(looks.depth[lined] < 0))
        signs.append(-1 if dark > 0.75 else 1 if dark < 0.25 else 0)
    return signs[0], signs[1]


def _estimate_strip(
    profiles: Profiles,
    offsets: Offsets,
    stations: Stations,
    strip: Strip,
    usable: np.ndarray,
    side: np.ndarray,
) -> Strip:
    """Joint width of either family and blur, by least squares over a sample of the stations."""
    width, blur = list(strip.width), strip.blur_px
    samples: list[np.ndarray] = []
    for family in (ALONG_X, ALONG_Y):
        rows = np.flatnonzero(usable & (stations.family == family))
        if len(rows):
            rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), 120)).astype(int)]
        samples.append(rows)
    for _ in range(2):
        for family, rows in enumerate(samples):
            if len(rows) < 6:
                continue
            across = side[1] if family == ALONG_X else side[0]
            options = across * WIDTHS
            widths_px = [w * profiles.px_per_unit for w in options]
            costs = [strip_misfit(profiles, rows, offsets.offset_px, w, blur) for w in widths_px]
            width[family] = _lowest(np.log(options), np.array(costs))
            if strip.polarity[family] == 0:
                # Tiles may meet without a joint: a width would then let the edge sit at either of its sides.
                # The two ideas are each given their own offsets before they are compared.
                ideas = (max(width[family], 0.015 * across), NO_JOINT * across)
                some = profiles.take(rows)
                misfits: list[float] = []
                for idea in ideas:
                    wide = idea * some.px_per_unit
                    own = fit_offsets(some, offsets.offset_px[rows], wide, blur, iterations=4)
                    misfits.append(strip_misfit(some, np.arange(len(rows)), own.offset_px, wide, blur))
                if misfits[1] < misfits[0] + NO_JOINT_BONUS:
                    width[family] = NO_JOINT * across
        rows = np.concatenate(samples)
        width_px = np.where(stations.family == ALONG_X, width[0], width[1]) * profiles.px_per_unit
        costs = [strip_misfit(profiles, rows, offsets.offset_px, width_px, b) for b in BLURS]
        blur = _lowest(np.log(np.array(BLURS)), np.array(costs))
    return replace(strip, width=(width[0], width[1]), blur_px=blur)


def _lowest(log_at: np.ndarray, cost: np.ndarray) -> float:
    """Place of the minimum, by a parabola through the lowest value and its neighbours."""
    i = int(np.clip(cost.argmin(), 1, len(cost) - 2))
    (x0, x1, x2), (y0, y1, y2) = log_at[i - 1 : i + 2], cost[i - 1 : i + 2]
    if cost.argmin() != i:
        return float(np.exp(log_at[cost.argmin()]))
    bend = (y2 - y1) / (x2 - x1) - (y1 - y0) / (x1 - x0)
    slope = (y2 - y0) / (x2 - x0)
    return float(np.exp(np.clip(x1 - 0.5 * slope * (x2 - x0) / max(bend, 1e-12), x0, x2)))


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
    r, s, u = np.abs(distances[usable]), sigma_fit[usable], px_per_unit[usable]
    s = np.maximum(s, 0.3 * np.median(s))
    base = float(np.median(r)) * 1.48 + 1e-6
    best = (np.inf, 1.0, 0.0)
    for share_s in np.r_[0.0, np.geomspace(0.05, 2.0, 10)] * base / np.median(s):
        for share_u in np.r_[0.0, np.geomspace(0.05, 2.0, 10)] * base / np.median(u):
            variance = (share_s * s) ** 2 + (share_u * u) ** 2 + 1e-6
            # Half the spread is a Cauchy's scale for normal residuals.
            gamma2 = 0.45 * variance
            cost = float(np.sum(0.5 * np.log(gamma2) + np.log1p(r * r / gamma2)))
            if cost < best[0]:
                best = (cost, share_s, share_u)
    _, share_s, share_u = best
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
